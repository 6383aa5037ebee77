"""Closed, full or broken standard streams and non-text names do not change the outputs of a run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.reports.schema import RunReport

ROOT = Path(__file__).resolve().parents[2]


def shell(command: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a line of bash in `folder`; $I is the command."""
    search = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(ROOT)]))
    environment |= {"I": f"{sys.executable} -m services.cli", "PYTHONPATH": search}
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", command],
        cwd=folder,
        capture_output=True,
        env=os.environ | environment,
        check=False,
    )


@pytest.mark.parametrize(
    ("redirection", "code"),
    [
        ("<&- >&- 2>&-", 0),
        ("--json >/dev/full", 2),
        ("2>&1 | true", 141),
    ],
)
@pytest.mark.slow
def test_replay_writes_outputs_with_closed_or_broken_standard_streams(tiny, tmp_path, redirection, code):
    done = shell(f"$I replay {tiny} --out out --max-frames 2 --steps-per-frame 1 {redirection}", tmp_path)
    assert done.returncode == code, done.stderr
    assert b"Traceback" not in done.stderr and b"Exception ignored" not in done.stderr
    if code == 2:
        assert done.stderr.splitlines()[-1].startswith(b"error: standard output cannot be written (No space left")
    report = RunReport.read(tmp_path / "out" / "report.json")
    assert report.frames.displayed == 2 and (tmp_path / "out" / "reconstruction.mp4").stat().st_size > 0


@pytest.mark.parametrize(("command", "code"), [("--help | true", 141), ("--help >/dev/full", 2)])
def test_help_with_broken_stdout_exits_without_traceback(tmp_path, command, code):
    done = shell(f"$I {command}", tmp_path)
    assert done.returncode == code and b"Traceback" not in done.stderr


@pytest.mark.slow
def test_replay_and_render_accept_non_utf8_names(tiny, tmp_path):
    name = b"caf\xe9" + "\u00e9\u2192\n\U0001f600".encode()
    folder = os.fsencode(tmp_path) + b"/" + name
    os.symlink(tiny, folder)
    out = folder + b".out"
    done = shell(
        '$I replay ./"$N" --out ./"$N.out" --max-frames 1 --steps-per-frame 1 && $I render ./"$N.out/model" --out ./"$N.mp4"',
        tmp_path, N=os.fsdecode(name), LC_ALL="C",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert os.path.exists(out + b"/report.html") and os.path.exists(folder + b".mp4")
    assert done.stdout.rstrip(b"\n").endswith(name + b".mp4"), "a name is printed as the bytes that it is"


@pytest.mark.slow
def test_replay_over_file_size_limit_prints_error_and_keeps_earlier_run(finished, tiny, tmp_path, fingerprints):
    import shutil

    out = shutil.copytree(finished, tmp_path / "out")
    before = fingerprints(out)
    done = shell(f"ulimit -f 4; $I replay {tiny} --out out --max-frames 2 --steps-per-frame 1", tmp_path)
    assert done.returncode == 2 and b"Traceback" not in done.stderr
    assert b"ulimit -f" in done.stderr
    assert fingerprints(out) == before or not (tmp_path / "out" / "model" / "model.safetensors").exists()
