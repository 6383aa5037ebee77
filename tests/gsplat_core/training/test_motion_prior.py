"""Motion predicted after the newest frame of moving, still and interrupted streams."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.motion_prior import HORIZON_S, FlowPrior, new_motion_prior, widened
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from tests.gsplat_core.training.continuation_checks import check_published_continuations

SIZE = 64, 96
CAMERA = Camera.from_focal(90.0, SIZE[1], SIZE[0])
INTERVAL_S = 1 / 30


def picture(shift_px: float, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
    """A smooth random texture, moved to the right."""
    field = np.random.default_rng(0).uniform(0, 255, (160, 240, 3)).astype(np.float32)
    smooth = cv2.normalize(cv2.GaussianBlur(field, (0, 0), 3.0), np.empty(0), 40, 220, cv2.NORM_MINMAX)
    moved = cv2.warpAffine(smooth, np.array([[1, 0, shift_px - 60], [0, 1, -40]], np.float32), SIZE[::-1])
    moved += np.random.default_rng(seed).normal(0, 1, moved.shape).astype(np.float32) * noise
    return np.clip(np.rint(moved), 0, 255).astype(np.uint8)


def stream(shifts_px: list[float], times_s: list[float] | None = None, noise: float = 0.0) -> Iterator[Frame]:
    for seq, shift_px in enumerate(shifts_px):
        time_s = seq * INTERVAL_S if times_s is None else times_s[seq]
        yield Frame(seq, round(time_s * 1e9), picture(shift_px, noise, seq))


def learner(prior: str = "flow", **settings: object) -> Reconstructor:
    config = ReconstructorConfig(gaussians=700, max_gaussians=900, motion_prior=prior, **settings)  # type: ignore[arg-type]
    return Reconstructor(config, CAMERA)


def learned(reconstructor: Reconstructor, frames: Iterator[Frame], steps: int = 8) -> Model:
    for seq, frame in enumerate(frames):
        reconstructor.observe(frame, steps=steps if seq else 60)
    published = reconstructor.publish()
    assert isinstance(published, Model)
    return published


def scored(model: Model, time_s: float, target: NDArray[np.uint8]) -> float:
    inner = np.zeros(SIZE, np.uint8)
    inner[6:-6, 12:-6] = 1  # without what enters the picture
    return psnr_tissue_db(model.render(time_s, depth=False).image.clamp(0, 1), target, inner)


@pytest.mark.parametrize("start_from_motion", [False, True])
def test_flow_prior_predicts_constant_velocity(start_from_motion: bool) -> None:
    shifts = [1.2 * k for k in range(7)]
    model = learned(learner(start_from_motion=start_from_motion), stream(shifts[:-1]))
    newest_s, next_picture = 5 * INTERVAL_S, picture(shifts[-1])
    hold, predicted = (scored(model, t, next_picture) for t in (newest_s, newest_s + INTERVAL_S))
    assert predicted > hold + 1.0


def test_start_from_motion_improves_single_step_training() -> None:
    shifts = [0.0, 1.0, 2.0, 4.5]
    gains = []
    for start_from_motion in (False, True):
        model = learned(learner(start_from_motion=start_from_motion), stream(shifts), steps=1)
        gains.append(scored(model, 3 * INTERVAL_S, picture(shifts[-1])))
    assert gains[1] > gains[0] + 1.0


def test_flow_prior_does_not_amplify_noise() -> None:
    model = learned(learner(), stream([0.0] * 6, noise=6.0))
    newest_s, clean = 5 * INTERVAL_S, picture(0.0)
    assert scored(model, newest_s + INTERVAL_S, clean) > scored(model, newest_s, clean) - 0.1


def test_flow_prior_does_not_continue_jump() -> None:
    model = learned(learner(), stream([0.0, 0.2, 0.4, 0.6, 6.0]))
    newest_s = 4 * INTERVAL_S
    assert torch.equal(model.at(newest_s).means, model.at(newest_s + INTERVAL_S).means)


def test_flow_prior_has_no_velocity_after_time_gap() -> None:
    model = learned(learner(), stream([0.0, 1.0, 2.0], [0.0, INTERVAL_S, 2.0]))
    assert torch.equal(model.at(2.0).means, model.at(2.0 + INTERVAL_S).means)


def test_flow_prior_velocity_is_per_time_not_per_frame() -> None:
    model = learned(learner(), stream([0.0, 1.0, 3.0], [0.0, INTERVAL_S, 3 * INTERVAL_S]))
    newest_s = 3 * INTERVAL_S
    whole = model.at(newest_s + 2 * INTERVAL_S).means - model.at(newest_s).means
    half = model.at(newest_s + INTERVAL_S).means - model.at(newest_s).means
    torch.testing.assert_close(half * 2, whole, rtol=1e-3, atol=1e-5)
    moved_px = float((half[:, 0] / model.at(newest_s).means[:, 2]).median()) * 90
    assert 0.4 < moved_px < 0.8  # one pixel an interval, damped


def test_flow_prior_prediction_ends_at_horizon() -> None:
    model = learned(learner(), stream([0.0, 1.0, 2.0]))
    newest_s = 2 * INTERVAL_S
    assert torch.equal(model.at(newest_s + HORIZON_S).means, model.at(newest_s + 5.0).means)


@pytest.mark.slow
def test_prediction_of_untrained_frame_ignores_its_picture() -> None:
    shown = []
    for seed in (0, 1):
        reconstructor = learner()
        learned(reconstructor, stream([0.0, 1.0, 2.0]))
        unseen = Frame(3, round(3 * INTERVAL_S * 1e9), picture(20.0 * seed, 30.0 * seed, seed))
        reconstructor.observe(unseen, train=False)
        model = reconstructor.publish()
        assert isinstance(model, Model)
        shown.append(model.at(3 * INTERVAL_S).means - model.at(2 * INTERVAL_S).means)
    assert torch.equal(shown[0], shown[1])
    assert shown[0].abs().max() > 0


@pytest.mark.slow
def test_motion_prior_training_is_deterministic() -> None:
    first, second = (
        learned(learner(start_from_motion=True), stream([0.0, 1.0, 2.0, 2.5])).at(4 * INTERVAL_S) for _ in range(2)
    )
    assert all(torch.equal(a, b) for a, b in zip(first.tensors().values(), second.tensors().values(), strict=True))


def test_publishing_does_not_change_training() -> None:
    """Publishing or not, and how often, changes no later model."""
    often, seldom = learner(), learner()
    for frame in stream([0.0, 1.0, 2.0, 3.0]):
        for reconstructor in (often, seldom):
            reconstructor.observe(frame, steps=4)
        often.publish()
    assert often.snapshot().sha256() != ""
    a, b = (r.snapshot().tensors() for r in (often, seldom))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_bumps_prior_has_no_continuation() -> None:
    model = learned(learner("bumps"), stream([0.0, 1.0, 2.0]))
    assert model.field is not None and model.field.continuation is None


def test_flow_prior_handles_new_gaussians_and_forget() -> None:
    reconstructor = learner(start_from_motion=True)
    learned(reconstructor, stream([0.0, 1.0, 2.0]))
    step, prior = reconstructor._step, reconstructor._motion.prior
    assert step is not None and isinstance(prior, FlowPrior)
    step.append(step.gaussians.select(slice(0, 10)).clone())
    published = reconstructor.publish()
    assert published.gaussians.count == step.gaussians.count
    assert isinstance(published, Model) and published.at(3 * INTERVAL_S).means.isfinite().all()
    prior.forget()
    assert prior.velocity(step) is None


def test_flow_prior_of_degenerate_pictures_gives_finite_model() -> None:
    reconstructor = learner(start_from_motion=True, depth_from_motion=True)
    frames = list(stream([0.0, 1.0, 2.0, 3.0]))
    black, white = (np.full((*SIZE, 3), value, np.uint8) for value in (0, 255))
    frames[1] = frames[1].with_fields(image=black)
    frames[2] = frames[2].with_fields(image=white, mask=np.zeros(SIZE, np.uint8))
    model = learned(reconstructor, iter(frames))
    assert all(t.isfinite().all() for t in model.at(4 * INTERVAL_S).tensors().values())


def test_hexplane_field_has_no_motion_prior() -> None:
    reconstructor = learner(field="hexplane")
    reconstructor.observe(next(stream([0.0])), steps=1)
    assert reconstructor._motion.prior is None


def test_unknown_motion_prior_is_refused() -> None:
    with pytest.raises(InvalidSetting, match="motion prior"):
        learner("psychic")


def test_widened_scale_grows_with_motion_up_to_bound() -> None:
    log_scales = torch.zeros(3, 3)
    added = widened(log_scales, torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1e4, 0.0, 0.0]]))
    assert not added[0].any()
    assert 0 < float(added[1, 0]) < float(added[2, 0]) < 1.0


def test_config_selects_motion_prior() -> None:
    field = learner()
    field.observe(next(stream([0.0])), steps=1)
    assert field._step is not None
    assert isinstance(new_motion_prior(ReconstructorConfig(motion_prior="flow"), field._step.field), FlowPrior)


def test_published_snapshots_keep_own_continuation(device: str) -> None:
    """Slots and captured frames read the continuation in place and show the same as a model of the same state."""
    config = ReconstructorConfig(
        gaussians=700, max_gaussians=900, motion_prior="flow", start_from_motion=True, history_s=1.0, preallocate=True
    )
    check_published_continuations(
        Reconstructor(config, CAMERA, device=device), stream([0.0, 1.0, 2.2, 3.0, 3.1]), CAMERA, INTERVAL_S
    )


@pytest.mark.parametrize("start_from_motion", [False, True])
def test_live_published_model_equals_whole_model(start_from_motion: bool) -> None:
    config = ReconstructorConfig(
        gaussians=700, max_gaussians=900, motion_prior="flow", start_from_motion=start_from_motion, history_s=1.0
    )
    reconstructor = Reconstructor(config, CAMERA, live=LiveTraining())
    for seq, frame in enumerate(stream([0.0, 1.0, 2.2, 3.0, 3.1])):
        trained = seq != 3
        reconstructor.observe(frame, steps=4, train=trained)
        shown, whole = reconstructor.publish(), reconstructor.snapshot()
        assert isinstance(shown, Model) and shown.version == whole.version - 1
        assert shown.parameter_count < whole.parameter_count == reconstructor.parameter_count
        for later_s in (0.0, 0.5 * INTERVAL_S, INTERVAL_S, HORIZON_S, 5.0):
            seen, wanted = (each.at(frame.time_s + later_s).tensors() for each in (shown, whole))
            for name in wanted:
                torch.testing.assert_close(seen[name], wanted[name], rtol=1e-5, atol=1e-5)
        before = shown.sha256()
        if trained:
            reconstructor.grow(frame)
            reconstructor.rehearse(1)
        assert shown.sha256() == before
        assert reconstructor.whole_model(shown).field is not None


def test_live_published_model_is_whole_without_motion_prior() -> None:
    reconstructor = Reconstructor(ReconstructorConfig(gaussians=700, max_gaussians=900), CAMERA, live=LiveTraining())
    assert reconstructor.parameter_count == 0
    with pytest.raises(InvalidInput, match="no model yet"):
        reconstructor.publish()
    for frame in stream([0.0, 1.0]):
        reconstructor.observe(frame, steps=2)
    assert reconstructor.publish().parameter_count == reconstructor.snapshot().parameter_count


@pytest.mark.parametrize(
    ("moved_px", "is_sudden", "usual_px"), [(1.0, False, 0.28), (1.01, True, 0.28), (0.4, False, 0.22)]
)
def test_flow_prior_sudden_motion_threshold(moved_px, is_sudden, usual_px):
    prior = FlowPrior(ReconstructorConfig())
    prior._judge(0.2)
    assert prior._usual_px == pytest.approx(0.2) and not prior._is_sudden
    prior._judge(moved_px)
    assert prior._is_sudden == is_sudden and prior._usual_px == pytest.approx(usual_px)


@pytest.mark.parametrize(("interval_s", "is_usable"), [(0.0, False), (-0.1, False), (0.15, True), (0.1501, False)])
def test_flow_prior_ignores_frames_over_150_ms_apart(interval_s, is_usable):
    prior = FlowPrior(ReconstructorConfig())
    prior._motion, prior._interval_s = "motion", interval_s
    assert (prior._usable_motion() == "motion") == is_usable
    assert prior.horizon_s == 0.15


def test_widened_variance_adds_a_twentieth_of_squared_motion():
    """Variances add: a Gaussian of width 1 that moved by 2 has 1 + 0.05 * 4."""
    found = widened(torch.tensor([[0.0, math.log(10.0), -9.0]]), torch.tensor([[2.0, 0.0, 0.0]]))
    torch.testing.assert_close(found, torch.tensor([[0.5 * math.log(1.2), 0.5 * math.log(1.002), 0.7]]))
