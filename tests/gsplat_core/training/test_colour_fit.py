"""Colours that make a scene look like a picture."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.steps.photometric import colour_change

CAMERA = Camera.from_focal(60.0, 48, 32)


def scene(count: int = 150, device: str = "cpu", degree: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([40.0, 27.0, 2.0]) + torch.tensor(
        [-20.0, -13.5, 50.0]
    )
    return Gaussians(
        means=means,
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1),
        log_scales=torch.full((count, 3), 0.4),
        logit_opacities=torch.full((count,), 1.0),
        sh=torch.rand(count, (degree + 1) ** 2, 3, generator=generator) * 0.5,
    ).to(device)


def with_change(gaussians: Gaussians, change: torch.Tensor) -> Gaussians:
    sh = gaussians.sh.clone()
    sh[:, 0] += change
    return replace(gaussians, sh=sh)


def picture_of(gaussians: Gaussians) -> torch.Tensor:
    return render(gaussians, CAMERA, depth=False).image


@pytest.mark.parametrize("degree", [0, 2])
def test_colour_change_reduces_picture_error(device: str, degree: int) -> None:
    gaussians = scene(device=device, degree=degree)
    wanted = picture_of(with_change(gaussians, torch.full_like(gaussians.means, 0.3)))
    counts = torch.ones(wanted.shape[:2], device=device)
    errors = [
        float(
            (picture_of(with_change(gaussians, colour_change(gaussians, CAMERA, wanted, counts, steps))) - wanted)
            .square()
            .mean()
        )
        for steps in (0, 1, 8)
    ]
    assert errors[0] > 10 * errors[1] > 100 * errors[2]


def test_first_colour_step_is_weighted_mean_of_residuals() -> None:
    """Compare with the blending weights, computed one Gaussian at a time."""
    gaussians = scene(12)
    change = torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(1))
    before = picture_of(gaussians)
    found = colour_change(gaussians, CAMERA, before + change, torch.ones(32, 48), 1)
    for index in range(12):
        one = torch.zeros(12, 3)
        one[index] = 1.0 / SH_C0
        weights = picture_of(with_change(gaussians, one)) - before
        expected = (weights * change).sum((0, 1)) / weights.sum((0, 1)).clamp(min=1e-6) / SH_C0
        torch.testing.assert_close(found[index], expected, rtol=1e-3, atol=1e-4)


def test_colour_change_is_zero_for_uncounted_pixels() -> None:
    gaussians, counts = scene(), torch.zeros(32, 48)
    assert not colour_change(gaussians, CAMERA, torch.ones(32, 48, 3), counts, 3).any()


def test_colour_change_is_zero_for_invisible_gaussians() -> None:
    gaussians = scene()
    behind = gaussians.means.clone()
    behind[:5, 2] = -50.0
    change = colour_change(replace(gaussians, means=behind), CAMERA, torch.ones(32, 48, 3), torch.ones(32, 48), 3)
    assert not change[:5].any() and change.isfinite().all() and change[5:].any()
