"""A frame is displayed with the model right after its own training steps."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from gsplat_core.models import Model, Snapshot, SnapshotSlots
from gsplat_core.scene.frames import FrameStatus
from gsplat_core.transfers import HostCopy
from operators.outcome import OutcomeBuilder
from operators.reconstruct import ReconstructOp
from operators.training import EveryFrame
from tests.operators.conftest import HEIGHT, WIDTH


class FakeReconstructor:
    """Writes down what it is asked to do."""

    eyes = SimpleNamespace(trained="both")
    camera = SimpleNamespace(width_px=WIDTH, height_px=HEIGHT)

    def __init__(self, make_model):
        self.calls = []
        self.version = 0
        self.make_model = make_model

    def observe(self, frame, *, budget=None, train=True, doubtful=False, stop_requested=None):
        self.calls.append(("observe", frame.seq, train))
        return SimpleNamespace(
            seq=frame.seq,
            steps=7 if train else 0,
            arriving_loss=HostCopy(torch.tensor(0.5)) if train else None,
            gaussians=60,
        )

    def publish(self):
        self.version += 1
        self.calls.append(("publish", self.version))
        return self.make_model(self.version)

    def begin_scene(self, frame):
        self.calls.append(("begin_scene", frame.seq))
        return False

    def whole_model(self, shown):
        return shown.as_model()

    def with_depth_errors(self, model):
        return model


def test_reconstruct_trains_on_frame_before_snapshot(frame, model, compute):
    fake = FakeReconstructor(model)
    operator = ReconstructOp(None, make_reconstructor=lambda: fake, training=EveryFrame())
    operator.start()
    messages = [compute(operator, frame=frame(k))[0] for k in range(2)]
    assert fake.calls == [("observe", 0, True), ("publish", 1), ("observe", 1, True), ("publish", 2)]
    assert [(m.frame.seq, m.model.version, m.steps, m.loss, m.trained) for m in messages] == [
        (0, 1, 7, 0.5, True),
        (1, 2, 7, 0.5, True),
    ]
    assert operator.newest is messages[-1].model


def test_reconstruct_passes_heldout_frames_without_training(frame, model, compute):
    fake = FakeReconstructor(model)
    operator = ReconstructOp(None, make_reconstructor=lambda: fake, training=EveryFrame(lambda f: f.seq == 1))
    operator.start()
    messages = [compute(operator, frame=frame(k))[0] for k in range(3)]
    assert [m.trained for m in messages] == [True, False, True]
    assert [call for call in fake.calls if call[0] == "observe"] == [
        ("observe", 0, True),
        ("observe", 1, False),
        ("observe", 2, True),
    ]
    assert (messages[1].steps, messages[1].loss) == (0, None)


def test_reconstruct_without_clock_shows_withheld_frames_and_starts_scene(frame, model, compute):
    fake = FakeReconstructor(model)
    operator = ReconstructOp(None, make_reconstructor=lambda: fake, training=EveryFrame())
    operator.start()
    frames = [
        frame(0, withheld="black"),
        frame(1),
        frame(2, withheld="smoke"),
        frame(3, status=FrameStatus.DAMAGED),
        frame(4, new_scene="cut", scene=1, withheld="smoke"),
        frame(5, scene=1),
    ]
    shown = [message for each in frames for message in compute(operator, frame=each)]
    assert [(message.frame.seq, message.trained, message.content.seq) for message in shown] == [
        (1, True, 1),
        (2, False, 1),
        (3, False, 1),
        (5, True, 5),
    ]
    assert ("begin_scene", 5) in fake.calls and fake.calls.count(("begin_scene", 5)) == 1
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert outcome.notes == (
        "4 frames were withheld and not scored (black: 1, damaged: 1, smoke: 2)",
        "the frames show 2 scenes (begun by a frame that was not used: 1); the saved model is that of the last one",
    )


def test_reconstruct_trains_on_first_frame_even_if_held_out(frame, model, compute):
    operator = ReconstructOp(
        None, make_reconstructor=lambda: FakeReconstructor(model), training=EveryFrame(lambda f: True)
    )
    operator.start()
    assert [compute(operator, frame=frame(k))[0].trained for k in range(2)] == [True, False]


def test_reconstruct_creates_reconstructor_at_start_and_keeps_model(frame, model, compute):
    made = []

    def make():
        made.append(FakeReconstructor(model))
        return made[-1]

    operator = ReconstructOp(None, make_reconstructor=make, training=EveryFrame())
    assert made == []
    operator.start()
    compute(operator, frame=frame())
    operator.stop()
    assert len(made) == 1 and operator.model.version == 1


def test_reconstruct_model_copies_snapshot_and_releases_slots(frame, model, camera, compute):
    slots = SnapshotSlots("cpu")

    def publish(version):
        gaussians = model(version, index=version).gaussians
        return slots.publish(gaussians, None, version=version, camera=camera, time_window_s=(0.0, 1.0))

    operator = ReconstructOp(None, make_reconstructor=lambda: FakeReconstructor(publish), training=EveryFrame())
    operator.start()
    messages = [compute(operator, frame=frame(k))[0] for k in range(2)]
    assert [type(message.model) for message in messages] == [Snapshot, Snapshot]
    assert operator.newest is messages[-1].model
    del messages
    operator.stop()
    assert isinstance(operator.model, Model) and operator.model.version == 2
    assert torch.equal(operator.model.gaussians.means, model(2, index=2).gaussians.means)
    assert all(slot.is_free for slot in slots._slots), "the last slot is given up when the graph stops"
