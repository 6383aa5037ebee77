"""A source in a child process: frames, crashes, hangs, endings, clean-up."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import UserError
from gsplat_core.io.recordings import open_recording, synthesize
from operators.errors import SourceLost, SourceUnavailable
from operators.sources import process
from operators.sources.process import ProcessSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import FrameSource, SourceState

SOON_S = 300.0
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def stand_in(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    made = []

    def make(address, **more):
        source = ProcessSource(address, SourceOptions(waiting=64), opener="stand_in_source:opener", **more)
        made.append(source)
        return source

    yield make
    for source in made:
        source.close()


def read(source):
    frame = source.read(SOON_S)
    assert frame is not None, source.state_sentence
    return frame


def until(condition):
    end = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def pid(source):
    return source._child._process.pid


def is_gone(number):
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return True
    return False


def test_process_source_delivers_identical_frames(tmp_path):
    folder = synthesize(tmp_path / "tiny", frames=5, width_px=64, height_px=48)
    options = SourceOptions(realtime=True, speed=1000, waiting=64, process=True)
    source = open_source(folder, options)
    assert isinstance(source, ProcessSource) and isinstance(source, FrameSource)
    recording = open_recording(folder)
    about = source.description
    assert (about.camera, about.frame_count, about.fields) == (recording.camera, 5, recording.fields)
    for _ in range(2):  # it can be opened again
        source.open()
        for expected in recording:
            frame = read(source)
            assert (frame.seq, frame.pts_ns) == (expected.seq, expected.pts_ns)
            assert 0 < frame.arrived_ns <= time.monotonic_ns(), "the clock is the same in both"
            for name in ("image", "right_image", "mask", "depth", "pose"):
                np.testing.assert_array_equal(getattr(frame, name), getattr(expected, name))
        assert source.read(SOON_S) is None and source.state is SourceState.ENDED
        source.close()


def test_process_source_passes_frames_of_other_size(stand_in):
    source = stand_in("frames=3,size=300,size=8,frames=2,size=1500")
    source.open()
    shapes = [read(source).image.shape[:2] for _ in range(8)]
    assert shapes == [(16, 24)] * 3 + [(300, 300), (8, 8)] + [(16, 24)] * 2 + [(1500, 1500)]


def test_process_source_frames_are_not_overwritten(stand_in):
    source = stand_in("frames=40,block")
    source.open()
    frames = [read(source) for _ in range(40)]
    assert all((frame.image == frame.seq).all() for frame in frames)


def test_process_source_restarts_after_crash_and_continues_numbers(stand_in, tmp_path):
    source = stand_in(f"frames=3,once={tmp_path / 'crashed'},frames=2,block")
    source.open()
    before = [read(source) for _ in range(3)]
    after = [read(source) for _ in range(5)]
    assert [frame.seq for frame in before + after] == list(range(8))
    times = [frame.pts_ns for frame in before + after]
    assert times == sorted(times) and times[3] - times[2] > 0.3e9, "the time in between has passed"
    assert source.counts()["process_restarts"] == 1 and source.counts()["reconnections"] == 1
    assert source.state is SourceState.LIVE


@pytest.mark.slow
def test_process_source_logs_reason_while_restarting(stand_in, caplog):
    source = stand_in("frames=1,crash=SIGKILL")
    source.open()
    assert read(source).seq == 0
    until(lambda: source.state is SourceState.RECONNECTING)
    assert "the process that reads stand-in failed (it was ended by SIGKILL); another one is started" in caplog.text
    assert read(source).seq == 1


def test_process_source_restarts_after_exception(stand_in, caplog):
    source = stand_in("frames=1,raise=what is this")
    source.open()
    assert [read(source).seq for _ in range(2)] == [0, 1]
    assert "ValueError: what is this" in caplog.text


@pytest.mark.parametrize("frames", [0, 2])
def test_process_source_ends_without_restart_on_damaged_file(stand_in, frames):
    source = stand_in(f"frames={frames},refuse=frame 2 is damaged. Remove it.")
    source.open()
    assert [read(source).seq for _ in range(frames)] == list(range(frames))
    with pytest.raises(SourceLost, match=r"^frame 2 is damaged\. Remove it\.$"):
        source.read(SOON_S)
    assert "process_restarts" not in source.counts()


def test_process_source_restarts_if_camera_may_return(stand_in, monkeypatch):
    monkeypatch.setattr(process, "MOST_FAILURES", 2)
    source = stand_in("frames=1,refuse=no signal.", may_return=True)
    source.open()
    assert [read(source).seq for _ in range(2)] == [0, 1]


@pytest.mark.slow
def test_process_source_replaces_hung_process(stand_in):
    source = stand_in("frames=1,crash=SIGSTOP", hung_after_s=0.5)
    source.open()
    first = pid(source)
    assert [read(source).seq for _ in range(2)] == [0, 1]
    assert is_gone(first), "one that is stopped is ended, too"


@pytest.mark.slow
def test_process_source_opened_late_is_not_treated_as_hung(stand_in):
    source = stand_in("pause=0.3,frames=1", hung_after_s=2.0)
    time.sleep(2.1)
    source.open()
    assert read(source).seq == 0
    assert "process_restarts" not in source.counts()


@pytest.mark.slow
def test_process_source_replaces_process_stuck_in_driver(stand_in):
    source = stand_in("frames=1,block", stuck_after_s=1.5)
    source.open()
    assert read(source).seq == 0
    until(lambda: source.state is SourceState.STALLED)
    assert source.state_sentence.startswith("stand-in has delivered no frame for")
    assert read(source).seq == 1 and source.counts()["process_restarts"] == 1


@pytest.mark.slow
def test_process_source_gives_up_after_maximum_failures(stand_in, monkeypatch):
    monkeypatch.setattr(process, "MOST_FAILURES", 3)
    source = stand_in("crash=SIGABRT")
    source.open()
    with pytest.raises(SourceLost, match="stand-in is given up after 3 attempts: it was ended by SIGABRT"):
        source.read(SOON_S)
    assert source.state is SourceState.ENDED and "given up" in source.state_sentence
    assert issubclass(SourceLost, UserError)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("refuse: no such thing", "^refuse: no such thing$"),
        ("break", "RuntimeError: out of order"),
        ("exit", "it ended with status 3"),
        ("silent", "it has not opened the source within 1.5 s"),
    ],
)
def test_process_source_open_failure_leaves_no_process(stand_in, address, what):
    before = children()
    with pytest.raises(SourceUnavailable, match=what):
        stand_in(address, open_timeout_s=1.5 if address == "silent" else SOON_S)
    assert children() == before


def test_process_source_forwards_state_counts_notes_and_log(stand_in, caplog):
    source = stand_in("frames=1,log=a warning,lost=the cable is out,block")
    assert source.description.notes == ("assumed",)
    source.open()
    assert read(source).seq == 0
    until(lambda: source.state is SourceState.RECONNECTING)
    assert source.state_sentence == "the cable is out" and source.counts() == {"reconnections": 1}
    assert "a warning" in caplog.text


def children():
    """The processes that this one has started and that are still there, by /proc."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[1]) == os.getpid():
                found.add(int(entry.name))
    return found


@pytest.mark.parametrize("address", ["frames=2,block", "block", "crash=SIGSTOP"])
@pytest.mark.slow
def test_process_source_close_leaves_no_process_or_open_file(stand_in, address):
    gc.collect()
    files = len(os.listdir("/proc/self/fd"))
    source = stand_in(address)
    number = pid(source)
    source.open()
    time.sleep(0.5 if "STOP" in address else 0)
    source.close()
    assert is_gone(number) and source.state is SourceState.ENDED
    assert len(os.listdir("/proc/self/fd")) == files


@pytest.mark.slow
def test_unopened_or_deleted_process_source_ends_its_process(stand_in):
    source = stand_in("frames=1,block")
    number = pid(source)
    source.close()
    assert is_gone(number)
    forgotten = ProcessSource("block", opener="stand_in_source:opener")
    number = pid(forgotten)
    del forgotten
    gc.collect()
    assert is_gone(number)


def test_process_source_child_ignores_signals(stand_in):
    source = stand_in("frames=1,block")
    source.open()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(pid(source), number)
    assert read(source).seq == 0
    assert not is_gone(pid(source)) and source.counts() == {}


PARENT = """
import sys, time
from operators.sources.process import ProcessSource
source = ProcessSource("frames=1,block", opener="stand_in_source:opener")
source.open()
assert source.read(300).seq == 0
print(source._child._process.pid, flush=True)
time.sleep(1000)
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_process_source_child_ends_with_parent(number):
    paths = filter(None, [str(ROOT), str(Path(__file__).parent), os.environ.get("PYTHONPATH")])
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=env
    ) as parent:
        try:
            child = int(parent.stdout.readline())
            assert not is_gone(child)
            parent.send_signal(number)
            parent.wait(SOON_S)
        finally:
            parent.kill()
    until(lambda: is_gone(child) or Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z")
