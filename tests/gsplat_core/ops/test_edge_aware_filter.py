"""The fast global smoother against the oracle in float64."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.edge_aware_filter import smooth_within_edges

# planes, height, width, channels of the guide (0: [H, W])
SHAPES = [(1, 1, 1, 0), (1, 1, 40, 3), (2, 40, 1, 1), (2, 17, 33, 3), (3, 65, 16, 4), (1, 100, 129, 3), (2, 3, 1100, 0)]


def case(shape, seed=0):
    """Planes float32 and a guide with edges."""
    planes, height, width, channels = shape
    generator = torch.Generator().manual_seed(seed)
    guide = torch.randint(0, 12, (height, width, max(channels, 1)), generator=generator)
    guide[height // 2 :, width // 3 :] += 90
    values = 10 * torch.randn(planes, height, width, generator=generator)
    return values, guide.byte() if channels else guide[..., 0].byte()


def check_against_reference(shape, device="cpu", strength=100.0, grey_step=5.0):
    """Compare float32 with the float64 reference to 1e-4 of the largest value."""
    planes, guide = case(shape)
    found = smooth_within_edges(planes.to(device), guide.to(device), strength, grey_step)
    expected = reference.smooth_within_edges(planes.double(), guide, strength, grey_step)
    torch.testing.assert_close(found.double().cpu(), expected, rtol=0, atol=1e-4 * planes.abs().max().item())


@pytest.mark.parametrize("shape", SHAPES)
def test_edge_aware_filter_equals_reference(shape):
    check_against_reference(shape)


@pytest.mark.parametrize(("strength", "grey_step"), [(0.0, 5.0), (1e4, 200.0), (3.0, 0.01)])
def test_edge_aware_filter_equals_reference_at_any_strength(strength, grey_step):
    check_against_reference((2, 30, 50, 3), strength=strength, grey_step=grey_step)


def test_edge_aware_filter_keeps_guide_edge_and_smooths_between():
    guide = torch.zeros(40, 60, dtype=torch.uint8)
    guide[:, 30:] = 200
    planes = torch.where(guide > 0, 5.0, 1.0) + 0.5 * torch.randn(40, 60, generator=torch.Generator().manual_seed(1))
    smooth = smooth_within_edges(planes[None], guide, 400.0, 5.0)[0]
    assert (smooth[:, :30] - 1).abs().max() < 0.25 and (smooth[:, 30:] - 5).abs().max() < 0.25


def test_edge_aware_filter_keeps_mean_without_guide_edges():
    planes, guide = case((2, 21, 35, 0))
    smooth = smooth_within_edges(planes, torch.zeros_like(guide), 100.0, 5.0)
    torch.testing.assert_close(smooth.mean((1, 2)), planes.mean((1, 2)), rtol=0, atol=1e-4)
    assert smooth.std() < 0.2 * planes.std()


def test_edge_aware_filter_does_not_modify_input():
    planes, guide = case((2, 9, 11, 3))
    before = planes.clone()
    smooth_within_edges(planes, guide, 100.0, 5.0)
    assert torch.equal(planes, before)


def test_edge_aware_filter_without_pixels():
    nothing = torch.zeros(2, 0, 5)
    assert smooth_within_edges(nothing, torch.zeros(0, 5, dtype=torch.uint8), 1.0, 1.0).shape == (2, 0, 5)


def test_edge_aware_filter_passes_opcheck():
    torch.library.opcheck(torch.ops.gsplat_core.smooth_within_edges, (*case((2, 8, 9, 3)), 100.0, 5.0))


def test_edge_aware_filter_rejects_invalid_inputs():
    planes, guide = case((2, 8, 9, 3))
    with pytest.raises(InvalidInput, match="float32"):
        smooth_within_edges(planes.double(), guide, 1.0, 1.0)
    with pytest.raises(InvalidInput, match=r"got \[2, 8, 9\] and torch.uint8 \[7, 9, 3\]"):
        smooth_within_edges(planes, guide[:7], 1.0, 1.0)
    with pytest.raises(InvalidInput, match="1 to 4 channels, got 5"):
        smooth_within_edges(planes, torch.zeros(8, 9, 5, dtype=torch.uint8), 1.0, 1.0)
    with pytest.raises(InvalidInput, match="at most 4096"):
        smooth_within_edges(torch.zeros(1, 1, 4097), torch.zeros(1, 4097, dtype=torch.uint8), 1.0, 1.0)
    with pytest.raises(InvalidInput, match="grey_step positive"):
        smooth_within_edges(planes, guide, 1.0, 0.0)
