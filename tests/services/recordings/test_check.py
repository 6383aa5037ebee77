"""Check of an uploaded recording: location, resource limits and verdict."""

from __future__ import annotations

import json
import os
import resource
from types import SimpleNamespace

import pytest

from services.recordings import check
from services.recordings.check import ArchiveInvalid


@pytest.fixture
def checked(tmp_path, monkeypatch, capsys):
    """Run the check in this process, without its limits, and return the verdict."""
    monkeypatch.setattr(check, "_limit_resources", lambda limits: None)
    monkeypatch.setattr(check, "keep_files_private", lambda: None)
    folder = tmp_path / "folder"
    folder.mkdir()

    def run(content: bytes, kind: str = "archive", name: str = "case", most_bytes: int = 1 << 20):
        (folder / "upload").write_bytes(content)
        assert check.main([str(folder), "--kind", kind, "--name", name, f"--most-bytes={most_bytes}"]) == 0
        out = capsys.readouterr().out
        assert out.count("\n") == 1
        return json.loads(out)

    run.folder = folder
    return run


def test_check_unpacks_archive_over_leftovers_and_describes_recording(checked, packed):
    (checked.folder / "case").mkdir()
    (checked.folder / "case" / "left by an interrupted check").touch()
    verdict = checked(packed().read_bytes())
    assert verdict["stage"] == "ready" and verdict["warnings"] == 0
    assert (verdict["frames"], verdict["width_px"], verdict["height_px"]) == (3, 48, 32)
    assert "left by an interrupted check" not in {path.name for path in (checked.folder / "case").iterdir()}


def test_check_rejects_bad_archive(checked):
    assert checked(b"PK no archive") == {"stage": "rejected", "reason": "the archive is cut off: it has 13 bytes"}
    verdict = checked(b"", most_bytes=1)
    assert verdict["stage"] == "rejected"


def test_check_links_video_with_its_suffix(checked):
    (checked.folder / "clip.mp4").write_text("left by an interrupted check")
    verdict = checked(b"no video at all", kind=".mp4", name="clip")
    assert verdict["stage"] == "rejected" and str(checked.folder) not in verdict["reason"]
    assert "clip.mp4" in verdict["reason"]
    assert os.path.samefile(checked.folder / "clip.mp4", checked.folder / "upload")


@pytest.mark.parametrize(("count", "said"), [(2, "p0; p1"), (3, "p0; p1; p2"), (5, "p0; p1; p2; and 2 more")])
def test_verdict_names_first_three_problems_and_counts_rest(monkeypatch, tmp_path, count, said):
    problems = [f"{tmp_path}/p{k}" for k in range(count)]
    monkeypatch.setattr(check, "validate_recording", lambda path: SimpleNamespace(ok=False, problems=problems))
    assert check._verdict(tmp_path / "x", tmp_path) == {"stage": "rejected", "reason": said}


@pytest.mark.parametrize("error", [ArchiveInvalid("no"), MemoryError()])
def test_check_rejects_unreadable_upload_without_crash(checked, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(check, "_put", fail)
    monkeypatch.setattr(check, "CHECK_MEMORY_BYTES", 1234)
    verdict = checked(b"x")
    assert verdict["stage"] == "rejected"
    assert verdict["reason"] == (
        "no" if isinstance(error, ArchiveInvalid) else "it needs more than 1234 bytes of memory to read"
    )


def test_check_sets_resource_limits(monkeypatch):
    set_to, niced = {}, []
    monkeypatch.setattr(check.os, "nice", niced.append)
    monkeypatch.setattr(check.resource, "setrlimit", lambda kind, limits: set_to.update({kind: limits}))
    monkeypatch.setattr(check, "lower_limit", lambda kind, wanted, spare=0: set_to.update({kind: (wanted, spare)}))
    monkeypatch.setattr(check, "taken_bytes", lambda: 1000)
    monkeypatch.setattr(check, "CHECK_MEMORY_BYTES", 2000)
    monkeypatch.setattr(check, "CHECK_S", 60.5)
    check._limit_resources(5 << 20)
    assert set_to[resource.RLIMIT_CORE] == (0, 0) and niced[0] > 0
    assert set_to[resource.RLIMIT_FSIZE] == (5 << 20, 0)
    assert set_to[resource.RLIMIT_DATA] == (3000, 0)
    seconds, spare = set_to[resource.RLIMIT_CPU]
    assert seconds >= 60.5 and spare > 0, "SIGXCPU comes before the kill"
    check._limit_resources(1)
    assert set_to[resource.RLIMIT_FSIZE][0] == 1 << 20, "libraries write small files of their own"
