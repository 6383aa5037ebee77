"""The fast global smoother on the GPU against the oracle in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.edge_aware_filter import smooth_within_edges
from tests.gsplat_core.ops.test_edge_aware_filter import SHAPES, case, check_against_reference


@pytest.mark.parametrize("shape", SHAPES)
def test_edge_aware_filter_equals_reference(gpu, shape):
    check_against_reference(shape, gpu)


@pytest.mark.parametrize(("strength", "grey_step"), [(0.0, 5.0), (1e4, 200.0), (3.0, 0.01)])
def test_edge_aware_filter_equals_reference_at_any_strength(gpu, strength, grey_step):
    check_against_reference((2, 30, 50, 3), gpu, strength, grey_step)


@pytest.mark.parametrize("shape", [(2, 512, 640, 3), (1, 4096, 30, 1), (1, 5, 4096, 0), (2, 1025, 1024, 3)])
def test_edge_aware_filter_of_any_line_length_equals_cpu(gpu, shape):
    planes, guide = case(shape)
    here = smooth_within_edges(planes, guide, 100.0, 5.0)
    there = smooth_within_edges(planes.to(gpu), guide.to(gpu), 100.0, 5.0)
    torch.testing.assert_close(there.cpu(), here, rtol=0, atol=1e-4 * planes.abs().max().item())


def test_edge_aware_filter_is_deterministic(gpu):
    planes, guide = (each.to(gpu) for each in case((2, 200, 300, 3)))
    first, second = (smooth_within_edges(planes, guide, 100.0, 5.0) for _ in range(2))
    assert torch.equal(first, second)


def test_edge_aware_filter_without_pixels(gpu):
    guide = torch.zeros(0, 5, dtype=torch.uint8, device=gpu)
    assert smooth_within_edges(torch.zeros(2, 0, 5, device=gpu), guide, 1.0, 1.0).shape == (2, 0, 5)


def test_edge_aware_filter_passes_opcheck(gpu):
    planes, guide = (each.to(gpu) for each in case((2, 8, 9, 3)))
    torch.library.opcheck(torch.ops.gsplat_core.smooth_within_edges, (planes, guide, 100.0, 5.0))
