"""Factors by which depth moves Gaussians, and their motion along rays, in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsplat_core.scene.gaussians import LOG_SCALE, POSITION, RAW_COLUMNS
from gsplat_core.training.placement import move_along_rays_, smooth_factor

WHOLE = torch.ones(64, 96, dtype=torch.bool)
PIXELS = torch.tensor([[10.0, 12.0], [48.0, 32.0], [95.5, 63.5], [-30.0, 200.0]])


@pytest.mark.parametrize(
    ("ratio", "factor"), [(1.0, 1.0), (1.2, math.sqrt(1.2)), (0.81, 0.9), (1.95, math.sqrt(1.95)), (2.1, 1.4), (0.3, 1 / 1.4)]
)  # fmt: skip
def test_smooth_factor_moves_half_way_limited_to_1_4(ratio, factor):
    shown = torch.full((64, 96), 50.0)
    found = smooth_factor(ratio * shown, shown, WHOLE, PIXELS)
    torch.testing.assert_close(found, torch.full((4,), factor), rtol=1e-4, atol=0)


def test_smooth_factor_varies_along_columns():
    """The depth rises from left to right, and the factor with it. Beyond the picture it is that of the edge."""
    shown = torch.full((64, 96), 50.0)
    depth = shown * torch.exp(torch.linspace(-0.2, 0.2, 96))
    at = torch.tensor([[8.0, 30.0], [48.0, 30.0], [80.0, 10.0], [80.0, 60.0], [-40.0, 30.0], [300.0, 30.0]])
    found = smooth_factor(depth, shown, WHOLE, at)
    expected = torch.exp(0.5 * (-0.2 + 0.4 * (at[:, 0].clamp(0.5, 95.5) - 0.5) / 95))
    torch.testing.assert_close(found, expected, rtol=0.02, atol=0)
    assert float(found[2]) == pytest.approx(float(found[3]), rel=1e-3)


def test_smooth_factor_of_unknown_depth_and_within_16_pixel_blocks():
    shown = torch.full((64, 96), 50.0)
    known = WHOLE.clone()
    known[:, 48:] = False
    depth = torch.where(known, 1.44 * shown, 5.0)
    torch.testing.assert_close(smooth_factor(depth, shown, known, PIXELS), torch.full((4,), 1.2), rtol=1e-3, atol=0)
    speckled = torch.where(torch.arange(96) % 4 < 2, 1.21, 1.0) * shown
    found = smooth_factor(speckled, shown, WHOLE, torch.tensor([[40.0, 30.0], [42.0, 30.0], [44.0, 34.0]]))
    torch.testing.assert_close(found, torch.full((3,), 1.21**0.25), rtol=0.01, atol=0)


def test_move_along_rays_keeps_rays_and_scales_with_distance():
    random = np.random.default_rng(0)
    means, deltas = (torch.from_numpy(random.normal(size=(20, width))) for width in (3, RAW_COLUMNS))
    before, centre = deltas.clone(), torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    factor = torch.from_numpy(random.uniform(0.7, 1.4, 20))
    move_along_rays_(deltas, means, factor, centre)
    from_centre, after = ((means + each[:, POSITION]) - centre for each in (before, deltas))
    torch.testing.assert_close(after, factor[:, None] * from_centre)
    torch.testing.assert_close((deltas - before)[:, LOG_SCALE].exp(), factor[:, None].expand(20, 3))
    others = [
        column
        for column in range(RAW_COLUMNS)
        if column not in {*range(RAW_COLUMNS)[POSITION], *range(RAW_COLUMNS)[LOG_SCALE]}
    ]
    assert torch.equal(deltas[:, others], before[:, others])


def test_smooth_factor_varies_along_rows():
    """The depth rises from top to bottom."""
    shown = torch.full((64, 96), 50.0)
    depth = shown * torch.exp(torch.linspace(-0.2, 0.2, 64))[:, None]
    at = torch.tensor([[20.0, 10.0], [80.0, 32.0], [40.0, 56.0], [40.0, -30.0], [40.0, 200.0]])
    expected = torch.exp(0.5 * (-0.2 + 0.4 * (at[:, 1].clamp(0.5, 63.5) - 0.5) / 63))
    torch.testing.assert_close(smooth_factor(depth, shown, WHOLE, at), expected, rtol=0.03, atol=0)
