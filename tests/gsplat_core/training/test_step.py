"""A single training step: improved tensors, unchanged tensors, and addition of Gaussians."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.deformation import FIELDS, BasisField, HexPlaneField
from gsplat_core.training.config import LearningRates, ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.photometric import LossWeights, loss_and_gradients
from gsplat_core.training.steps.step import TrainingStep


def still(field, **learning):
    """Return rates of 0 for Gaussians and field, except for the given rates of the field."""
    none = type(FIELDS[field].rates)(**dict.fromkeys(vars(FIELDS[field].rates), 0.0))
    return LearningRates(0.0, 0.0, 0.0, 0.0, 0.0, field=dataclasses.replace(none, **learning))


@pytest.fixture
def make_step(make_frame, camera):
    """`make_step(field, rates, ssim)`: a scene started from the frame at rest."""

    def make(field="basis", rates=None, **config):
        gaussians = gaussians_from_frame(make_frame(), camera, 300, sh_degree=0, default_depth_mm=60.0)
        torch.manual_seed(0)
        window = (0.0, 1.0)
        made = (
            BasisField(gaussians.count, window, bumps=8)
            if field == "basis"
            else HexPlaneField(gaussians, window, channels=8, resolution=(8, 8, 8, 5), levels=(1,), width=16, depth=1)
        )
        settings = ReconstructorConfig(field=field, gaussians=300, rates=rates or LearningRates(), **config)
        return TrainingStep(gaussians, made, settings, camera)

    return make


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_training_step_lowers_loss_and_returns_loss_before_update(make_step, make_frame, camera, field):
    step = make_step(field)
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    expected = loss_and_gradients(step.at(seen.time_s), seen, LossWeights()).loss
    losses = [step(seen) for _ in range(25)]
    assert losses[0] == expected
    assert losses[-1] < 0.6 * losses[0]


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_training_step_with_zero_rates_changes_nothing(make_step, make_frame, camera, field):
    step = make_step(field, rates=still(field))
    gaussians, module = step.copy()
    step(Observation.of(make_frame(4, shift_px=2), camera))
    after, module_after = step.copy()
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(tensor, after.tensors()[name])
    for name, tensor in module.state_dict().items():
        assert torch.equal(tensor, module_after.state_dict()[name])


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_training_step_trains_field_with_fixed_gaussians(make_step, make_frame, camera, field):
    learning = {"basis": {"means_px": 0.1, "sh": 1e-2}, "hexplane": {"parameters": 5e-3}}
    step = make_step(field, rates=still(field, **learning[field]))
    before = step.gaussians.clone()
    rest, moved = Observation.of(make_frame(), camera), Observation.of(make_frame(16, shift_px=2), camera)
    at_rest = step(rest)
    first = step(moved)
    for _ in range(30):
        step(rest)
        last = step(moved)
    assert last < 0.85 * first
    assert step(rest) < 1.2 * at_rest
    for name, tensor in before.tensors().items():
        assert torch.equal(tensor, step.gaussians.tensors()[name])


def test_training_step_scales_rates(make_step, make_frame, camera):
    seen = Observation.of(make_frame(4, shift_px=2), camera)
    moves = []
    for scale in (1.0, 0.25):
        step = make_step()
        before = step.gaussians.means.clone()
        step(seen, rate_scale=scale)
        moves.append(float((step.gaussians.means - before).abs().max()))
    # Adam's first step is the rate; 0.03 px at 60 mm with a focal length of 50 px.
    assert moves[0] == pytest.approx(0.03 * 60 / 50, rel=0.01)
    assert moves[1] == pytest.approx(moves[0] / 4, rel=0.01)


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_appended_gaussians_are_trained(make_step, make_frame, camera, field):
    step = make_step(field)
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    step(seen)
    count = step.gaussians.count
    added = step.gaussians.select(torch.arange(5))
    step.append(added)
    assert step.gaussians.count == count + 5
    assert step.at(0.2).count == count + 5
    before = step.gaussians.means[-5:].clone()
    step(seen)
    assert bool((step.gaussians.means[-5:] != before).any())


def test_appended_gaussians_start_without_motion(make_step, make_frame, camera):
    step = make_step()
    seen = Observation.of(make_frame(4, shift_px=2), camera)
    for _ in range(5):
        step(seen)
    added = step.gaussians.select(torch.arange(5))
    step.append(added)
    assert torch.equal(step.at(0.2).means[-5:], added.means)
    assert not torch.equal(step.at(0.2).means[:5], added.means)


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_step_copy_is_unchanged_by_training(make_step, make_frame, camera, field):
    step = make_step(field)
    gaussians, module = step.copy()
    means, state = gaussians.means.clone(), {name: tensor.clone() for name, tensor in module.state_dict().items()}
    for _ in range(3):
        step(Observation.of(make_frame(4, shift_px=2), camera))
    assert torch.equal(gaussians.means, means)
    assert all(torch.equal(tensor, state[name]) for name, tensor in module.state_dict().items())
    assert not any(parameter.requires_grad for parameter in module.parameters())


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_non_finite_gaussian_does_not_stop_training_of_others(make_step, make_frame, camera, field):
    step = make_step(field)
    step.gaussians.means[7] = float("nan")
    step.gaussians.sh[9] = float("inf")
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    losses = [step(seen) for _ in range(20)]
    assert np.isfinite(losses).all()
    assert losses[-1] < 0.7 * losses[0]
    others = torch.ones(step.gaussians.count, dtype=torch.bool)
    others[[7, 9]] = False
    assert all(bool(tensor.isfinite().all()) for tensor in step.at(0.2).select(others).tensors().values())
    assert all(bool(parameter.isfinite().all()) for parameter in step.field.parameters())


@pytest.mark.parametrize("field", ["basis", "hexplane"])
def test_training_step_on_all_tool_frame_changes_nothing(make_step, make_frame, camera, field):
    step = make_step(field)
    before = step.gaussians.clone()
    assert step(Observation.of(make_frame(mask=np.zeros((40, 48), np.uint8)), camera)) == 0
    for name, tensor in before.tensors().items():
        assert torch.equal(tensor, step.gaussians.tensors()[name])


def test_colour_relaxation_changes_colours_at_frame_time(make_step, make_frame, camera):
    step = make_step(rates=still("basis"), squared_error=True)
    canonical, far = step.gaussians.clone(), step.at(1.0)
    dark = make_frame(4)
    dark = dataclasses.replace(dark, image=dark.image // 2)
    seen = Observation.of(dark, camera)
    losses = [float(step(seen, colour_relaxation=1.0)) for _ in range(4)]
    assert losses == sorted(losses, reverse=True)
    assert losses[1] < 0.2 * losses[0]
    for name, tensor in canonical.tensors().items():
        assert torch.equal(tensor, step.gaussians.tensors()[name])
    at_once, later = step.at(seen.time_s), step.at(1.0)
    assert torch.equal(at_once.means, canonical.means)
    assert (later.sh - far.sh).abs().max() < 0.05 * (at_once.sh - canonical.sh).abs().max()


def test_colour_relaxation_changes_canonical_colours_of_hexplane(make_step, make_frame, camera):
    step = make_step("hexplane", rates=still("hexplane"), squared_error=True)
    canonical = step.gaussians.clone()
    dark = make_frame(4)
    dark = dataclasses.replace(dark, image=dark.image // 2)
    seen = Observation.of(dark, camera)
    losses = [float(step(seen, colour_relaxation=1.0)) for _ in range(4)]
    assert losses == sorted(losses, reverse=True)
    assert losses[1] < 0.2 * losses[0]
    assert torch.equal(step.gaussians.means, canonical.means)
    assert (step.gaussians.sh - canonical.sh).abs().max() > 0.1
    assert torch.equal(step.at(1.0).sh, step.gaussians.sh)


def test_colour_relaxation_on_all_tool_frame_changes_nothing(make_step, make_frame, camera):
    step = make_step(squared_error=True)
    before = step.at(0.2)
    step(Observation.of(make_frame(6, mask=np.zeros((40, 48), np.uint8)), camera), colour_relaxation=1.5)
    assert torch.equal(step.at(0.2).sh, before.sh)


def test_colour_relaxation_tolerates_non_finite_gaussians(make_step, make_frame, camera):
    step = make_step(squared_error=True)
    step.gaussians.means[7] = float("nan")
    step.gaussians.sh[9] = float("inf")
    seen = Observation.of(make_frame(4, shift_px=1), camera)
    losses = [step(seen, colour_relaxation=1.5) for _ in range(10)]
    assert losses[-1] < 0.7 * losses[0]
    assert all(bool(parameter.isfinite().all()) for parameter in step.field.parameters())
