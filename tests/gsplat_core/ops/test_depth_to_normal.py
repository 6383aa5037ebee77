"""Normals of depth maps in world axes: values and gradients against plain torch in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.depth_to_normal import depth_to_normal
from gsplat_core.rendering import depth_maps
from tests.gsplat_core.ops.depth_maps import compared, maps

SHAPES = [((), 37, 45), ((2, 3), 20, 31), ((1,), 3, 3), ((4,), 2, 9), ((), 1, 1), ((2,), 0, 7), ((0,), 5, 5)]


@pytest.mark.parametrize(("leading", "height", "width"), SHAPES)
def test_depth_to_normal_values_and_gradients_equal_reference(leading, height, width):
    seen, wanted = (compared(leading, height, width, "cpu", dtype) for dtype in (torch.float32, torch.float64))
    for name, value in wanted.items():
        scale = float(value.abs().max()) if value.numel() else 0.0
        torch.testing.assert_close(seen[name].double(), value, rtol=1e-4, atol=1e-5 * scale, msg=name)
    if height > 5:
        assert all(value.any() for value in wanted.values())


def test_depth_to_normal_reference_passes_gradcheck():
    depths, poses, K = maps((2,), 6, 7, torch.float64)
    depths = torch.where(depths > 0, depths, 35.0)
    leaves = [each.requires_grad_() for each in (depths, poses, K)]
    assert torch.autograd.gradcheck(depth_maps.depth_to_normal, leaves, fast_mode=True)


def test_depth_to_normal_pixel_without_direction_has_zero_normal():
    depths = torch.zeros(5, 7, 1)
    depths[2, 3] = 4.0
    depths.requires_grad_()
    for function in (depth_to_normal, depth_maps.depth_to_normal):
        normals = function(depths, torch.eye(4), torch.eye(3))
        (gradient,) = torch.autograd.grad(normals.sum(), depths)
        assert not normals.any()
        assert not gradient.any()


def test_depth_to_normal_independent_of_length_unit():
    depths, poses, K = maps((), 12, 16)
    expected = depth_to_normal(depths, poses, K)
    torch.testing.assert_close(depth_to_normal(depths * 1e-5, poses, K), expected, rtol=1e-4, atol=1e-5)


def test_depth_to_normal_supports_pose_gradients_and_ray_distances():
    depths, poses, K = maps((), 8, 9)
    poses.requires_grad_()
    depth_to_normal(depths, poses, K).sum().backward()
    assert poses.grad is not None and poses.grad[:3, :3].any()
    along = depth_to_normal(depths, poses.detach(), K, z_depth=False)
    torch.testing.assert_close(along, depth_maps.depth_to_normal(depths, poses.detach(), K, z_depth=False))


def test_depth_to_normal_rejects_second_derivative():
    depths, poses, K = maps((), 8, 9)
    depths.requires_grad_()
    (gradient,) = torch.autograd.grad(depth_to_normal(depths, poses, K).sum(), depths, create_graph=True)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        gradient.sum().backward()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (0, torch.zeros(4, 5), r"depths must be \[..., H, W, 1\], got \[4, 5\]"),
        (1, torch.eye(3), r"camtoworlds must be .*\[3, 3\]"),
        (2, torch.eye(4), r"Ks must be .*\[4, 4\]"),
    ],
)
def test_depth_to_normal_names_invalid_shapes(name, value, message):
    given = list(maps((), 4, 5))
    given[name] = value
    with pytest.raises(InvalidInput, match=message):
        depth_to_normal(*given)


def test_depth_to_normal_names_mixed_dtypes():
    depths, poses, K = maps((), 4, 5)
    with pytest.raises(InvalidInput, match=r"one floating-point dtype .* camtoworlds: torch.float64"):
        depth_to_normal(depths, poses.double(), K)
