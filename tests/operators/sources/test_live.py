"""A source that follows the clock: newest wins, states, counts, closing."""

from __future__ import annotations

import threading
import time

import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import FrameStatus
from operators.sources.live import FrameOrder, LiveSource
from operators.sources.source import FrameSource, SourceDescription, SourceState

SOON_S = 300.0
"""Longer than anything here takes."""


class Scripted(LiveSource):
    """Gives what a list says: frames, sentences about a lost connection, errors to raise, events to wait for."""

    def __init__(self, script, camera, **options):
        super().__init__(**options)
        self.script, self.reached = script, threading.Event()
        self.description = SourceDescription("camera 1", camera.width_px, camera.height_px, 25.0, camera)

    def frames(self):
        for step in self.script:
            if isinstance(step, BaseException):
                raise step
            if isinstance(step, str):
                self.lost(step)
                self.reached.set()
            elif isinstance(step, threading.Event):
                self.reached.set()
                assert step.wait(SOON_S)
            else:
                yield step
        self.reached.set()


def opened(source):
    source.open()
    assert source.reached.wait(SOON_S)
    return source


def all_of(source):
    seqs = []
    while (frame := source.read(SOON_S)) is not None:
        seqs.append(frame.seq)
    return seqs


def test_live_source_keeps_newest_frames_and_counts_dropped(camera, frame):
    hold = threading.Event()
    source = opened(Scripted([*(frame(k) for k in range(10)), hold], camera, waiting=2))
    assert isinstance(source, FrameSource) and source.state is SourceState.LIVE
    hold.set()
    assert all_of(source) == [8, 9]
    assert source.counts() == {"too_late": 8}
    source.close()


def test_live_source_without_drops_waits_for_reader(camera, frame):
    source = Scripted([frame(k) for k in range(50)], camera, waiting=1, drops=False)
    source.open()
    assert all_of(source) == list(range(50)) and source.counts() == {}
    source.close()


def test_live_source_sets_status_and_arrival_time(camera, frame):
    before = time.monotonic_ns()
    given = [frame(0), frame(1, arrived_ns=7), frame(2, status=FrameStatus.DAMAGED)]
    source = opened(Scripted(given, camera, waiting=3))
    first, second, third = (source.read(SOON_S) for _ in range(3))
    assert before <= first.arrived_ns <= time.monotonic_ns() and second.arrived_ns == 7
    assert [first.status, second.status, third.status] == [FrameStatus.LIVE, FrameStatus.LIVE, FrameStatus.DAMAGED]
    source.close()


def test_live_source_reports_and_counts_stall(camera, frame):
    hold = threading.Event()
    source = opened(Scripted([frame(0), hold, frame(1)], camera, stalled_after_s=0.0))
    assert source.read(SOON_S).seq == 0
    assert source.state is SourceState.STALLED and source.state_sentence.startswith(
        "camera 1 has delivered no frame for"
    )
    hold.set()
    assert source.read(SOON_S).seq == 1
    assert source.counts()["stalls"] >= 1
    source.close()
    assert source.state is SourceState.ENDED and source.state_sentence == "camera 1 is not open"


def test_live_source_reconnecting_until_next_frame_and_numbers_continue(camera, frame):
    hold, end = threading.Event(), threading.Event()
    script = [frame(5), frame(6), "camera 1 does not answer", "still not", hold, frame(0), frame(1), end]
    source = Scripted(script, camera, waiting=5, order=FrameOrder())
    opened(source)
    assert [source.read(SOON_S).seq for _ in range(2)] == [0, 1]
    while source.state_sentence != "still not":
        time.sleep(0.001)
    assert source.state is SourceState.RECONNECTING
    hold.set()
    later = [source.read(SOON_S) for _ in range(2)]
    assert [each.seq for each in later] == [2, 3] and source.state is SourceState.LIVE
    assert later[0].pts_ns > 40_000_000, "the time that the connection was lost has passed"
    assert source.counts() == {"reconnections": 1}
    end.set()
    source.close()


def test_live_source_raises_reader_error_once_after_earlier_frames(camera, frame):
    source = Scripted([frame(0), ValueError("broken here")], camera)
    source.open()
    assert source.read(SOON_S).seq == 0
    with pytest.raises(ValueError, match="broken here"):
        source.read(SOON_S)
    assert source.read(0) is None and source.state is SourceState.ENDED and source.state_sentence == "broken here"
    source.close()


def test_abandoned_reader_does_not_affect_reopened_live_source(camera, frame, monkeypatch):
    monkeypatch.setattr("operators.sources.live.LiveSource.close_timeout_s", 0.01)
    hold = threading.Event()
    source = opened(Scripted([frame(0), hold, "gone", frame(99)], camera))
    left = source._thread
    source.close()
    source.script = [frame(1)]
    source.open()
    hold.set()
    left.join(SOON_S)
    assert all_of(source) == [1] and source.counts() == {}
    source.close()


def test_live_source_reopened_starts_from_beginning(camera, frame):
    source = Scripted([frame(k) for k in range(3)], camera, waiting=1, order=FrameOrder())
    for _ in range(2):
        opened(source)
        source.close()
    opened(source)
    assert all_of(source) == [2] and source.counts() == {"too_late": 2}
    source.close()
    source.close()


def test_live_source_refuses_waiting_zero(camera):
    with pytest.raises(InvalidInput, match="waiting is 0"):
        Scripted([], camera, waiting=0)
