"""A source in a separate thread: order, errors, waiting, closing, states."""

from __future__ import annotations

import threading

import pytest

from gsplat_core.errors import InvalidInput
from operators.sources.source import FrameSource, SourceDescription, SourceState, ThreadedSource

SOON_S = 300.0
"""Longer than anything here takes."""


class Listed(ThreadedSource):
    """Gives what a list says: frames, errors to raise, events to wait for."""

    def __init__(self, script, camera, **options):
        super().__init__(**options)
        self.script, self.given, self.closed_in = script, 0, []
        self.description = SourceDescription("listed", camera.width_px, camera.height_px, 25.0, camera)

    def frames(self):
        try:
            for step in self.script:
                if isinstance(step, BaseException):
                    raise step
                if isinstance(step, threading.Event):
                    assert step.wait(SOON_S)
                else:
                    self.given += 1
                    yield step
        finally:
            self.closed_in.append(threading.current_thread())


def all_of(source):
    seqs = []
    while (frame := source.read(SOON_S)) is not None:
        seqs.append(frame.seq)
    return seqs


def test_threaded_source_delivers_every_frame_once_in_order(camera, frame):
    source = Listed([frame(k) for k in range(50)], camera)
    assert isinstance(source, FrameSource)
    assert source.state is SourceState.ENDED and source.read(0) is None, "not open"
    source.open()
    assert all_of(source) == list(range(50))
    assert source.state is SourceState.ENDED and source.read(0) is None
    source.close()


def test_threaded_source_open_and_close_are_idempotent(camera, frame):
    source = Listed([frame(k) for k in range(4)], camera)
    source.close()
    source.open()
    assert source.read(SOON_S).seq == 0
    source.open()
    assert source.read(SOON_S).seq == 1, "still the same reading"
    source.close()
    source.close()
    assert source.read(0) is None and source.state is SourceState.ENDED
    source.open()
    assert all_of(source) == [0, 1, 2, 3]
    source.close()


def test_threaded_source_reads_at_most_ahead_frames(camera, frame):
    source = Listed([frame(k) for k in range(100)], camera, ahead=3)
    source.open()
    for taken in range(1, 20):
        source.read(SOON_S)
        # One more may be in the reader's hands, waiting for room.
        assert source.given <= taken + 3 + 1
    source.close()
    assert source.given < 100


def test_threaded_source_raises_error_once_after_earlier_frames(camera, frame):
    source = Listed([frame(0), frame(1), ValueError("broken here"), frame(2)], camera, ahead=5)
    source.open()
    assert [source.read(SOON_S).seq for _ in range(2)] == [0, 1]
    with pytest.raises(ValueError, match="broken here"):
        source.read(SOON_S)
    assert source.read(0) is None and source.state is SourceState.ENDED
    source.close()


def test_threaded_source_read_timeout_returns_none(camera, frame):
    go_on = threading.Event()
    source = Listed([frame(0), go_on, frame(1)], camera)
    source.open()
    assert source.read(SOON_S).seq == 0
    assert source.read(0.01) is None and source.state is SourceState.LIVE
    go_on.set()
    assert source.read(SOON_S).seq == 1
    source.close()


def test_threaded_source_reports_stalled_state(camera, frame):
    go_on = threading.Event()
    source = Listed([frame(0), go_on, frame(1)], camera, stalled_after_s=0.0)
    source.open()
    assert source.read(SOON_S).seq == 0
    assert source.read(0.01) is None and source.state is SourceState.STALLED
    go_on.set()
    assert source.read(SOON_S).seq == 1
    source.close()
    assert source.state is SourceState.ENDED


def test_threaded_source_closes_iterator_in_reader_thread(camera, frame):
    source = Listed([frame(k) for k in range(100)], camera)
    source.open()
    source.read(SOON_S)
    source.close()
    (thread,) = source.closed_in
    assert thread is not threading.current_thread() and not thread.is_alive()


def test_threaded_source_abandons_stuck_reader_thread(camera, frame, monkeypatch, caplog):
    monkeypatch.setattr(ThreadedSource, "close_timeout_s", 0.01)
    stuck = threading.Event()
    source = Listed([frame(0), stuck, frame(1)], camera)
    source.open()
    assert source.read(SOON_S).seq == 0
    source.close()
    assert "read listed does not end; it is abandoned" in caplog.text
    source.script = [frame(7)]
    source.open()
    stuck.set()
    for thread in threading.enumerate():
        if thread.name == "read listed":
            thread.join(SOON_S) if thread is not source._thread else None
    assert all_of(source) == [7]
    source.close()


def test_threaded_source_refuses_ahead_zero(camera):
    with pytest.raises(InvalidInput, match="ahead is 0; it must be at least 1"):
        Listed([], camera, ahead=0)
