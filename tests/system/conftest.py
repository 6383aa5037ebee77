"""The complete program on small recordings, in this process where possible, otherwise in a child process."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from gsplat_core.io.recordings import synthesize
from services.cli.app import run

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("--steps-per-frame", "2")


@dataclass(frozen=True)
class Done:
    """Result of a command."""

    code: int
    out: str
    err: str


@pytest.fixture
def intrasplat(capfd) -> Callable[..., Done]:
    """Run a command line in this process."""

    def call(*arguments: object) -> Done:
        capfd.readouterr()
        code = run([str(argument) for argument in arguments])
        return Done(code, *capfd.readouterr())

    return call


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a command line in a child process that does not outlive the test."""
    started = []

    def call(*arguments: object) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "services.cli", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(ROOT)]))},
        )
        started.append(process)
        return process

    yield call
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """Six synthetic frames of 64x48 px; not to be changed."""
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=6, width_px=64, height_px=48, stereo=False)


@pytest.fixture(scope="session")
def finished(tiny, tmp_path_factory) -> Path:
    """Output of a replay of `tiny`; not to be changed."""
    out = tmp_path_factory.mktemp("outputs") / "finished"
    assert run(["replay", str(tiny), "--out", str(out), "--heldout", *QUICK]) == 0
    return out


@pytest.fixture(scope="session")
def fingerprints() -> Callable[[Path], dict[str, str]]:
    """Return the SHA-256 of every file below a folder."""

    def take(folder: Path) -> dict[str, str]:
        return {
            str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }

    return take


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a file system of 12 MiB: a tmpfs if this process may mount one."""
    if os.geteuid() != 0:
        pytest.skip(
            "only root may mount a small tmpfs; tests/operators/sinks/test_video.py shows the same with a reserve"
        )
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"this container may not mount a tmpfs: {mounted.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)
