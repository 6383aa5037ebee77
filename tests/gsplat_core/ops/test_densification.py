"""Statistics of gradients and noise on positions: the compiled ops against the reference in float64."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import InvalidInput, reference
from gsplat_core.ops.densification import accumulate_gradient_norms_, diffuse_positions_


def screen(images, count, seed=0):
    """Return gradients and radii, of which a third is not visible."""
    g = torch.Generator().manual_seed(seed)
    radii = torch.randint(-1, 90, (images, count, 2), generator=g, dtype=torch.int32)
    radii[torch.rand(images, count, generator=g) < 0.3] = 0
    return torch.randn(images, count, 2, generator=g), radii


def gaussians(count, seed=0):
    """Return means, quats, logarithmic scales, logits and noise."""
    g = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    return normal(count, 3), normal(count, 4) * 3, normal(count, 3) - 1, 4 * normal(count) - 4, normal(count, 3)


NOISE = {"scale": 0.7, "opacity_at_half": 0.01, "steepness": 100.0}


@pytest.mark.parametrize(("images", "count"), [(1, 1), (3, 1003), (2, 0), (0, 5)])
@pytest.mark.parametrize("with_radii", [True, False])
def test_gradient_norms_equal_reference(assert_near, images, count, with_radii):
    gradients, radii = screen(images, count)
    start = torch.rand(3, count)
    ours, exact = start.clone(), start.double()
    scale, extent = (3.0, 0.5), 1 / 64
    accumulate_gradient_norms_(gradients, radii, scale, extent, ours[0], ours[1], ours[2] if with_radii else None)
    reference.accumulate_gradient_norms_(
        gradients.double(), radii, scale, extent, exact[0], exact[1], exact[2] if with_radii else None
    )
    assert_near(ours, exact, of_largest=1e-6)


def test_gradient_norms_count_only_gaussians_with_two_positive_radii():
    radii = torch.tensor([[[4, 2], [0, 5], [5, 0], [-1, 3]], [[1, 9], [1, 1], [0, 0], [0, 0]]], dtype=torch.int32)
    sums, counts, largest = torch.zeros(4), torch.zeros(4), torch.full((4,), 0.02)
    gradients = torch.tensor([3.0, 4.0]).expand(2, 4, 2)
    accumulate_gradient_norms_(gradients, radii, (1.0, 1.0), 0.01, sums, counts, largest)
    assert sums.tolist() == [10, 5, 0, 0]
    assert counts.tolist() == [2, 1, 0, 0]
    torch.testing.assert_close(largest, torch.tensor([0.09, 0.02, 0.02, 0.02]))


@pytest.mark.parametrize("count", [0, 1, 7, 1003])
def test_diffuse_positions_equals_reference(assert_near, count):
    means, *rest = gaussians(count)
    ours, exact = means.clone(), means.double()
    diffuse_positions_(ours, *rest, **NOISE)
    reference.diffuse_positions_(exact, *(each.double() for each in rest), **NOISE)
    assert_near(ours - means, exact - means.double(), of_largest=1e-5)
    if count > 1:
        assert (ours != means).any()


def test_diffuse_positions_moves_transparent_gaussian_along_axes():
    quarter = torch.tensor([1.0, 0, 0, 1]).expand(2, 4)  # about z: the first axis lies along y
    scales = torch.tensor([2.0, 1.0, 0.5]).log().expand(2, 3)
    means, logits = torch.zeros(2, 3), torch.tensor([-30.0, 0.0])
    diffuse_positions_(means, quarter, scales, logits, torch.ones(2, 3), 1.0, 0.005, 100.0)
    share = 1 / (1 + math.exp(-0.5))
    torch.testing.assert_close(means[0], share * torch.tensor([1.0, 4.0, 0.25]), rtol=1e-5, atol=0)
    assert means[1].abs().max() < 1e-12


@pytest.mark.parametrize("where", range(4))
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_diffuse_positions_keeps_gaussian_with_non_finite_new_position(where, value):
    means, *rest = gaussians(9)
    rest = [each.clone() for each in rest]
    if where == 2 and value == math.inf:
        value, rest[0][4] = math.nan, 0.0  # infinite logits are opaque; a rotation of length zero instead
    rest[where].view(9, -1)[4, 0] = value
    moved = means.clone()
    diffuse_positions_(moved, *rest, **NOISE)
    assert torch.equal(moved[4], means[4])
    assert moved.isfinite().all()
    exact = means.double()
    reference.diffuse_positions_(exact, *(each.double() for each in rest), **NOISE)
    torch.testing.assert_close(moved, exact.float(), rtol=1e-4, atol=1e-5)


def test_diffuse_positions_keeps_gaussian_with_zero_rotation():
    means, quats, *rest = gaussians(3)
    quats[1] = 0
    moved = means.clone()
    diffuse_positions_(moved, quats, *rest, **NOISE)
    assert torch.equal(moved[1], means[1])


def test_densification_ops_pass_opcheck():
    ops = torch.ops.gsplat_core
    torch.library.opcheck(
        ops.accumulate_gradient_norms_.default, (*screen(2, 9), 1.0, 2.0, 0.5, *(torch.zeros(9) for _ in range(3)))
    )
    torch.library.opcheck(
        ops.accumulate_gradient_norms_.default, (*screen(2, 9), 1.0, 2.0, 0.5, torch.zeros(9), torch.zeros(9), None)
    )
    torch.library.opcheck(ops.diffuse_positions_.default, (*gaussians(9), *NOISE.values()))


def test_densification_ops_reject_invalid_arguments():
    gradients, radii = screen(2, 5)
    sums = torch.zeros(5)
    with pytest.raises(InvalidInput, match=r"radii must be int32, got torch.int64"):
        accumulate_gradient_norms_(gradients, radii.long(), (1.0, 1.0), 1.0, sums, sums)
    with pytest.raises(InvalidInput, match=r"gradients must be \[C, N, 2\], got \[5, 2\]"):
        accumulate_gradient_norms_(gradients[0], radii[0], (1.0, 1.0), 1.0, sums, sums)
    with pytest.raises(InvalidInput, match=r"counts.*\[4\]"):
        accumulate_gradient_norms_(gradients, radii, (1.0, 1.0), 1.0, sums, sums[:4])
    with pytest.raises(InvalidInput, match=r"largest.*\[3\]"):
        accumulate_gradient_norms_(gradients, radii, (1.0, 1.0), 1.0, sums, sums, sums[:3])
    with pytest.raises(InvalidInput, match="float64"):
        accumulate_gradient_norms_(gradients.double(), radii, (1.0, 1.0), 1.0, sums, sums)
    means, *rest = gaussians(5)
    with pytest.raises(InvalidInput, match=r"noise.*\[4, 3\]"):
        diffuse_positions_(means, *rest[:3], rest[3][:4], **NOISE)
    with pytest.raises(InvalidInput, match="float64"):
        diffuse_positions_(means.double(), *rest, **NOISE)
    with pytest.raises(InvalidInput, match="means must be contiguous"):
        diffuse_positions_(means.T.contiguous().T, *rest, **NOISE)
