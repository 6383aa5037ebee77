"""The source emits each frame once and ends the stream."""

from __future__ import annotations

import pytest

from operators.errors import OperatorFailed
from operators.graph import Application, MultiThreadScheduler, Operator
from operators.ingest import SourceOp, SourceResult
from operators.outcome import OutcomeBuilder
from operators.sources.recording import RecordingSource
from operators.sources.source import SourceDescription, SourceState


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
    def __init__(self, source, **options):
        super().__init__()
        self.given, self.options = source, options

    def compose(self):
        self.source = SourceOp(self, name="source", source=self.given, **self.options)
        self.sink = Collect(self, name="sink")
        self.add_flow(self.source, self.sink)


class Scripted:
    """A source whose every `read` gives what a list says: a frame, None for a time-out, an error to raise."""

    def __init__(self, script, camera, frame_count=None):
        self.script, self.opened, self.closed = list(script), 0, 0
        self.description = SourceDescription("scripted", 24, 16, 25.0, camera, frame_count=frame_count)

    @property
    def state(self):
        return SourceState.LIVE if self.script else SourceState.ENDED

    def open(self):
        self.opened += 1

    def read(self, timeout_s):
        step = self.script.pop(0) if self.script else None
        if isinstance(step, Exception):
            raise step
        return step

    def close(self):
        self.closed += 1


def result(app):
    outcome = OutcomeBuilder()
    app.source.contribute(outcome)
    return outcome.find(SourceResult)


def test_source_op_emits_every_frame_once_with_metadata(recording):
    app = Stream(RecordingSource(recording))
    run = app.run()
    assert [seq for seq, _ in app.sink.seen] == [0, 1, 2, 3, 4]
    assert app.sink.seen[3][1] == {"seq": 3, "pts_ns": 120_000_000}
    assert run.computes["source"] == 5, "the stream ends with its last frame, not with an empty compute"
    assert (result(app).frames, result(app).reached_end) == (5, True)
    assert result(app).description.name == recording.name


def test_source_op_opens_source_after_threads_are_prepared(camera, frame, monkeypatch):
    """Frames of a live source arrive once the source is open, and an earlier frame would wait for the slowest operator."""
    events = []
    source = Scripted([frame(0)], camera)
    monkeypatch.setattr(source, "open", lambda: events.append("source opened"))
    monkeypatch.setattr(Collect, "prepare_thread", lambda self: events.append("thread prepared"))
    app = Stream(source)
    app.scheduler(MultiThreadScheduler(app))
    app.run()
    assert events == ["thread prepared", "source opened"]
    assert [seq for seq, _ in app.sink.seen] == [0]


def test_source_op_stop_request_delivers_emitted_frames(recording):
    app = Stream(RecordingSource(recording), stop_requested=lambda: app.source.emitted >= 2)
    app.run()
    assert [seq for seq, _ in app.sink.seen] == [0, 1]
    assert (result(app).frames, result(app).reached_end) == (2, False)


def test_source_op_ends_if_recording_has_fewer_frames_than_stated(recording, monkeypatch):
    monkeypatch.setattr(type(recording), "frame_count", property(lambda self: 9))
    app = Stream(RecordingSource(recording))
    app.run()
    assert (result(app).frames, result(app).reached_end) == (5, True)


def test_source_op_waits_for_stall_and_accepts_missing_numbers(camera, frame):
    source = Scripted([frame(0), None, None, frame(3), None, frame(9)], camera)
    app = Stream(source)
    app.run()
    assert [seq for seq, _ in app.sink.seen] == [0, 3, 9]
    assert (source.opened, source.closed) == (1, 1)
    assert result(app).reached_end


def test_source_op_without_frames_ends_on_stop_request(camera):
    source = Scripted([None] * 10_000, camera)
    app = Stream(source, stop_requested=lambda: len(source.script) < 9_900)
    app.run()
    assert app.sink.seen == [] and not result(app).reached_end and source.closed == 1


def test_source_op_ends_after_time_limit_without_frames(camera, frame):
    app = Stream(Scripted([None] * 100_000, camera), seconds=0.05)
    app.run()
    assert app.sink.seen == [] and not result(app).reached_end


@pytest.mark.parametrize("second", [0, 1])
def test_source_op_refuses_non_increasing_frame_numbers(camera, frame, second):
    with pytest.raises(OperatorFailed, match=f"frame {second} came after frame 1; a source's numbers must increase"):
        Stream(Scripted([frame(1), frame(second)], camera)).run()


def test_source_op_error_closes_source(camera, frame):
    source = Scripted([frame(0), ValueError("the file ends here")], camera)
    with pytest.raises(OperatorFailed, match=r"operator 'source' failed in compute.*the file ends here"):
        Stream(source).run()
    assert source.closed == 1


class Reporting(Scripted):
    """A source that says what it dropped and why it gives nothing; a string in its script is a state."""

    current = SourceState.LIVE

    @property
    def state(self):
        return self.current if self.script else SourceState.ENDED

    @property
    def state_sentence(self):
        return f"the camera is {self.state.value}"

    def counts(self):
        return {"too_late": 3}

    def read(self, timeout_s):
        step = super().read(timeout_s)
        if isinstance(step, SourceState):
            self.current = step
            return None
        return step


def test_source_op_contributes_states_and_counts(camera, frame):
    script = [frame(0), SourceState.STALLED, None, SourceState.RECONNECTING, None, frame(1), SourceState.LIVE, frame(2)]
    app = Stream(Reporting(script, camera))
    app.run()
    found = result(app)
    assert [seq for seq, _ in app.sink.seen] == [0, 1, 2] and found.reached_end
    assert found.counts == {"too_late": 3} and set(found.state_s) == {"stalled", "reconnecting"}
    assert all(seconds >= 0 for seconds in found.state_s.values()) and found.state_sentence == "the camera is ended"
    outcome = OutcomeBuilder()
    app.source.contribute(outcome)
    assert "the source scripted dropped or repaired: too_late 3" in outcome.notes


@pytest.mark.parametrize("error", [None, ValueError("unplugged")])
def test_displayed_state_is_ended_only_after_source_failure(camera, frame, error):
    app = Stream(Scripted([frame(0), *([] if error is None else [error])], camera))
    try:
        app.run()
    except OperatorFailed:
        assert error is not None
    assert app.given.state is SourceState.ENDED
    assert app.source.displayed_state is (SourceState.LIVE if error is None else SourceState.ENDED)


@pytest.mark.parametrize("state", [SourceState.STALLED, SourceState.RECONNECTING])
def test_displayed_state_shows_stall_and_reconnection(camera, frame, state):
    app = Stream(Reporting([frame(0), state, None, frame(1)], camera))
    seen = []
    read = app.given.read
    app.given.read = lambda timeout_s: (seen.append(app.source.displayed_state), read(timeout_s))[1]
    app.run()
    assert state in seen and app.source.displayed_state is SourceState.LIVE
