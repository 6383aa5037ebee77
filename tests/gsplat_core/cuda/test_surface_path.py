"""Paths of surface points on CUDA against the CPU and plain torch in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.surface_motion import surface_path
from tests.gsplat_core.ops.test_surface_motion import exact_path, path_scene


@pytest.mark.parametrize(("steps", "count"), [(0, 5), (1, 0), (1, 1), (3, 257), (20, 3000)])
@pytest.mark.parametrize("cells", [(1, 1), (12, 16)])
def test_surface_path_equals_reference_and_is_deterministic(gpu, steps, count, cells):
    points, flows, cameras = path_scene(steps, count, cells)
    found, again = (surface_path(points.to(gpu), flows.to(gpu), cameras) for _ in range(2))
    assert torch.equal(found, again)
    close = torch.isclose(found.cpu().double(), exact_path(points, flows, cameras), rtol=1e-4, atol=1e-3)
    assert int((~close.all(dim=2).all(dim=1)).sum()) <= count // 100


def test_surface_path_keeps_points_outside_view(gpu):
    _, flows, cameras = path_scene(3, 1)
    points = torch.tensor([[0, 0, -50], [float("nan"), 0, 50], [900, 0, 50]], device=gpu)
    found = surface_path(points, flows.to(gpu), cameras)
    torch.testing.assert_close(found, points[:, None].expand(-1, 3, -1), equal_nan=True)
