"""Losses chosen by name: their weights, their effect on a step, and the context that they receive."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.choices import LOSSES
from gsplat_core.deformation import BasisField, HexPlaneField
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.training.config import LearningRates, ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.losses import EVERY, LossContext, loss_weights
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.steps.photometric import LossWeights, loss_and_gradients
from gsplat_core.training.steps.step import TrainingStep

SEEN_BY_THE_LOSS = []


class SmallOpacities:
    """Mean opacity logit, as an example of a loss; records the context."""

    name = "small_opacities"
    default_weight = 2.0

    def __call__(self, scene, observation, context):
        SEEN_BY_THE_LOSS.append((observation.seq, [each.seq for each in context.frames], context.at(0.0).count))
        return scene.logit_opacities.mean() if observation.seq < 100 else None


COMPARED_RAYS = []


class NearSurface:
    """Mean depth of the rays, as an example of a loss of rays; records the sizes of the compared pictures."""

    name = "near_surface"
    default_weight = 1.0
    needs_depth = False

    def compare(self, rays):
        COMPARED_RAYS.append(tuple(rays.depths.shape))
        return torch.where(rays.tissue, rays.depths, 0).mean()


@pytest.fixture
def small_opacities(monkeypatch):
    monkeypatch.setattr(LOSSES, "_entries", {**LOSSES._entries, "small_opacities": SmallOpacities})
    SEEN_BY_THE_LOSS.clear()


@pytest.fixture
def near_surface(monkeypatch):
    monkeypatch.setattr(LOSSES, "_entries", {**LOSSES._entries, "near_surface": NearSurface})
    COMPARED_RAYS.clear()


@pytest.fixture
def make_step(make_frame, camera):
    def make(field="basis", **config):
        gaussians = gaussians_from_frame(make_frame(), camera, 300, sh_degree=0, default_depth_mm=60.0)
        torch.manual_seed(0)
        made = (
            BasisField(gaussians.count, (0.0, 1.0), bumps=8)
            if field == "basis"
            else HexPlaneField(
                gaussians, (0.0, 1.0), channels=8, resolution=(8, 8, 8, 5), levels=(1,), width=16, depth=1
            )
        )
        return TrainingStep(gaussians, made, ReconstructorConfig(field=field, gaussians=300, **config), camera)

    return make


def test_loss_weights_are_given_or_default(small_opacities):
    assert loss_weights(("photometric", "depth", "small_opacities")) == {"small_opacities": 2.0}
    assert loss_weights(("small_opacities:0.25",)) == {"small_opacities": 0.25}
    assert loss_weights(()) == {}


@pytest.mark.parametrize(
    ("losses", "message"),
    [
        (("small",), "unknown loss 'small'.*photometric"),
        (("small:0.5",), "unknown loss 'small'.*photometric"),
        (("depth:2",), "depth is always compared and weighed by depth_weight"),
        (("small_opacities", "small_opacities:1"), "twice.*small_opacities:2"),
        (("small_opacities:-1",), "positive number"),
        (("small_opacities:",), "positive number"),
        (("small_opacities:nan",), "positive number"),
    ],
)
def test_config_refuses_invalid_losses(small_opacities, losses, message):
    with pytest.raises(InvalidSetting, match=message):
        ReconstructorConfig(losses=losses)


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_named_loss_changes_training(small_opacities, make_step, make_frame, camera, field):
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    # Only opacities learn, and the loss outweighs the picture's.
    rates = LearningRates(0.0, 0.0, 0.0, 0.1, 0.0)
    with_loss = make_step(field, rates=rates, losses=("small_opacities:1000",))
    before = with_loss.gaussians.logit_opacities.clone()
    for _ in range(3):
        with_loss(seen)
    assert bool((with_loss.gaussians.logit_opacities < before - 0.2).all())


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_named_ray_loss_is_compared_every_few_steps(near_surface, make_step, make_frame, camera, field):
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    rates = LearningRates(0.5, 0.0, 0.0, 0.0, 0.0)
    plain, with_loss = make_step(field, rates=rates), make_step(field, rates=rates, losses=("near_surface:100",))
    for _ in range(2 * EVERY):
        plain(seen)
        with_loss(seen)
    assert len(COMPARED_RAYS) == 2
    nearer = plain.at(seen.time_s).means[:, 2] - with_loss.at(seen.time_s).means[:, 2]
    assert float(nearer.median()) > 0.02


def test_named_loss_value_is_added_to_step_loss(small_opacities, make_step, make_frame, camera):
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    step = make_step(losses=("small_opacities:0.5",))
    scene = step.at(seen.time_s)
    expected = loss_and_gradients(scene, seen, LossWeights(depth=0.0)).loss + 0.5 * scene.logit_opacities.mean()
    torch.testing.assert_close(step(seen), expected)


@pytest.mark.parametrize(
    ("result", "found"), [(torch.zeros(3, 2), r"\[3, 2\]"), (0.5, "float"), (np.float32(0.5), "float32")]
)
def test_loss_that_returns_no_scalar_tensor_is_refused(
    small_opacities, make_step, make_frame, camera, monkeypatch, result, found
):
    monkeypatch.setattr(SmallOpacities, "__call__", lambda *arguments: result)
    step = make_step(losses=("small_opacities",))
    with pytest.raises(InvalidInput, match=f"the loss 'small_opacities' returned {found}; it must return a tensor"):
        step(Observation.of(make_frame(4, shift_px=1), camera))


def test_loss_returning_none_changes_nothing(small_opacities, make_step, make_frame, camera):
    seen = dataclasses.replace(Observation.of(make_frame(4, shift_px=1), camera), seq=100)
    plain, with_loss = make_step(), make_step(losses=("small_opacities",))
    assert plain(seen) == with_loss(seen)
    for one, other in zip(plain.gaussians.tensors().values(), with_loss.gaussians.tensors().values(), strict=True):
        assert torch.equal(one, other)


def test_loss_context_contains_trained_frames(small_opacities, make_frame, camera):
    config = ReconstructorConfig(gaussians=300, losses=("small_opacities",), first_frame_steps=1, steps_per_frame=1)
    online = Reconstructor(config, camera)
    for seq in range(3):
        online.observe(make_frame(seq))
    assert [(seq, frames) for seq, frames, _ in SEEN_BY_THE_LOSS] == [(0, [0]), (1, [0, 1]), (2, [0, 1, 2])]
    SEEN_BY_THE_LOSS.clear()
    Reconstructor(config, camera).fit([make_frame(seq) for seq in range(3)], steps=4)
    assert {tuple(frames) for _, frames, _ in SEEN_BY_THE_LOSS} == {(0, 1, 2)}
    assert all(count >= 300 for _, _, count in SEEN_BY_THE_LOSS)


def test_photometric_and_depth_losses_sum_to_step_loss(make_step, make_frame, camera):
    step = make_step()
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    depth = torch.full(seen.image.shape[:2], 50.0)
    seen = dataclasses.replace(seen, depth=depth)
    scene, context = step.at(seen.time_s), LossContext((), step.at)
    weights = LossWeights(depth=3.0)
    together = loss_and_gradients(scene, seen, weights).loss
    alone = {name: LOSSES[name]()(scene, seen, context) for name in ("photometric", "depth")}
    torch.testing.assert_close(alone["photometric"] + 3.0 * alone["depth"], together, rtol=1e-4, atol=1e-6)
    assert LOSSES["depth"]()(scene, dataclasses.replace(seen, depth=None), context) is None


@pytest.mark.cuda
@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_named_loss_changes_training_on_cuda(gpu, small_opacities, make_frame, camera, field):
    rates = LearningRates(0.0, 0.0, 0.0, 0.1, 0.0)
    config = ReconstructorConfig(
        field=field, gaussians=300, rates=rates, losses=("small_opacities:1000",), first_frame_steps=3
    )
    online = Reconstructor(config, camera, device=gpu)
    online.observe(make_frame())
    plain = Reconstructor(dataclasses.replace(config, losses=()), camera, device=gpu)
    plain.observe(make_frame())
    lower = plain.snapshot().gaussians.logit_opacities - online.snapshot().gaussians.logit_opacities
    assert float(lower.mean()) > 0.1
    assert SEEN_BY_THE_LOSS


@pytest.mark.cuda
@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_named_ray_loss_is_captured_on_cuda(gpu, near_surface, make_frame, camera, field):
    """Python runs for few of ten comparisons: before a capture and in it."""
    rates = LearningRates(0.5, 0.0, 0.0, 0.0, 0.0)
    config = ReconstructorConfig(
        field=field, gaussians=300, rates=rates, losses=("near_surface:100",), first_frame_steps=10 * EVERY
    )
    online = Reconstructor(config, camera, device=gpu)
    online.observe(make_frame())
    plain = Reconstructor(dataclasses.replace(config, losses=()), camera, device=gpu)
    plain.observe(make_frame())
    assert 0 < len(COMPARED_RAYS) <= 4
    nearer = plain.snapshot().gaussians.means[:, 2] - online.snapshot().gaussians.means[:, 2]
    assert float(nearer.median()) > 0.02
