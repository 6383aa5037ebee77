"""Ctrl-C during a run: displayed frames are saved, exit code 130, no traceback."""

from __future__ import annotations

import signal
from pathlib import Path

import cv2
import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import synthesize
from services.reports.schema import RunReport

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def long(tmp_path_factory) -> Path:
    return synthesize(
        tmp_path_factory.mktemp("recordings") / "long", frames=40, width_px=64, height_px=48, stereo=False
    )


def wait_for_line(process, beginning: str) -> None:
    for line in process.stderr:
        if line.startswith(beginning):
            return
    pytest.fail(f"the process ended before it printed {beginning!r}")


@pytest.mark.parametrize("engine", ["embedded", pytest.param("holoscan", marks=pytest.mark.holoscan)])
def test_interrupted_replay_writes_results_so_far(request, long, tmp_path, start, engine):
    if engine == "holoscan":
        request.getfixturevalue("sdk")
    out = tmp_path / "out"
    process = start("replay", long, "--out", out, "--engine", engine, "--steps-per-frame", 12)
    wait_for_line(process, "replay 1")
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=300)
    assert process.returncode == 130, stderr
    assert "Traceback" not in stderr
    assert stdout.strip().endswith(str(out / "report.html"))
    report = RunReport.read(out / "report.json")
    assert report.run.interrupted and report.run.stop_reason == "interrupted"
    assert 1 <= report.frames.displayed == report.frames.ingested < 40
    assert cv2.VideoCapture(str(out / "reconstruction.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == report.frames.displayed
    assert load_bundle(out / "model").sha256() == report.model.sha256
    assert "interrupted" in (out / "report.html").read_text()


def test_interrupted_reconstruct_saves_model_so_far(long, tmp_path, start):
    out = tmp_path / "out"
    process = start("reconstruct", long, "--out", out, "--steps", 100_000)
    wait_for_line(process, "train 1/100000")
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130, stderr
    assert "Traceback" not in stderr
    assert load_bundle(out / "model").gaussians.count > 0
    assert any("of 100000 training steps" in note for note in RunReport.read(out / "report.json").notes)
