"""Live training: displayed frames, scene changes after missed frames, and work that is done despite little time."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from gsplat_core.io.sessions.records import SceneBegun
from gsplat_core.scene.frames import FrameStatus
from operators.depth import TakenDepth
from operators.frame_clock import BehindGuard, ClockSettings, FrameClock
from operators.outcome import OutcomeBuilder
from operators.reconstruct import ModelResult, ReconstructOp
from operators.training import GROWN_AT_LATEST, UntilDisplay


class FakeReconstructor:
    """Writes down what it is asked to do."""

    def __init__(self, make_model, camera):
        self.calls, self.version, self.make_model = [], 0, make_model
        self.gone, self.doubtful = set(), {}
        self.camera, self.device, self.step_ns = camera, torch.device("cpu"), 1e6
        self.eyes = SimpleNamespace(trained="both")

    def observe(self, frame, *, budget, train, doubtful, stop_requested=None):
        self.calls.append(("observe", frame.seq, train))
        self.doubtful[frame.seq] = doubtful
        return SimpleNamespace(steps=3 if train else 0, arriving_loss=None)

    def publish(self):
        self.version += 1
        return self.make_model(self.version)

    def whole_model(self, shown):
        return self.make_model(shown.version + 100)

    def with_depth_errors(self, model):
        return model

    def begin_scene(self, frame, *, anew=False):
        self.calls.append(("begin_scene", frame.seq, anew) if anew else ("begin_scene", frame.seq))
        return False

    def grow(self, frame):
        self.calls.append(("grow", frame.seq))

    def rehearse(self, steps):
        self.calls.append(("rehearse", steps))

    def rehearsal_ns(self, steps):
        return 1e6 * steps

    def take_depth(self, frame, late):
        self.calls.append(("take_depth", frame.seq, late))
        return frame.seq not in self.gone

    def seqs(self, kind):
        return [call[1] for call in self.calls if call[0] == kind]


class FakeDepth:
    """Depth estimator that the test controls."""

    def __init__(self):
        self.offered, self.found = [], None

    def offer(self, frame):
        self.offered.append(frame.seq)

    def take(self):
        found, self.found = self.found, None
        return found


@pytest.fixture
def live(model, camera, fake_time):
    """Return the operator, its fake reconstructor, and the calls that its recorder receives."""
    fake, lines, depths = FakeReconstructor(model, camera), [], []
    recorder = SimpleNamespace(line=lines.append, depth=depths.append)
    clock = FrameClock(ClockSettings(), 30.0, fake_time)
    clock.wait_until_shown = lambda: None
    depth = FakeDepth()
    guard = BehindGuard()
    operator = ReconstructOp(
        None, make_reconstructor=lambda: fake, training=UntilDisplay(clock, depth, guard), recorder=recorder
    )
    operator.start()
    return SimpleNamespace(
        operator=operator, fake=fake, lines=lines, depths=depths, time=fake_time, depth=depth, clock=clock, guard=guard
    )


def arrived(frame, live, seq, **fields):
    return frame(seq, arrived_ns=live.time.ns, **fields)


@pytest.fixture
def one_by_one(live, frame, compute_queued):
    """Hand frames over, each when it comes, with time for rehearsal in between."""

    def hand(*given):
        shown = []
        for seq, fields in given:
            live.time.pass_ms(33)
            rehearse = live.fake.rehearse

            def rehearsed(steps, rehearse=rehearse):
                rehearse(steps)
                live.time.pass_ms(4)

            live.fake.rehearse = rehearsed
            shown += compute_queued(live.operator, frame=[arrived(frame, live, seq, **fields)])
            live.fake.rehearse = rehearse
        return shown

    return hand


def test_withheld_frame_shows_earlier_content(live, one_by_one):
    shown = one_by_one((0, {}), (1, {"withheld": "smoke"}))
    assert [(each.trained, each.content.seq) for each in shown] == [(True, 0), (False, 0)]
    assert live.operator.counts.withheld == {"smoke": 1}


@pytest.mark.parametrize("reason", ["blur", "cut in doubt"])
def test_doubtful_frame_is_trained_on_without_depth_or_growth(live, one_by_one, reason):
    shown = one_by_one((0, {}), (1, {}), (2, {"withheld": reason}), (3, {}))
    assert [(each.trained, each.content.seq) for each in shown] == [(True, 0), (True, 1), (True, 2), (True, 3)]
    assert live.fake.doubtful == {0: False, 1: False, 2: True, 3: False}
    assert live.fake.seqs("grow") == [1, 2, 3] and live.depth.offered == [0, 1, 3]
    assert live.operator.counts.withheld == {reason: 1}


def test_damaged_frame_is_not_trained_on(live, one_by_one):
    shown = one_by_one((0, {}), (1, {"withheld": "blur", "status": FrameStatus.DAMAGED}))
    assert [(each.trained, each.content.seq) for each in shown] == [(True, 0), (False, 0)]


def test_withheld_frame_does_not_start_scene(live, one_by_one):
    assert one_by_one((0, {"withheld": "black"})) == []
    assert live.fake.calls == []


@pytest.mark.parametrize("missed", [[], [(1, {"new_scene": "cut", "scene": 1, "withheld": "no tissue"})]])
def test_scene_begins_with_first_usable_frame(live, one_by_one, missed):
    one_by_one((0, {}), *missed, (2, {"scene": 1}), (3, {"scene": 1}))
    assert live.fake.seqs("begin_scene") == [2]


def test_behind_model_is_renewed_at_next_usable_frame(live, one_by_one, frame):
    one_by_one((0, {}))
    for seq in range(3):
        live.guard.judge(frame(seq), frame(seq).image if seq == 0 else 255 - frame(seq).image)
    assert live.guard.renewal_is_due()
    shown = one_by_one((3, {"withheld": "blur"}), (4, {}), (5, {}))
    assert [call for call in live.fake.calls if call[0] == "begin_scene"] == [("begin_scene", 4, True)]
    assert [(line.seq, line.anew) for line in live.lines if isinstance(line, SceneBegun)] == [(4, True)]
    assert live.operator.counts.renewed == 1 and len(shown) == 3


def test_continuing_scene_begins_once(live, one_by_one):
    one_by_one((0, {}), (1, {"new_scene": "cut", "scene": 1}), (2, {"scene": 1}))
    assert live.fake.seqs("begin_scene") == [1]


def test_scene_grows_in_spare_time_except_on_first_frame(live, one_by_one):
    one_by_one((0, {}), (1, {}), (2, {}), (3, {"new_scene": "cut", "scene": 1}), (4, {"scene": 1}))
    assert live.fake.seqs("grow") == [1, 2, 4]


def test_scene_grows_periodically_without_spare_time(live, frame, compute_queued):
    for seq in range(3 * GROWN_AT_LATEST):
        live.time.pass_ms(33)
        compute_queued(live.operator, frame=[frame(seq, arrived_ns=live.time.ns - 100_000_000)])
    assert live.fake.seqs("grow") == [GROWN_AT_LATEST * k for k in (1, 2)]
    assert not live.fake.seqs("rehearse")


def test_recorder_receives_every_training_call_in_order(live, one_by_one):
    one_by_one((0, {}), (1, {"new_scene": "cut", "scene": 1}))
    kinds = [line.event for line in live.lines]
    made = [call[0] for call in live.fake.calls]
    assert [kind for kind in kinds if kind != "rehearse"] == [kind for kind in made if kind != "rehearse"]
    steps = sum(line.steps for line in live.lines if line.event == "rehearse")
    assert steps == sum(live.fake.seqs("rehearse")) == live.operator.counts.rehearsed > 0


def test_stop_keeps_whole_model(live, one_by_one):
    one_by_one((0, {}), (1, {}))
    assert live.operator.model is None
    live.operator.stop()
    assert live.operator.model is live.operator.newest and live.operator.model.version == 102
    outcome = OutcomeBuilder()
    live.operator.contribute(outcome)
    assert outcome.find(ModelResult).model is live.operator.model
    assert live.operator.parameter_count == live.operator.model.parameter_count > 0


def test_live_run_without_frames_has_no_model(live):
    live.operator.stop()
    assert live.operator.model is None and live.operator.parameter_count == 0


def test_request_model_is_answered_after_next_frame(live, one_by_one):
    request = live.operator.request_model()
    assert request.wait(0) is None
    shown = one_by_one((0, {}), (1, {}))
    answer = request.wait(0)
    assert (answer.model.version, answer.frame.seq) == (101, 0) and answer.pause_ns >= 0
    assert [each.model.version for each in shown] == [1, 2]


def test_request_model_failure_does_not_end_stream(live, one_by_one):
    def fails(shown):
        raise MemoryError("there is none")

    whole, live.fake.whole_model = live.fake.whole_model, fails
    request = live.operator.request_model()
    assert len(one_by_one((0, {}), (1, {}))) == 2
    assert request.wait(0) is None and "there is none" in request.refused
    live.fake.whole_model = whole
    late = live.operator.request_model()
    live.operator.stop()
    assert late.wait(0) is None and "ended" in late.refused


def test_depth_is_estimated_only_for_trained_frames(live, one_by_one):
    one_by_one((0, {}), (1, {"withheld": "blur"}), (2, {"status": FrameStatus.DAMAGED}), (3, {}))
    assert live.depth.offered == [0, 3]


def test_late_depth_is_trained_on_after_next_picture_and_recorded(live, one_by_one, frame):
    one_by_one((0, {}), (1, {}))
    found = arrived(frame, live, 0)
    live.depth.found = found, "ready"
    live.time.pass_ms(100)
    one_by_one((2, {}))
    kinds = [call[0] for call in live.fake.calls if call[0] != "rehearse"]
    assert kinds[-3:] == ["observe", "take_depth", "grow"] and ("take_depth", 0, "ready") in live.fake.calls
    assert live.depths == [found]
    outcome = OutcomeBuilder()
    live.operator.contribute(outcome)
    taken = outcome.find(TakenDepth)
    assert (taken.frames, taken.dropped) == (1, 0) and taken.age_p50_ms == pytest.approx(133, rel=0.04)
    assert any("the depth of 1 frames was used in training after they were shown" in note for note in outcome.notes)


def test_rejected_late_depth_is_counted_and_not_recorded(live, one_by_one, frame):
    live.fake.gone = {0}
    one_by_one((0, {}), (1, {"new_scene": "cut", "scene": 1}))
    live.depth.found = arrived(frame, live, 0), "ready"
    one_by_one((2, {"scene": 1}))
    assert live.fake.seqs("take_depth") == [0] and not live.depths
    outcome = OutcomeBuilder()
    live.operator.contribute(outcome)
    assert outcome.find(TakenDepth) == TakenDepth(0, 0.0, 1) and outcome.notes == ()


@pytest.fixture
def waits(live):
    """Write the waits for a picture down among the reconstructor's calls."""
    live.clock.wait_until_shown = lambda: live.fake.calls.append(("wait",))
    live.clock.too_late = lambda frame, waiting: False
    return live


def test_training_waits_until_picture_is_shown(waits, frame, compute_queued):
    waits.time.pass_ms(33)
    compute_queued(waits.operator, frame=[arrived(frame, waits, 0)])
    kinds = [call[0] for call in waits.fake.calls]
    assert kinds[:2] == ["observe", "wait"] and kinds.count("wait") == 1


def test_picture_of_every_frame_is_waited_for_also_of_first_one_of_scene(live, one_by_one):
    awaited = []
    live.clock.wait_until_shown = lambda: awaited.append(not live.clock._shown.is_set())
    for seq, scene in enumerate([{}, {}, {"new_scene": "cut", "scene": 1}, {"scene": 1}]):
        one_by_one((seq, scene))
        live.clock.shown(live.time.ns, live.time.ns)
    assert awaited == [True] * 4


def test_queued_frame_is_trained_on_before_wait_and_rehearsal(waits, frame, compute_queued):
    waits.time.pass_ms(33)
    came = [arrived(frame, waits, seq) for seq in range(3)]
    for first in range(3):
        compute_queued(waits.operator, frame=came[first:])
    kinds = [call[0] for call in waits.fake.calls]
    observed = [number for number, kind in enumerate(kinds) if kind == "observe"]
    assert len(observed) == 3 and observed == list(range(observed[0], observed[0] + 3))
    assert kinds[observed[-1] + 1] == "wait" and kinds.count("wait") == 1
