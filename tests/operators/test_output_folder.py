"""Foreign files are never overwritten, and outputs of different runs are never mixed."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys

import pytest

from operators import output_folder
from operators.errors import OutputError, OutputFolderInUse
from operators.output_folder import LOCK, MARKER, OutputFolder, check_output_folder


def deliver(folder, made_by="replay", **files):
    """A run that writes these files; a name's underscore stands for its dot."""
    with OutputFolder(folder, made_by) as output:
        for name, text in files.items():
            (output.path / name.replace("_", ".")).write_text(text)
        output.publish()


def contents_of(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != MARKER}


def test_output_folder_accepts_new_and_empty_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "a" / "b", tmp_path / "empty"):
        deliver(folder, report_json="1")
        assert check_output_folder(folder) and contents_of(folder) == {"report.json": "1"}


@pytest.mark.parametrize("existed", [False, True])
def test_output_folder_of_failed_run_leaves_no_files(tmp_path, existed):
    folder = tmp_path / "a" / "b"
    if existed:
        folder.mkdir(parents=True)
    with pytest.raises(RuntimeError), OutputFolder(folder, "replay") as output:
        (output.path / "report.json").touch()
        raise RuntimeError
    assert folder.exists() == existed and (not existed or list(folder.iterdir()) == [])
    assert (tmp_path / "a").exists() == existed


def test_check_output_folder_creates_nothing(tmp_path):
    assert check_output_folder(tmp_path / "new") is False
    assert not (tmp_path / "new").exists()


def test_output_folder_replaces_earlier_run_and_keeps_user_files(tmp_path):
    deliver(tmp_path / "out", report_json="1", **{"000000_png": "1", "000001_png": "1"})
    (tmp_path / "out" / "notes.txt").write_text("mine")
    deliver(tmp_path / "out", **{"000000_png": "2"})
    assert contents_of(tmp_path / "out") == {"000000.png": "2", "notes.txt": "mine"}


def test_output_folder_keeps_earlier_results_until_publish(tmp_path):
    deliver(tmp_path / "out", report_json="1")
    with OutputFolder(tmp_path / "out", "replay") as output:
        assert output.earlier
        (output.path / "report.json").write_text("2")
        assert (tmp_path / "out" / "report.json").read_text() == "1"
        output.publish()
    assert contents_of(tmp_path / "out") == {"report.json": "2"}


class Killed(BaseException):
    """The process was killed here."""


def kill_at(monkeypatch, step):
    """Stop at the `step`-th rename or change of the marker; False once there is none any more."""
    seen = 0

    def counted(original):
        def call(*arguments, **options):
            nonlocal seen
            seen += 1
            if seen == step:
                raise Killed
            return original(*arguments, **options)

        return call

    monkeypatch.setattr(output_folder.os, "replace", counted(os.replace))
    monkeypatch.setattr(output_folder, "_write_marker", counted(output_folder._write_marker))


@pytest.mark.parametrize("step", range(1, 16))
def test_output_folder_kill_during_publish_leaves_one_consistent_run(tmp_path, monkeypatch, step):
    deliver(tmp_path / "out", report_json="1", report_html="1", model="1")
    with monkeypatch.context() as patch:
        output = OutputFolder(tmp_path / "out", "replay")
        output.__enter__()
        for name in ("report.json", "report.html", "extra"):
            (output.path / name).write_text("2")
        kill_at(patch, step)
        try:
            output.publish()
            killed = False
        except Killed:
            killed = True
    seen = {text for name, text in holds_files(tmp_path / "out").items()}
    assert len(seen) <= 1, f"a mixture of two runs: {holds_files(tmp_path / 'out')}"
    # The process is gone, and with it its lock; nothing else was cleaned up.
    output._stack.pop_all()
    (tmp_path / "out" / LOCK).unlink()
    with OutputFolder(tmp_path / "out", "replay"):
        pass
    old, new = (
        dict.fromkeys(("report.json", "report.html", "model"), "1"),
        dict.fromkeys(("report.json", "report.html", "extra"), "2"),
    )
    assert contents_of(tmp_path / "out") == (old if step <= 2 and killed else new)


def holds_files(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file() and path.name[0] != "."}


@pytest.mark.parametrize("marker", [None, "not json", "[]", '{"format": "something else"}', "[" * 100_000])
def test_output_folder_refuses_foreign_folder_unchanged(tmp_path, marker):
    (tmp_path / "thesis.tex").write_text("years of work")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(OutputFolderInUse, match=r"not made by intrasplat .*thesis\.tex.*choose another --out"):
        deliver(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("name", ["report.html", "model", "000007.png"])
def test_output_folder_does_not_replace_user_file(tmp_path, name):
    deliver(tmp_path / "out", report_json="1")
    (tmp_path / "out" / name).write_text("mine")
    with pytest.raises(OutputFolderInUse, match=f"holds {name}, which no run of intrasplat wrote"):
        deliver(tmp_path / "out", report_json="2")
    assert contents_of(tmp_path / "out") == {"report.json": "1", name: "mine"}


@pytest.mark.parametrize("files", [["../diary"], ["/etc/passwd"], [".ssh"], ["", 7, None], "report.json", [".."]])
def test_tampered_output_folder_marker_deletes_nothing_outside(tmp_path, files):
    deliver(tmp_path / "out")
    (tmp_path / "diary").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".ssh").write_text("mine")
    (tmp_path / "out" / MARKER).write_text(json.dumps({"format": "intrasplat-output", "files": files}))
    deliver(tmp_path / "out", report_json="2")
    assert (tmp_path / "diary").read_text() == "mine" and (tmp_path / "out" / ".ssh").read_text() == "mine"


def test_output_folder_refuses_file_and_dangling_link(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputFolderInUse, match="is a file"):
        deliver(tmp_path / "file")
    with pytest.raises(OutputFolderInUse, match="is a link that leads nowhere"):
        deliver(tmp_path / "link")
    assert not (tmp_path / "nowhere").exists()


def test_output_folder_does_not_follow_planted_links_or_pipes(tmp_path):
    (tmp_path / "diary").write_text("mine")
    deliver(tmp_path / "out", report_json="1")
    (tmp_path / "out" / LOCK).symlink_to(tmp_path / "diary")
    with pytest.raises(OutputError, match="cannot write to"):
        deliver(tmp_path / "out", report_json="2")
    (tmp_path / "out" / LOCK).unlink()
    (tmp_path / "out" / "report.json").unlink()
    (tmp_path / "out" / "report.json").symlink_to(tmp_path / "diary")
    (tmp_path / "out" / ".run-0123abcd").symlink_to(tmp_path)
    with pytest.raises(OutputFolderInUse, match=r"report\.json, which no run"):
        deliver(tmp_path / "out", report_json="2")
    (tmp_path / "out" / "report.json").unlink()
    deliver(tmp_path / "out", report_json="2")
    assert (tmp_path / "diary").read_text() == "mine"
    assert (tmp_path / "out" / "report.json").read_text() == "2" and not (tmp_path / "out" / "report.json").is_symlink()
    os.unlink(tmp_path / "out" / MARKER)
    os.mkfifo(tmp_path / "out" / MARKER)
    with pytest.raises(OutputFolderInUse, match="not made by intrasplat"):
        deliver(tmp_path / "out", report_json="3")


def test_output_folder_refuses_second_concurrent_run(tmp_path):
    with OutputFolder(tmp_path / "out", "replay") as output:
        (output.path / "report.json").write_text("first")
        with pytest.raises(OutputFolderInUse, match=rf"another run writes into .*process {os.getpid()}"):
            deliver(tmp_path / "out", report_json="second")
        output.publish()
    assert contents_of(tmp_path / "out") == {"report.json": "first"}


@pytest.mark.slow
def test_output_folder_lock_ends_with_killed_process(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from operators.output_folder import OutputFolder\n"
        "output = OutputFolder(Path(sys.argv[1]), 'replay').__enter__()\n"
        "(output.path / 'report.json').write_text('half'); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], check=False)
    assert (tmp_path / "out" / LOCK).exists()
    deliver(tmp_path / "out", report_json="2")
    assert contents_of(tmp_path / "out") == {"report.json": "2"}


def test_output_folder_deleted_before_publish_raises_output_error(tmp_path):
    with pytest.raises(OutputError, match="out is not there"), OutputFolder(tmp_path / "out", "replay") as output:
        shutil.rmtree(tmp_path / "out")
        output.publish()


def test_output_folder_refuses_file_system_without_locks(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OutputError, match="cannot lock files"):
        deliver(tmp_path / "out")
    assert not (tmp_path / "out").exists()
