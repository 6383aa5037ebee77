"""A typical report with key frames, and databases: SQLite, and PostgreSQL from Debian's package."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import FrameQuality
from operators.messages import RenderedFrame
from operators.metrics import ScoredFrame
from services.reports.schema import RunReport
from tests.missing import missing
from tests.services.registry.servers import new_database

SERVER_STARTS_S = 300.0

PATH = "source,tool_mask,reconstruct,deform,rasterize,video"


@pytest.fixture(autouse=True)
def same_umask() -> Iterator[None]:
    """Restore the umask after each test, since programs called in this process set it."""
    before = os.umask(0o022)
    os.umask(before)
    yield
    os.umask(before)


@pytest.fixture
def report() -> RunReport:
    return RunReport.model_validate(
        {
            "recording": {
                "name": "take <7>",
                "frames": 4,
                "width_px": 24,
                "height_px": 16,
                "fps": 25.0,
                "digest": "ab" * 32,
            },
            "run": {
                "device": "cpu",
                "engine": "embedded",
                "seed": 3,
                "version": "1.2.3",
                "threads": 2,
                "wall_s": 2.5,
                "field": "basis",
                "started_at": "2026-01-02T03:04:05+00:00",
                "stop_reason": "end of recording",
                "peak_memory_bytes": 2**30,
                "machine": {"Processor": "abacus"},
            },
            "frames": {"ingested": 4, "displayed": 4, "dropped": 0},
            "latency_ms": {PATH: {"p50": 10.0, "p95": 20.0, "p99": 21.0, "max": 22.5}},
            "latency_quantiles_ms": {PATH: [10 + k / 8 for k in range(101)]},
            "operators": {"source": {"calls": 4, "p50_ms": 1.25, "p99_ms": 2.5}},
            "quality": {
                "live": {"psnr_tissue_db": 38.5, "psnr_frame_db": 39.25, "ssim": 0.97, "frames": 3},
                "heldout": {"psnr_tissue_db": 33.0, "psnr_frame_db": 34.0, "ssim": 0.9, "frames": 1},
                "baselines": {
                    "previous_frame_db": 37.25,
                    "heldout_previous_frame_db": 36.0,
                    "heldout_neighbour_mean_db": 24.5,
                },
            },
            "model": {"gaussians": 1200, "parameters": 99000, "sha256": "cd" * 32, "version": 4},
            "frames_sha256": "ef" * 32,
            "notes": ["no <mask>"],
            "series": [
                {
                    "seq": k,
                    "time_s": k / 25,
                    "trained": k != 1,
                    "model_version": k + 1,
                    "psnr_tissue_db": 30.0 + k,
                    "psnr_frame_db": 31.0 + k,
                    "ssim": 0.9,
                    "previous_frame_db": None if k == 0 else 37.0,
                }
                for k in range(4)
            ],
        }
    )


@pytest.fixture
def scored() -> ScoredFrame:
    image = np.arange(16 * 24 * 3, dtype=np.uint8).reshape(16, 24, 3)
    rendered = RenderedFrame(
        frame=Frame(1, 40_000_000, image, mask=np.ones((16, 24), np.uint8)),
        image=image,
        depth=np.full((16, 24), 61.5, np.float32),
        alpha=np.ones((16, 24), np.float32),
        model_version=2,
        trained=False,
    )
    return ScoredFrame(rendered, FrameQuality(1, 33.0, 34.0, 0.9), 36.0)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[str]:
    """Start a PostgreSQL server without a TCP port and return the folder of its socket."""
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
    if not programs:
        missing("PostgreSQL is not installed (apt-get install postgresql)")
    user = None
    if os.geteuid() == 0:  # the server refuses to run as root
        try:
            user = pwd.getpwnam("postgres").pw_name
        except KeyError:
            missing("there is no user postgres to run PostgreSQL as")
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    try:
        if user is not None:
            shutil.chown(folder, user)
        subprocess.run(
            [programs[-1].with_name("initdb"), "-D", folder / "data", "-U", "tester", "-A", "trust", "-E", "UTF8"],
            user=user, cwd=folder, check=True, capture_output=True,
        )  # fmt: skip
        options = ["-c", "listen_addresses=", "-c", "fsync=off", "-k", str(folder)]
        with open(folder / "log", "wb") as log:
            server = subprocess.Popen(
                [programs[-1], "-D", folder / "data", *options], user=user, cwd=folder, stdout=log, stderr=log
            )
        try:
            _wait_for(server, lambda: _answers_postgresql(folder))
            yield str(folder)
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(SERVER_STARTS_S)
    finally:
        shutil.rmtree(folder)


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str | None:
    """None for SQLite in the test's folder, or the URL of an empty PostgreSQL database."""
    if request.param == "sqlite":
        return None
    return new_database(request.getfixturevalue("postgresql"))


def _answers_postgresql(folder: Path) -> bool:
    import psycopg

    try:
        psycopg.connect(f"host={folder} user=tester dbname=postgres").close()
    except psycopg.OperationalError:
        return False
    return True


def _wait_for(server: subprocess.Popen[bytes], answers: Callable[[], bool]) -> None:
    until = time.monotonic() + SERVER_STARTS_S
    while not answers():
        assert server.poll() is None, f"the server ended with {server.returncode}"
        assert time.monotonic() < until, f"the server did not answer within {SERVER_STARTS_S:g} s"
        time.sleep(0.1)
