"""Losses of rendered rays: values and gradients against plain torch in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ray_losses import ray_depth_loss, ray_normal_loss
from tests.gsplat_core.ops.ray_planes import compared, planes

SIZES = [(37, 45), (3, 3), (5, 2), (1, 1), (2, 9), (0, 7), (70, 130)]


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("size", SIZES)
def test_ray_losses_values_and_gradients_equal_reference(size, model):
    seen, wanted = compared(size, model, "cpu", torch.float32), compared(size, model, "cpu", torch.float64)
    for name, value in wanted.items():
        scale = float(value.abs().max()) if value.numel() else 0.0
        torch.testing.assert_close(seen[name].double(), value, rtol=1e-4, atol=1e-5 * scale, msg=name)
    if size == (37, 45) and model != "fisheye":
        assert all(value.abs().sum() > 0 for value in wanted.values())


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_ray_losses_reference_passes_gradcheck(model):
    depths, alphas, normals, known, tissue, K = planes((9, 11), torch.float64)
    depths = torch.where(depths > 0, depths, 0)
    leaves = [each.requires_grad_() for each in (depths, alphas, normals)]
    assert torch.autograd.gradcheck(lambda d: reference.ray_depth_loss(d, known, tissue), leaves[:1])
    assert torch.autograd.gradcheck(lambda *each: reference.ray_normal_loss(*each, tissue, K, model), leaves)


def test_ray_losses_zero_outside_tissue_and_known_depth():
    depths, alphas, normals, known, tissue, K = planes((20, 30))
    depths.requires_grad_()
    none = torch.zeros_like(tissue)
    for loss in (
        ray_depth_loss(depths, known, none),
        ray_depth_loss(depths, torch.zeros_like(known), tissue),
        ray_normal_loss(depths, alphas, normals, none, K, "pinhole"),
        ray_normal_loss(depths.detach().new_zeros(20, 30).requires_grad_(), alphas, normals, tissue, K, "pinhole"),
    ):
        assert loss == 0
    (gradient,) = torch.autograd.grad(ray_depth_loss(depths, known, none), depths)
    assert not gradient.any()


def test_ray_losses_ignore_non_finite_values_outside_tissue():
    depths, alphas, normals, known, tissue, K = planes((20, 30))
    clean = ray_normal_loss(depths, alphas, normals, tissue, K, "pinhole"), ray_depth_loss(depths, known, tissue)
    hidden = [torch.where(tissue, each, torch.nan) for each in (alphas, known)]
    normals = torch.where(tissue[..., None], normals, torch.nan)
    assert ray_normal_loss(depths, hidden[0], normals, tissue, K, "pinhole") == clean[0]
    assert ray_depth_loss(depths, hidden[1], tissue) == clean[1]
    unknown = torch.where(torch.rand(20, 30) < 0.1, torch.nan, depths)
    assert ray_normal_loss(unknown, alphas, torch.nan_to_num(normals), tissue, K, "pinhole").isfinite()


def test_ray_losses_independent_of_thread_count():
    results, threads = [], torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(compared((70, 130), "pinhole", "cpu", torch.float32))
    finally:
        torch.set_num_threads(threads)
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_ray_losses_pass_opcheck():
    depths, alphas, normals, known, tissue, K = planes((6, 8))
    leaves = [each.requires_grad_() for each in (depths, alphas, normals)]
    tissue = tissue.view(torch.uint8)
    torch.library.opcheck(torch.ops.gsplat_core.ray_depth_loss.default, (leaves[0], known, tissue))
    torch.library.opcheck(torch.ops.gsplat_core.ray_normal_loss.default, (*leaves, tissue, K, 0))


def test_ray_losses_reject_invalid_arguments():
    depths, alphas, normals, known, tissue, K = planes((6, 8))
    with pytest.raises(InvalidInput, match="known must be"):
        ray_depth_loss(depths, known.T, tissue)
    with pytest.raises(InvalidInput, match="must be float32"):
        ray_depth_loss(depths.double(), known.double(), tissue)
    with pytest.raises(InvalidInput, match="tissue must be bool"):
        ray_depth_loss(depths, known, tissue.byte())
    with pytest.raises(InvalidInput, match="normals must be"):
        ray_normal_loss(depths, alphas, normals[..., :2], tissue, K, "pinhole")
    with pytest.raises(InvalidInput, match="unknown camera_model 'lens'"):
        ray_normal_loss(depths, alphas, normals, tissue, K, "lens")
    with pytest.raises(RuntimeError, match="must have the size of depths"):
        torch.ops.gsplat_core.ray_depth_loss(depths, known[:3], tissue.view(torch.uint8))
    with pytest.raises(RuntimeError, match="camera model 0 to 2"):
        torch.ops.gsplat_core.ray_normal_loss(depths, alphas, normals, tissue.view(torch.uint8), K, 3)
