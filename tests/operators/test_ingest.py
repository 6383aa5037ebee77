"""The source emits each frame once and ends the stream."""

from __future__ import annotations

import pytest

from operators.graph import Application, Operator
from operators.ingest import SourceOp


class Collect(Operator):
    """Keeps what arrives, with its metadata."""

    def setup(self, spec):
        spec.input("frame")

    def start(self):
        self.seen = []

    def compute(self, op_input, op_output, context):
        frame = op_input.receive("frame")
        self.seen.append((frame.seq, dict(self.metadata)))


class Stream(Application):
    def __init__(self, recording, **options):
        super().__init__()
        self.recording, self.options = recording, options

    def compose(self):
        self.source = SourceOp(self, name="source", recording=self.recording, **self.options)
        self.sink = Collect(self, name="sink")
        self.add_flow(self.source, self.sink)


def test_every_frame_arrives_once_in_order_with_its_metadata(recording):
    app = Stream(recording)
    result = app.run()
    assert [seq for seq, _ in app.sink.seen] == [0, 1, 2, 3, 4]
    assert app.sink.seen[3][1] == {"seq": 3, "pts_ns": 120_000_000}
    assert app.source.emitted == 5
    assert result.computes["source"] == 5, "the stream ends with its last frame, not with an empty compute"


def test_a_stop_ends_the_stream_and_what_is_on_its_way_arrives(recording):
    app = Stream(recording, stop_requested=lambda: app.source.emitted >= 2)
    app.run()
    assert [seq for seq, _ in app.sink.seen] == [0, 1]


def test_a_recording_with_fewer_frames_than_stated_ends_without_an_error(recording, monkeypatch):
    monkeypatch.setattr(type(recording), "frame_count", property(lambda self: 9))
    app = Stream(recording)
    app.run()
    assert app.source.emitted == 5


def test_frames_are_closed_when_the_graph_stops(recording):
    closed = []

    def frames():
        try:
            yield from recording.frames
        finally:
            closed.append(True)

    recording_like = type("Generating", (), {"__iter__": lambda self: frames(), "frame_count": 5})()
    Stream(recording_like, stop_requested=lambda: True).run()
    app = Stream(recording_like, stop_requested=lambda: app.source.emitted == 1)
    app.run()
    assert closed == [True], "a generator that was begun is closed; one that was not has nothing to close"


def test_an_error_names_the_operator(recording):
    def broken():
        yield recording.frames[0]
        raise ValueError("the file ends here")

    bad = type("Broken", (), {"__iter__": lambda self: broken(), "frame_count": 5})()
    with pytest.raises(Exception, match=r"operator 'source' failed in compute.*the file ends here"):
        Stream(bad).run()
