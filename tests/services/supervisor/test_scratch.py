"""Temporary folders of killed engines are removed; those of running engines are kept."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from services.supervisor import worker

ENGINE = """
import sys, tempfile
tempfile.tempdir = sys.argv[1]
from services.supervisor.worker import scratch_folder
with scratch_folder() as folder:
    open(tempfile.mkstemp()[1], "w").close()
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def engine(temporary) -> tuple[subprocess.Popen[str], Path]:
    process = subprocess.Popen(
        [sys.executable, "-c", ENGINE, str(temporary)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    folder = Path(process.stdout.readline().strip())
    assert len(list(folder.iterdir())) == 1
    os.utime(folder, (0, 0))
    return process, folder


def test_remove_dead_removes_only_scratch_folders_of_killed_engines(temporary):
    running, alive = engine(temporary)
    killed, dead = engine(temporary)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    new = temporary / f"{worker.PREFIX}new"  # its process has not locked it yet
    new.mkdir()
    (temporary / "other").mkdir()
    (temporary / f"{worker.PREFIX}link").symlink_to(temporary / "other")
    assert worker.remove_dead() == [dead]
    assert alive.is_dir() and new.is_dir() and (temporary / "other").is_dir() and not dead.exists()
    running.communicate()  # it ends in order
    assert not alive.exists()


def test_scratch_folder_removes_leftovers_and_becomes_tempdir(temporary):
    left = temporary / f"{worker.PREFIX}left"
    left.mkdir()
    os.utime(left, (0, 0))
    with worker.scratch_folder() as folder:
        assert not left.exists() and Path(tempfile.mkdtemp()).parent == folder
        assert folder.stat().st_mode & 0o077 == 0
    assert list(temporary.iterdir()) == [] and tempfile.gettempdir() == str(temporary)
