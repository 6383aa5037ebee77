"""Signals from start-up to the last frame: immediate acknowledgement, saved results, no mixed outputs."""

from __future__ import annotations

import os
import signal
import time

import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import synthesize
from services.reports.schema import RunReport

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    return synthesize(
        tmp_path_factory.mktemp("recordings") / "long", frames=30, width_px=64, height_px=48, stereo=False
    )


def start_replay(start, *arguments):
    """Start a replay and return when it has displayed its first frame."""
    process = start(*arguments)
    for line in process.stderr:
        if line.startswith("replay 1"):
            return process
    pytest.fail("the process ended before its first frame")


@pytest.mark.parametrize("number", [signal.SIGHUP])
def test_sighup_ends_replay_and_saves_results(long, tmp_path, start, number):
    process = start_replay(start, "replay", long, "--out", tmp_path / "out", "--steps-per-frame", 12)
    process.send_signal(number)
    if number == signal.SIGHUP:
        process.send_signal(number)  # the shell sends it and the system too: it is no second request
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130 and "Traceback" not in stderr
    report = RunReport.read(tmp_path / "out" / "report.json")
    assert report.run.interrupted and report.frames.displayed >= 1
    assert load_bundle(tmp_path / "out" / "model").sha256() == report.model.sha256
    assert (tmp_path / "out" / "reconstruction.mp4").stat().st_size > 0


def test_second_interrupt_ends_immediately_and_keeps_earlier_run(long, finished, tmp_path, start, fingerprints):
    import shutil

    out = shutil.copytree(finished, tmp_path / "out")
    before = fingerprints(out)
    # One frame takes minutes: what ends the run is the signal alone.
    process = start("replay", long, "--out", out, "--steps-per-frame", 10_000_000)
    for line in process.stderr:
        if line.startswith("replay 0"):
            break
    process.send_signal(signal.SIGINT)
    assert process.stderr.readline().startswith("interrupted: finishing the frame"), (
        "acknowledged in the middle of a frame"
    )
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130 and "Traceback" not in stderr
    assert fingerprints(out) == before


@pytest.mark.parametrize("after_s", [0.1, 0.6])
def test_interrupt_during_start_exits_130_without_traceback(long, tmp_path, start, after_s):
    process = start("replay", long, "--out", tmp_path / "out", "--steps-per-frame", 100_000)
    # The handler is there as soon as our first module runs.
    deadline_s = time.monotonic() + 300
    while not catches_interrupts(process.pid) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130 and "Traceback" not in stderr, stderr
    assert not (tmp_path / "out" / "report.json").exists()


def catches_interrupts(pid):
    try:
        with open(f"/proc/{pid}/status") as file:
            caught = next(line for line in file if line.startswith("SigCgt"))
        with open(f"/proc/{pid}/maps") as file:
            # Python has its own handler before: wait until ours can be there.
            return bool(int(caught.split()[1], 16) & (1 << (signal.SIGINT - 1))) and "select" in file.read()
    except (FileNotFoundError, StopIteration):
        return False


def test_interrupted_synthesize_keeps_earlier_recording(tmp_path, start, fingerprints):
    take = synthesize(tmp_path / "take", frames=1, width_px=32, height_px=32, stereo=False)
    before = fingerprints(take)
    process = start("synthesize", "--out", take, "--frames", 5000, "--width", 64, "--height", 48)
    for line in process.stderr:
        if line.startswith("synthesize"):
            break
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 130
    assert fingerprints(take) == before and os.listdir(tmp_path) == ["take"]
