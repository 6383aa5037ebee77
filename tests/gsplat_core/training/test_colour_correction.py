"""Colours corrected by the residual: against plain torch in float64, and what they never do."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core import reference
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.photometric import (
    LEAST_WEIGHT_PX,
    LossWeights,
    ResidualTarget,
    colour_correction,
    loss_and_gradients,
)

SQUARED = LossWeights(squared=True)


def observation(width=37, height=29, depth=True, tissue=0.7, seed=0):
    random = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (height, width, 3), generator=random, dtype=torch.uint8)
    mask = (torch.rand(height, width, generator=random) < tissue).to(torch.uint8)
    z = 50 + 20 * torch.rand(height, width, generator=random)
    return Observation(0, 0.0, Camera.from_focal(90.0, width, height), image, mask, z if depth else None)


def by_autograd(gaussians, seen, relaxation):
    """The change of `sh[:, 0]` in float64 from the gradients of two pictures, before it is kept from sinking below 0."""
    exact = gaussians.to(dtype=torch.float64)
    camera, count = seen.camera, gaussians.count
    directions = exact.means - torch.as_tensor(camera.position)
    colours = reference.spherical_harmonics(exact.sh_degree, directions, exact.sh) + 0.5
    blended = torch.cat([colours.clamp(min=0), torch.zeros(count, 1, dtype=torch.float64)], 1).requires_grad_()
    picture, _, _ = reference.rasterization(
        exact.means, exact.quats, exact.scales, exact.opacities, blended, torch.tensor(camera.world_to_camera)[None],
        torch.tensor(camera.K)[None], camera.width_px, camera.height_px, packed=False,
    )  # fmt: skip
    tissue = (seen.mask != 0).double()
    residual = (seen.image.double() / 255 - picture[0, ..., :3].detach()) * tissue[..., None]
    (picture[0] * torch.cat([residual, tissue[..., None]], -1)).sum().backward()
    wanted = relaxation * blended.grad[:, :3] / (blended.grad[:, 3:] + LEAST_WEIGHT_PX)
    return torch.maximum(wanted, -colours.clamp(min=0)) / SH_C0


@pytest.mark.slow
@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("depth_weight", [0.0, 0.5])
@pytest.mark.parametrize(("width", "height", "tissue"), [(37, 29, 0.7), (1, 1, 1.0), (17, 3, 1.0), (33, 32, 0.01)])
def test_colour_change_equals_float64_torch(
    make_gaussians, assert_near, sh_degree, depth_weight, width, height, tissue
):
    gaussians, seen = make_gaussians(60, sh_degree), observation(width, height, tissue=tissue)
    weights = LossWeights(depth=depth_weight, squared=True)
    compared = loss_and_gradients(gaussians, seen, weights, 1.5)
    assert_near(compared.colour_change, by_autograd(gaussians, seen, 1.5), of_largest=1e-4)


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("weights", [SQUARED, LossWeights(0.1, 0.5)])
def test_corrections_before_equals_separate_corrections(make_gaussians, assert_near, sh_degree, weights):
    gaussians, seen = make_gaussians(60, sh_degree), observation()
    together = loss_and_gradients(gaussians, seen, weights, 1.5, corrections_before=3)
    corrected = gaussians
    for _ in range(3):
        change = loss_and_gradients(corrected, seen, weights, 1.5).colour_change
        sh = corrected.sh.clone()
        sh[:, 0] += change
        corrected = replace(corrected, sh=sh)
    last = loss_and_gradients(corrected, seen, weights, 1.5)
    assert together.loss == pytest.approx(float(last.loss), rel=1e-4)
    assert float(last.loss) < 0.95 * float(loss_and_gradients(gaussians, seen, weights).loss)
    assert_near(together.colour_change, corrected.sh[:, 0] - gaussians.sh[:, 0] + last.colour_change, of_largest=1e-3)
    for name, gradient in last.gradients.items():
        assert_near(together.gradients[name], gradient, of_largest=2e-3)


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_colour_correction_does_not_change_other_gradients(make_gaussians, sh_degree):
    gaussians, seen = make_gaussians(60, sh_degree), observation()
    plain = loss_and_gradients(gaussians, seen, SQUARED)
    corrected = loss_and_gradients(gaussians, seen, SQUARED, 1.0)
    assert plain.colour_change is None
    assert corrected.loss == plain.loss
    assert not corrected.gradients["sh"][:, 0].any()
    for name, gradient in plain.gradients.items():
        kept = slice(1, None) if name == "sh" else slice(None)
        columns = (slice(None), kept) if name == "sh" else slice(None)
        torch.testing.assert_close(corrected.gradients[name][columns], gradient[columns], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("relaxation", [0.5, 1.0, 1.99])
def test_colour_correction_never_increases_squared_error(relaxation):
    random = torch.Generator().manual_seed(1)
    blending = torch.rand(200, 30, generator=random) * (torch.rand(200, 30, generator=random) < 0.2)
    blending /= blending.sum(1, keepdim=True).clamp(min=1)
    wanted, colours, errors = torch.rand(200, 3, generator=random), torch.rand(30, 3, generator=random), []
    for _ in range(30):
        residual = wanted - blending @ colours
        errors.append(float(residual.square().sum()))
        colours = colours + colour_correction(colours, blending.T @ residual, blending.sum(0), relaxation)
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.9 * errors[0]


def test_colour_correction_is_small_for_barely_visible_gaussians():
    weights = torch.tensor([0.0, 1e-6, LEAST_WEIGHT_PX, 100.0])
    colours = torch.tensor([[0.5], [0.5], [0.5], [-0.2]]).expand(4, 3)
    change = colour_correction(colours, 0.2 * weights[:, None].expand(4, 3), weights, 1.0)
    assert change[:, 0].tolist() == pytest.approx([0.0, 0.0, 0.1, 0.2], abs=1e-3)
    assert not change[0].any()


def test_colour_correction_keeps_colours_nonnegative():
    colours = torch.tensor([[0.5, 0.1, -0.2]])
    change = colour_correction(colours, torch.full((1, 3), -30.0), torch.tensor([100.0]), 1.0)
    assert change[0].tolist() == pytest.approx([-0.3, -0.1, 0.0], abs=1e-2)


def test_colour_change_is_zero_without_tissue_or_gaussians(make_gaussians):
    nothing = loss_and_gradients(make_gaussians(20), observation(tissue=0.0), SQUARED, 1.0).colour_change
    assert nothing.shape == (20, 3)
    assert not nothing.any()
    assert loss_and_gradients(make_gaussians(0), observation(), SQUARED, 1.0).colour_change.shape == (0, 3)


@pytest.mark.parametrize(
    "weights", [LossWeights(), LossWeights(0.1), LossWeights(0.1, 0.5), LossWeights(0.1, squared=True)]
)
def test_every_loss_has_same_colour_correction_and_own_gradients(make_gaussians, assert_near, weights):
    gaussians, seen = make_gaussians(60), observation()
    compared, plain = (loss_and_gradients(gaussians, seen, weights, relaxation) for relaxation in (1.5, 0.0))
    assert_near(compared.colour_change, by_autograd(gaussians, seen, 1.5), of_largest=1e-4)
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        assert_near(compared.gradients[name], plain.gradients[name], of_largest=1e-5)
    assert plain.gradients["sh"][:, 0].any() and not compared.gradients["sh"][:, 0].any()


def test_residual_target_is_masked_difference_to_picture():
    seen, shown = observation(5, 4), torch.rand(4, 5, 4, generator=torch.Generator().manual_seed(3))
    target = ResidualTarget(seen.image)
    target.take(seen.image.flip(0), 1 - seen.mask)
    target.take(seen.image, 3 * seen.mask)
    found = target.correction(shown, torch.tensor([1.5]))
    tissue = (seen.mask > 0).double()[..., None]
    expected = torch.cat([tissue * (seen.image.double() / 255 - shown[..., :3].double()), tissue], -1)
    torch.testing.assert_close(found.residuals.double(), expected, atol=1e-6, rtol=0)
    assert found.relaxation.tolist() == [1.5]
