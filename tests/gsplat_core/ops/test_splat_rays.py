"""Ray coefficients and normals of Gaussians: by their definition, and compiled against plain torch in float64."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.splat_rays import SplatRays, splat_rays
from gsplat_core.reference.compositing import depths_of_rays, ray_depths
from tests.gsplat_core.ops.ray_scenes import gaussians, intrinsics, splat_results, view


def compiled(*tensors: torch.Tensor) -> SplatRays:
    return splat_rays(*tensors, "pinhole")


def depths_by_coefficients(means, quats, scales, viewmat, K, pixels, by=reference.splat_rays):
    rays = by(means, quats, scales, viewmat, K)[0]
    local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    means2d = local[:, :2] / local[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    return depths_of_rays(rays, pixels[:, None] - means2d)


@pytest.mark.parametrize("flatness", [1.0, 1e-3])
def test_splat_rays_coefficients_give_chord_midpoint_and_gradient(flatness: float) -> None:
    means, quats, scales = gaussians(40)
    scales[:, 0] *= flatness
    K, viewmat = intrinsics(70, 45), view()
    pixels = torch.rand(60, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * torch.tensor(
        [70.0, 45]
    )
    results = []
    for function in (ray_depths, depths_by_coefficients):
        inputs = [tensor.clone().requires_grad_() for tensor in (means, quats, scales)]
        depth, variance = function(*inputs, viewmat, K, pixels)
        random = torch.randn(depth.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
        gradients = torch.autograd.grad((depth * random).sum(), inputs)
        results.append((depth.detach(), variance.detach(), *gradients))
    for wanted, seen in zip(*results, strict=True):
        torch.testing.assert_close(seen, wanted, rtol=1e-6, atol=1e-8 * float(wanted.abs().max()))
    depth = results[0][0]
    centre = (means @ viewmat[2, :3] + viewmat[2, 3]).expand_as(depth)
    assert bool(((depth - centre).abs() < 2.9 * scales.amax(1)).any())
    assert bool(((depth - centre).abs() > 2.999 * scales.amax(1)).any())  # the limit is reached


def test_splat_rays_single_precision_accurate_for_flat_splats() -> None:
    means, quats, scales = gaussians(200)
    scales[:, 1] = 1e-3 * scales[:, 0]
    K = intrinsics(640, 512)
    pixels = means[:, :2] / means[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    pixels = pixels + torch.randn(200, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64)
    wanted = depths_by_coefficients(means, quats, scales, eye, K, pixels)[0].diagonal()
    single = [tensor.float() for tensor in (means, quats, scales, eye, K, pixels)]
    seen = depths_by_coefficients(*single, compiled)[0].diagonal().double()
    assert float(((seen - wanted) / wanted).abs().median()) < 1e-6
    assert float(((seen - wanted) / wanted).abs().max()) < 1e-3


def test_splat_rays_of_fisheye_and_ortho_in_closed_form() -> None:
    means, quats, scales = gaussians(30)
    K, eye = intrinsics(70, 45), torch.eye(4, dtype=torch.float64)
    single = [tensor.float() for tensor in (means, quats, scales, eye, K)]
    fisheye = splat_rays(*single, "fisheye").rays
    depth, _ = depths_of_rays(fisheye, torch.randn(5, 30, 2))
    torch.testing.assert_close(depth, means[:, 2].float().expand(5, -1))
    # A parallel ray through (x, y): minimum of the Mahalanobis distance over z, in closed form.
    ortho, normals = splat_rays(*single, "ortho")
    assert bool((normals[:, 2] <= 0).all())
    covariance, _ = reference.quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    precision = torch.linalg.inv(covariance)
    offset = torch.tensor([0.3, -0.2], dtype=torch.float64)
    wanted = means[:, 2] - (precision[:, 2, :2] @ offset) / precision[:, 2, 2]
    depth, variance = depths_of_rays(ortho.double(), (offset * K.diagonal()[:2]).expand(1, 30, 2))
    limit = 3 * scales.amax(1)
    torch.testing.assert_close(depth[0], wanted.clamp(means[:, 2] - limit, means[:, 2] + limit), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(variance[0], 1 / precision[:, 2, 2], rtol=1e-4, atol=1e-5)


def test_splat_rays_without_gradient_behind_camera() -> None:
    means, quats, scales = (tensor.float() for tensor in gaussians(5))
    means[0, 2], means[1, 2], quats[2], scales[3, 1] = -3, 0, 0, math.nan
    inputs = [tensor.requires_grad_() for tensor in (means, quats, scales)]
    rays, normals = splat_rays(*inputs, torch.eye(4), intrinsics(70, 45).float(), "pinhole")
    (rays.sum() + normals.sum()).backward()
    assert bool(rays.isfinite().all()) and bool(normals.isfinite().all())
    assert not any(tensor.grad[:4].any() for tensor in inputs)
    assert all(bool(tensor.grad.isfinite().all()) for tensor in inputs)


@pytest.mark.parametrize("count", [0, 1, 7, 500])
def test_splat_rays_values_and_gradients_equal_reference(count: int) -> None:
    seen, wanted = splat_results(count, "cpu"), splat_results(count, None)
    for name, value in wanted.items():
        error = (seen[name].double() - value).abs().max(0).values if count else torch.zeros(1)
        scale = value.abs().max(0).values if count else torch.ones(1)
        assert bool((error <= 2e-4 * scale + 1e-6).all()), (name, error / scale)


def test_splat_rays_reference_passes_gradcheck() -> None:
    inputs = [tensor.requires_grad_() for tensor in gaussians(4)]
    camera = view(), intrinsics(70, 45)
    function = lambda *tensors: (
        reference.splat_rays(*tensors, *camera)[0][:, :9],
        reference.splat_rays(*tensors, *camera)[1],
    )
    assert torch.autograd.gradcheck(function, inputs)


def test_splat_rays_equal_scales_share_reach_gradient() -> None:
    scales = torch.full((1, 3), 2.0, requires_grad=True)
    tensors = torch.tensor([[0.0, 0, 10]]), torch.tensor([[1.0, 0, 0, 0]]), scales
    rays = splat_rays(*tensors, torch.eye(4), intrinsics(70, 45).float(), "pinhole").rays
    (gradient,) = torch.autograd.grad(rays[0, 8], scales)
    torch.testing.assert_close(gradient, torch.ones(1, 3))


def test_splat_rays_names_invalid_arguments() -> None:
    means, quats, scales = (tensor.float() for tensor in gaussians(3))
    camera = torch.eye(4), intrinsics(70, 45).float(), "pinhole"
    with pytest.raises(InvalidInput, match="quats"):
        splat_rays(means, scales, scales, *camera)
    with pytest.raises(InvalidInput, match="float32"):
        splat_rays(means.double(), quats, scales, *camera)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_splat_rays_ops_pass_opcheck() -> None:
    inputs = [tensor.float().requires_grad_() for tensor in gaussians(9)]
    camera = torch.eye(4), intrinsics(70, 45).float()
    torch.library.opcheck(torch.ops.gsplat_core.splat_rays.default, (*inputs, *camera))
    plain = [tensor.detach() for tensor in inputs]
    results = torch.ops.gsplat_core.splat_rays(*plain, *camera)
    torch.library.opcheck(torch.ops.gsplat_core.splat_rays_backward.default, (*plain, *camera, *results))
