"""Stochastic transparency and point splatting: samples against the expectation in float64, and equal bytes."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch

from gsplat_core import InvalidInput
from gsplat_core.ops.covariance import quat_scale_to_covar_preci
from gsplat_core.ops.stochastic import SplatScene, new_sums, picture_of, sample_splats
from gsplat_core.reference.rendering import dilogarithm, point_moments, rasterization, sample_moments
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from tests.gsplat_core.ops.stochastic_scenes import (
    CAMERA,
    RATES,
    poisson_p_values,
    random_scene,
    raw,
    sampled,
    z_scores,
)

MOMENTS = {"fragments": sample_moments, "points": point_moments}
METHODS = pytest.mark.parametrize("method", ["fragments", "points"])


@METHODS
@pytest.mark.parametrize("supersampling", [1, 2])
def test_stochastic_samples_have_expected_mean_and_variance(method, supersampling):
    samples = 512 if method == "points" else 2048
    gaussians = random_scene(largest=0.15)
    sums = sampled(raw(gaussians), method=method, samples=samples, supersampling=supersampling)
    z = z_scores(
        sums, MOMENTS[method](gaussians.to(dtype=torch.float64), CAMERA, supersampling), samples, supersampling
    )
    assert len(z) > 1000
    # The five channels of a pixel are correlated, which widens the error of the mean by sqrt(5) at most.
    assert abs(z.mean()) < 4 * math.sqrt(5 / len(z))
    assert abs(z.var() - 1) < 4 * math.sqrt(5 * 2 / len(z))
    assert z.abs().max() < 5.5


def test_stochastic_points_of_tiny_and_huge_splats_have_expected_mean():
    # The huge splats are drawn fragment by fragment, because most of their points are outside the picture.
    gaussians = random_scene(12, smallest=0.001, largest=0.003).append(random_scene(3, smallest=30, largest=60, seed=1))
    gaussians = dataclasses.replace(gaussians, logit_opacities=gaussians.logit_opacities.clamp_max(0) - 1)
    sums = sampled(raw(gaussians), method="points", samples=512)
    z = z_scores(sums, point_moments(gaussians.to(dtype=torch.float64), CAMERA), 512)
    assert len(z) > 1000 and abs(z.mean()) < 4 * math.sqrt(5 / len(z)) and z.abs().max() < 5.5


def test_expected_fragments_equal_alpha_blending():
    gaussians = random_scene(30)
    gaussians = dataclasses.replace(gaussians, logit_opacities=gaussians.logit_opacities - 3).to(dtype=torch.float64)
    viewmat, K = CAMERA.matrices(gaussians.device, torch.float64)
    blended, alphas, _ = rasterization(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, viewmat[None], K[None],
        CAMERA.width_px, CAMERA.height_px, sh_degree=3, packed=False,
    )  # fmt: skip
    moments = sample_moments(gaussians, CAMERA)
    torch.testing.assert_close(moments.mean[..., :3], blended[0], atol=1e-12, rtol=0)
    torch.testing.assert_close(moments.mean[..., 3], alphas[0, ..., 0], atol=1e-12, rtol=0)


def test_dilogarithm_known_values():
    x = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    known = [0, torch.pi**2 / 12 - math.log(2) ** 2 / 2, torch.pi**2 / 6]
    torch.testing.assert_close(dilogarithm(x), torch.tensor(known, dtype=torch.float64), atol=1e-9, rtol=0)


def test_poisson_draws_are_exact():
    draws = torch.ops.gsplat_core.poisson_draws(RATES, 20_000, 5)
    assert min(poisson_p_values(draws)) > 0.01
    shifted = torch.ops.gsplat_core.poisson_draws(RATES * 1.1, 20_000, 5)
    assert min(poisson_p_values(shifted)) < 1e-6


@METHODS
def test_stochastic_psnr_grows_3_db_per_doubling_of_samples(method):
    gaussians = random_scene(largest=0.1)
    wanted = MOMENTS[method](gaussians.to(dtype=torch.float64), CAMERA).mean[..., :3]
    psnr = []
    for samples in (4, 64, 1024):
        mean = sampled(raw(gaussians), method=method, samples=samples)[..., :3].double() / samples
        psnr.append(-10 * math.log10((mean - wanted).square().mean()))
    slopes = [(b - a) / 4 for a, b in itertools.pairwise(psnr)]
    assert all(abs(slope - 3.01) < 0.25 for slope in slopes), psnr


@METHODS
def test_stochastic_samples_independent_of_order_and_culling(method):
    gaussians = random_scene(200)
    everything = sampled(raw(gaussians), method=method, samples=6)
    assert torch.equal(everything, sampled(raw(gaussians), method=method, samples=6))
    order = torch.randperm(200, generator=torch.Generator().manual_seed(3))
    permuted = sampled(raw(gaussians.select(order), order.int()), method=method, samples=6)
    assert torch.equal(everything, permuted)
    kept = (gaussians.opacities > 1 / 255).nonzero()[:, 0]
    behind = random_scene(50, seed=9)
    behind = dataclasses.replace(behind, means=behind.means - torch.tensor([0, 0, 20.0]))
    mixed = gaussians.select(kept).append(behind)
    index = torch.cat([kept, 200 + torch.arange(50)]).int()
    assert torch.equal(everything, sampled(raw(mixed, index), method=method, samples=6))
    assert not torch.equal(everything, sampled(raw(gaussians), method=method, samples=6, seed=1))


@METHODS
@pytest.mark.parametrize("threads", [1, 2])
def test_stochastic_samples_independent_of_queue_threads_and_calls(method, threads):
    scene = raw(random_scene(3000, largest=0.1))
    wanted = sampled(scene, method=method, samples=7)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert torch.equal(wanted, sampled(scene, method=method, samples=7, queue_bytes=72 * 100))
    finally:
        torch.set_num_threads(before)
    sums = new_sums(CAMERA, "cpu")
    for first, count in ((0, 3), (3, 1), (4, 3)):
        sample_splats(scene, CAMERA, sums, method=method, first_sample=first, samples=count)
    assert torch.equal(wanted, sums)


@METHODS
def test_stochastic_covariances_equal_rotations_and_scales(method):
    gaussians = random_scene()
    covars, _ = quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, compute_preci=False, triu=True)
    scene = SplatScene(means=gaussians.means, covars=covars, opacities=gaussians.opacities, sh=gaussians.sh)
    a, b = (sampled(s, method=method, samples=16) for s in (scene, raw(gaussians)))
    different = (a[..., 3:4] != b[..., 3:4]).float().mean()
    assert different < 0.01 and float((a - b).abs().mean()) < 0.01


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@METHODS
def test_stochastic_samples_of_every_camera_model(method, model):
    camera = dataclasses.replace(CAMERA, model=model)
    if model == "ortho":
        camera = dataclasses.replace(camera, K=camera.K * torch.tensor([[0.25, 1, 1], [1, 0.25, 1], [1, 1, 1]]).numpy())
    gaussians = random_scene(largest=0.15)
    sums = sampled(raw(gaussians), camera, method=method, samples=300)
    z = z_scores(sums, MOMENTS[method](gaussians.to(dtype=torch.float64), camera), 300)
    assert len(z) > 300 and abs(z.mean()) < 5 * math.sqrt(5 / len(z)) and z.abs().max() < 6


@pytest.mark.parametrize("covariances", [False, True])
def test_stochastic_pixel_order_gives_depth_of_slanted_plane(covariances):
    # One flat, opaque splat at 4 units, turned by 40 degrees about y.
    angle = math.radians(40)
    gaussians = Gaussians(
        torch.tensor([[0.1, 0, 4.0]]),
        torch.tensor([[math.cos(angle / 2), 0, math.sin(angle / 2), 0]]),
        torch.tensor([[1.0, 1.0, 0.01]]).log(),
        torch.tensor([12.0]),
        torch.zeros(1, 1, 3),
    )
    scene = raw(gaussians)
    if covariances:
        covars, _ = quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, compute_preci=False, triu=True)
        scene = SplatScene(means=gaussians.means, covars=covars, opacities=gaussians.opacities, sh=gaussians.sh)
    depth = {order: picture_of(sampled(scene, samples=64, pixel_order=order), 64).depth for order in (False, True)}
    x = (torch.arange(CAMERA.width_px) + 0.5 - CAMERA.width_px / 2) / 60
    # Rotation about y by +40 degrees turns the plane's x axis to (cos, 0, -sin).
    wanted = (4 + 0.1 * math.tan(angle)) / (1 + x * math.tan(angle))
    row = depth[True][CAMERA.height_px // 2]
    seen = row > 0
    assert seen.sum() > 10
    torch.testing.assert_close(row[seen], wanted[seen], rtol=2e-3 if covariances else 2e-4, atol=0)
    assert torch.equal(depth[False][depth[False] > 0], torch.full_like(depth[False][depth[False] > 0], 4.0))


@METHODS
def test_stochastic_sampling_skips_non_finite_splats(method):
    gaussians = random_scene(40)
    wanted = sampled(raw(gaussians), method=method, samples=4)
    bad = random_scene(12, seed=2)
    for row, (tensor, value) in enumerate(
        (t, v)
        for t in (bad.means, bad.quats, bad.log_scales, bad.logit_opacities)
        for v in (float("nan"), float("inf"), -float("inf"))
    ):
        tensor[row] = value
    bad.logit_opacities[9:] = -float("inf")
    bad.logit_opacities[9] = float("nan")
    bad.log_scales[8] = float("nan")  # -inf is a point, which is visible
    seen = sampled(raw(gaussians.append(bad)), method=method, samples=4)
    assert torch.equal(wanted, seen)


@METHODS
def test_stochastic_sampling_of_empty_scene(method):
    assert not sampled(raw(random_scene(0)), method=method, samples=4).any()
    picture = picture_of(new_sums(CAMERA, "cpu"), 4, torch.tensor([0.1, 0.2, 0.3]))
    assert torch.allclose(picture.image, torch.tensor([0.1, 0.2, 0.3])) and not picture.depth.any()


def test_stochastic_ops_pass_opcheck():
    options = [CAMERA.width_px, CAMERA.height_px, 0, 0, 0, 0, 2, 1, 0, 1 << 20]
    viewmat, K = CAMERA.matrices(torch.device("cpu"))
    arguments = (list(raw(random_scene(5))), viewmat, K, new_sums(CAMERA, "cpu"), options)
    torch.library.opcheck(torch.ops.gsplat_core.splat_samples_.default, arguments)
    torch.library.opcheck(torch.ops.gsplat_core.poisson_draws.default, (RATES, 3, 0))


def test_stochastic_sampling_rejects_invalid_arguments():
    scene = raw(random_scene(5))
    sums = new_sums(CAMERA, "cpu")
    fisheye = dataclasses.replace(CAMERA, model="fisheye")
    for options, message in [
        ({"method": "boxes"}, "unknown method 'boxes'; choose fragments or points"),
        ({"pixel_order": True, "method": "points"}, "order by pixel needs stochastic transparency"),
        ({"supersampling": 0}, "sub-pixels per side"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            sample_splats(scene, CAMERA, sums, **options)
    with pytest.raises(InvalidInput, match="pinhole"):
        sample_splats(scene, fisheye, sums, pixel_order=True)
    with pytest.raises(InvalidInput, match=r"sums must be \[24, 32, 5\]"):
        sample_splats(scene, CAMERA, sums[:, :-1])
    with pytest.raises(InvalidInput, match=r"means of the splats must be float32, got torch\.float64"):
        sample_splats(scene._replace(means=scene.means.double()), CAMERA, sums)
    for change, message in [
        ({"quats": None}, "covars and opacities, or quats"),
        ({"sh": scene.sh[:, :3]}, "1, 4, 9, 16 or 25"),
        ({"file_index": torch.zeros(4, dtype=torch.int32)}, "index must have 5 rows"),
    ]:
        with pytest.raises(RuntimeError, match=message):
            sample_splats(scene._replace(**change), CAMERA, sums)
    with pytest.raises(InvalidInput, match="pixel"):
        sample_splats(scene, Camera.from_focal(10, 70_000, 1), new_sums(Camera.from_focal(10, 70_000, 1), "cpu"))
