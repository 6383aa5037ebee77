"""Ray depths of Gaussians by their definition, and their compiled blending against plain torch in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ray_blending.ray_blending import MAX_CHANNELS, blend_rays, splat_rays
from gsplat_core.reference.ray_blending import depths_of_rays, ray_depths
from tests.gsplat_core.ops.ray_scenes import INPUTS, assert_close, gaussians, intrinsics, ray_scene, with_bad_values


def view() -> torch.Tensor:
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.15], [-0.2, 0.15, 0]], dtype=torch.float64)
    )
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = turn, torch.tensor([1.0, -2.0, 3.0])
    return matrix


def depths_by_coefficients(means, quats, scales, viewmat, K, pixels):
    rays = splat_rays(means, quats, scales, viewmat, K, "pinhole")
    local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    means2d = local[:, :2] / local[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    return depths_of_rays(rays, pixels[:, None] - means2d)


@pytest.mark.parametrize("flatness", [1.0, 1e-3])
def test_coefficients_give_the_midpoint_of_the_chord_and_its_gradient(flatness: float) -> None:
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


def test_single_precision_is_accurate_for_flat_splats() -> None:
    means, quats, scales = gaussians(200)
    scales[:, 1] = 1e-3 * scales[:, 0]
    K = intrinsics(640, 512)
    pixels = means[:, :2] / means[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    pixels = pixels + torch.randn(200, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64)
    wanted = depths_by_coefficients(means, quats, scales, eye, K, pixels)[0].diagonal()
    single = [tensor.float() for tensor in (means, quats, scales, eye, K, pixels)]
    seen = depths_by_coefficients(*single)[0].diagonal().double()
    assert float(((seen - wanted) / wanted).abs().median()) < 1e-6
    assert float(((seen - wanted) / wanted).abs().max()) < 1e-3


def test_other_projections() -> None:
    means, quats, scales = gaussians(30)
    K, eye = intrinsics(70, 45), torch.eye(4, dtype=torch.float64)
    fisheye = splat_rays(means, quats, scales, eye, K, "fisheye")
    depth, _ = depths_of_rays(fisheye, torch.randn(5, 30, 2, dtype=torch.float64))
    torch.testing.assert_close(depth, means[:, 2].expand(5, -1))
    # A parallel ray through (x, y): minimum of the Mahalanobis distance over z, in closed form.
    ortho = splat_rays(means, quats, scales, eye, K, "ortho")
    covariance, _ = reference.quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    precision = torch.linalg.inv(covariance)
    offset = torch.tensor([0.3, -0.2], dtype=torch.float64)
    wanted = means[:, 2] - (precision[:, 2, :2] @ offset) / precision[:, 2, 2]
    depth, variance = depths_of_rays(ortho, (offset * K.diagonal()[:2]).expand(1, 30, 2))
    limit = 3 * scales.amax(1)
    torch.testing.assert_close(depth[0], wanted.clamp(means[:, 2] - limit, means[:, 2] + limit))
    torch.testing.assert_close(variance[0], 1 / precision[:, 2, 2])


def test_splats_behind_the_camera_have_no_gradient() -> None:
    means, quats, scales = (tensor.float() for tensor in gaussians(4))
    means[0, 2], means[1, 2], quats[2] = -3, 0, 0
    inputs = [tensor.requires_grad_() for tensor in (means, quats, scales)]
    rays = splat_rays(*inputs, torch.eye(4), intrinsics(70, 45).float(), "pinhole")
    rays.sum().backward()
    assert bool(rays.isfinite().all())
    assert not means.grad[:2].any() and not scales.grad[:2].any()
    assert all(bool(tensor.grad.isfinite().all()) for tensor in inputs)


@pytest.mark.parametrize("channels", [0, 1, 3, 4, 8, 9, MAX_CHANNELS])
def test_random_scene_for_any_number_of_channels(channels: int) -> None:
    assert_close(ray_scene(300, channels=channels))


@pytest.mark.parametrize("size", [(1, 1), (33, 50), (16, 16), (7, 100)])
@pytest.mark.parametrize("count", [0, 1, 90])
def test_any_image_size_and_few_splats(size: tuple[int, int], count: int) -> None:
    assert_close(ray_scene(count, *size))


def test_opaque_and_thin_splats() -> None:
    s = ray_scene(300)
    s.opacities[::2] = 1.0
    s.conics[1::5] = torch.tensor([1e-8, 0.0, 1e-8])
    s.conics[2::5] = torch.tensor([3.3, 0.0, 3.3])
    s.conics[3::25] = 0.0
    assert_close(s)


def test_values_that_are_not_finite_are_skipped_and_get_no_gradient() -> None:
    s, bad = with_bad_values(ray_scene(200))
    seen = assert_close(s)
    good = replace(s, **{name: getattr(s, name)[~bad] for name in INPUTS})
    wanted = good.run()
    for name, value in wanted.items():
        if name.startswith("v_"):
            assert not seen[name][bad].any()
            assert torch.equal(seen[name][~bad], value)
        else:
            assert torch.equal(seen[name], value)


def test_two_veils_before_a_wall() -> None:
    depths = [30.0, 40.0, 50.0]
    flat = [torch.tensor([z, 0, 0, 0, 0, 0, 0, 0, 1, 0.25]) for z in depths]
    one = torch.ones(3, 1)
    blended = blend_rays(
        *(torch.full((3, 2), 0.5), torch.tensor([1e-9, 0, 1e-9]).expand(3, 3), torch.tensor([0.3, 0.5, 0.9])),
        *(torch.stack(flat), one, 1, 1, torch.zeros(1, 1, dtype=torch.int32), torch.arange(3, dtype=torch.int32)),
    )
    weights = torch.tensor([0.3, 0.35, 0.315])
    mean = float((weights * torch.tensor(depths)).sum() / weights.sum())
    assert float(blended.depths) == pytest.approx(mean, rel=1e-6)
    assert float(blended.medians) == 40.0
    assert float(blended.alphas) == pytest.approx(float(weights.sum()), rel=1e-6)
    variance = float((weights * ((torch.tensor(depths) - mean) ** 2 + 0.25)).sum() / weights.sum())
    assert float(blended.variances) == pytest.approx(variance, rel=1e-5)


def test_the_same_bits_for_any_number_of_threads() -> None:
    s = ray_scene(3000, 300, 200)
    threads = torch.get_num_threads()
    try:
        runs = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            runs.append(s.run())
    finally:
        torch.set_num_threads(threads)
    for other in runs[1:]:
        assert all(torch.equal(other[name], value) for name, value in runs[0].items())


def test_the_reference_gradient_is_the_derivative() -> None:
    s = ray_scene(6, 5, 4, channels=2)
    s.conics[:] = torch.tensor([0.1, 0.02, 0.15])  # no alpha crosses a cut-off within the differences
    s.means2d[:] = torch.rand(6, 2, generator=torch.Generator().manual_seed(1)) * 4
    inputs = [getattr(s, name).double().requires_grad_() for name in INPUTS]
    lists = s.lists()
    assert torch.autograd.gradcheck(lambda *t: reference.blend_rays(*t, 5, 4, *lists)[:4], inputs, atol=1e-4)


def test_wrong_arguments_are_named() -> None:
    s = ray_scene(5)
    rest = (s.width, s.height, *s.lists())
    tensors = [getattr(s, name) for name in INPUTS]
    with pytest.raises(InvalidInput, match=r"rays must have shape \['N', 10\]"):
        blend_rays(*tensors[:3], s.rays[:, :9], s.values, *rest)
    with pytest.raises(InvalidInput, match=r"values must be \[5, D\] with D up to 15"):
        blend_rays(*tensors[:4], torch.zeros(5, 16), *rest)
    with pytest.raises(InvalidInput, match="float64; gsplat_core"):
        blend_rays(*tensors[:3], s.rays.double(), s.values, *rest)
    with pytest.raises(InvalidInput, match="do not cover the image"):
        blend_rays(*tensors, 500, 45, *rest[2:])
    for most in (0.0, 1.0, math.nan):
        with pytest.raises(InvalidInput, match="max_alpha must be from 1/255"):
            blend_rays(*tensors, *rest, max_alpha=most)
    with pytest.raises(RuntimeError, match="flatten_ids must be in"):
        blend_rays(*tensors, *rest[:3], rest[3] + 5)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
@pytest.mark.parametrize("limit", [(), (0.999,)])
def test_ops_pass_opcheck(limit: tuple[float, ...]) -> None:
    s = ray_scene(30, 20, 18)
    lists = s.lists()
    splats = [getattr(s, name).requires_grad_() for name in INPUTS]
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.blend_rays.default, (*splats, *lists, s.width, s.height, *limit))
    with torch.no_grad():
        plain = [tensor.detach() for tensor in splats]
        values, alphas, depths, medians, _, last, at = ops.blend_rays(*plain, *lists, s.width, s.height, *limit)
        arguments = (
            *plain,
            *lists,
            s.width,
            s.height,
            alphas,
            depths,
            last,
            at,
            values,
            alphas,
            depths,
            medians,
            *limit,
        )
        torch.library.opcheck(ops.blend_rays_backward.default, arguments)
