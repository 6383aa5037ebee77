"""`LearnedPrior`: prediction of the next motion on synthetic streams."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
import torch

from gsplat_core.experimental.learned_prior import LearnedPrior
from gsplat_core.models import Model
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from tests.gsplat_core.training.continuation_checks import check_published_continuations
from tests.gsplat_core.training.test_motion_prior import CAMERA, INTERVAL_S, SIZE, picture, scored, stream


def learner(prior: str = "learned", device: str = "cpu") -> Reconstructor:
    config = ReconstructorConfig(
        gaussians=700, max_gaussians=900, motion_prior=prior, start_from_motion=True, history_s=1.0, preallocate=True
    )
    return Reconstructor(config, CAMERA, device=device)


def learned(reconstructor: Reconstructor, frames: Iterable[Frame], steps: int = 4) -> Model:
    for frame in frames:
        reconstructor.observe(frame, steps=steps if frame.seq else 60)
    published = reconstructor.publish()
    assert isinstance(published, Model)
    return published


def beat(frame: int) -> float:
    """A motion that comes again every 9 frames, most of it in a few of them."""
    return float(4.0 * np.exp(-(((frame % 9) - 4) ** 2) / 2.0))


def causal_db(prior: str, shift_px: Callable[[int], float], frames: int, scored_frames: int) -> float:
    """Mean over the last predictions of a stream."""
    reconstructor, scores = learner(prior), []
    for frame in stream([shift_px(seq) for seq in range(frames)]):
        if frame.seq >= frames - scored_frames:
            model = reconstructor.publish()
            assert isinstance(model, Model)
            scores.append(scored(model, frame.time_s, frame.image))
        reconstructor.observe(frame, steps=4 if frame.seq else 60)
    return float(np.mean(scores))


@pytest.mark.slow
def test_learned_prior_predicts_beat_better_than_flow_prior() -> None:
    flow, of_beat = (causal_db(prior, beat, 46, 9) for prior in ("flow", "learned"))
    assert of_beat > flow + 3.0


@pytest.mark.slow
def test_learned_prior_predicts_constant_velocity_like_flow_prior() -> None:
    flow, of_velocity = (causal_db(prior, lambda frame: 0.8 * frame, 12, 5) for prior in ("flow", "learned"))
    assert of_velocity > flow - 0.2


@pytest.mark.slow
def test_learned_prior_keeps_still_scene_still() -> None:
    model = learned(learner(), stream([0.0] * 12))
    newest_s = 11 * INTERVAL_S
    moved = model.at(newest_s + INTERVAL_S).means - model.at(newest_s).means
    assert float(moved.abs().max()) * CAMERA.K[0, 0] / float(model.at(newest_s).means[:, 2].min()) < 0.02
    assert scored(model, newest_s + INTERVAL_S, picture(0.0)) > scored(model, newest_s, picture(0.0)) - 0.1


def test_learned_prior_does_not_continue_jump() -> None:
    model = learned(learner(), stream([0.0, 0.2, 0.4, 0.6, 6.0]))
    newest_s = 4 * INTERVAL_S
    assert torch.equal(model.at(newest_s).means, model.at(newest_s + INTERVAL_S).means)


def test_learned_prior_predicts_next_frame_only() -> None:
    model = learned(learner(), stream([0.0, 1.0, 2.0]))
    newest_s = 2 * INTERVAL_S
    next_means = model.at(newest_s + INTERVAL_S).means
    assert not torch.equal(model.at(newest_s).means, next_means)
    torch.testing.assert_close(next_means, model.at(newest_s + 5.0).means)


@pytest.mark.slow
def test_learned_prior_equals_flow_prior_for_moving_camera() -> None:
    models = []
    for prior in ("flow", "learned"):
        frames = []
        for frame in stream([0.0, 1.0, 2.0, 3.0]):
            pose = np.eye(4)
            pose[0, 3] = 0.5 * frame.seq
            frames.append(frame.with_fields(pose=pose))
        models.append(learned(learner(prior), frames).at(4 * INTERVAL_S))
    assert all(torch.equal(a, b) for a, b in zip(*(model.tensors().values() for model in models), strict=True))


@pytest.mark.slow
def test_learned_prior_is_deterministic() -> None:
    first, second = (learned(learner(), stream([0.0, 1.0, 2.0, 2.5, 2.0])).at(5 * INTERVAL_S) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.tensors().values(), second.tensors().values(), strict=True))


@pytest.mark.slow
def test_learned_prior_unaffected_by_publishing() -> None:
    often, seldom = learner(), learner()
    for frame in stream([0.0, 1.0, 2.0, 3.0, 2.5]):
        for reconstructor in (often, seldom):
            reconstructor.observe(frame, steps=3)
        often.publish()
    a, b = (r.snapshot().tensors() for r in (often, seldom))
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.slow
@pytest.mark.parametrize("value", [0, 255])
def test_learned_prior_finite_for_images_without_tissue_or_light(value: int) -> None:
    frames = list(stream([0.0, 1.0, 2.0, 3.0, 4.0]))
    frames[2] = frames[2].with_fields(image=np.full((*SIZE, 3), value, np.uint8), mask=np.zeros(SIZE, np.uint8))
    model = learned(learner(), frames)
    assert all(t.isfinite().all() for t in model.at(5 * INTERVAL_S).tensors().values())


def test_learned_prior_forget_clears_learned_motion() -> None:
    reconstructor = learner()
    learned(reconstructor, stream([0.0, 1.0, 2.0]))
    step, prior = reconstructor._step, reconstructor._motion.prior
    assert step is not None and isinstance(prior, LearnedPrior)
    assert prior.velocity(step) is not None
    prior.forget()
    assert prior.velocity(step) is None


def test_learned_prior_published_states_have_own_continuation(device: str) -> None:
    check_published_continuations(learner(device=device), stream([0.0, 1.0, 2.2, 3.0, 3.1]), CAMERA, INTERVAL_S)
