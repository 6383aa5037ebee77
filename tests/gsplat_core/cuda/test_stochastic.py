"""Stochastic transparency and point splatting on CUDA: expectation, the CPU's random numbers, and equal bytes."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core.ops.covariance import quat_scale_to_covar_preci
from gsplat_core.ops.stochastic import SplatScene, new_sums, sample_splats
from gsplat_core.reference.rendering import point_moments, sample_moments
from gsplat_core.scene.cameras import Camera
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
def test_stochastic_samples_have_expected_mean_and_variance(gpu, method, supersampling):
    gaussians = random_scene()
    sums = sampled(raw(gaussians.to(gpu)), method=method, samples=4096, supersampling=supersampling)
    z = z_scores(sums, MOMENTS[method](gaussians.to(dtype=torch.float64), CAMERA, supersampling), 4096, supersampling)
    assert len(z) > 1000
    assert abs(z.mean()) < 4 * math.sqrt(5 / len(z))
    assert abs(z.var() - 1) < 4 * math.sqrt(5 * 2 / len(z))
    assert z.abs().max() < 5.5


def test_stochastic_points_of_tiny_and_huge_splats_have_expected_mean(gpu):
    gaussians = random_scene(12, smallest=0.001, largest=0.003).append(random_scene(3, smallest=30, largest=60, seed=1))
    sums = sampled(raw(gaussians.to(gpu)), method="points", samples=4096)
    z = z_scores(sums, point_moments(gaussians.to(dtype=torch.float64), CAMERA), 4096)
    assert abs(z.mean()) < 4 * math.sqrt(5 / max(len(z), 1)) and (len(z) == 0 or z.abs().max() < 5.5)


@METHODS
@pytest.mark.parametrize("samples", [1, 6])
def test_stochastic_samples_nearly_equal_cpu(gpu, method, samples):
    gaussians = random_scene(500, largest=0.1)
    ours = sampled(raw(gaussians.to(gpu)), method=method, samples=samples).cpu()
    theirs = sampled(raw(gaussians), method=method, samples=samples)
    # Rounding of alpha or of a point's place changes a few samples.
    assert float((ours[..., 3] != theirs[..., 3]).float().mean()) < 0.01
    assert float((ours - theirs).abs().mean()) < 0.01 * samples


def test_poisson_draws_are_exact(gpu):
    draws = torch.ops.gsplat_core.poisson_draws(RATES.to(gpu), 100_000, 5)
    # Exact draws of 20 rates have a p-value below 0.01 / 20 in one of a hundred runs.
    assert min(poisson_p_values(draws)) > 0.01 / len(RATES)
    here = torch.ops.gsplat_core.poisson_draws(RATES, 1000, 5)
    assert float((draws[:, :1000].cpu() != here).float().mean()) < 1e-3


@METHODS
def test_stochastic_samples_independent_of_order_and_culling(gpu, method):
    gaussians = random_scene(20_000, largest=0.1)
    wanted = sampled(raw(gaussians.to(gpu)), method=method, samples=6)
    assert torch.equal(wanted, sampled(raw(gaussians.to(gpu)), method=method, samples=6))
    order = torch.randperm(20_000, generator=torch.Generator().manual_seed(3))
    permuted = raw(gaussians.select(order).to(gpu), order.int().to(gpu))
    assert torch.equal(wanted, sampled(permuted, method=method, samples=6))
    kept = (gaussians.opacities > 1 / 255).nonzero()[:, 0]
    culled = raw(gaussians.select(kept).to(gpu), kept.int().to(gpu))
    assert torch.equal(wanted, sampled(culled, method=method, samples=6))


@METHODS
@pytest.mark.parametrize("queue_splats", [1, 33, 1000])
def test_stochastic_queue_rounds_equal_single_round(gpu, method, queue_splats):
    scene = raw(random_scene(1500, largest=0.5).to(gpu))
    wanted = sampled(scene, method=method, samples=5)
    assert torch.equal(wanted, sampled(scene, method=method, samples=5, queue_bytes=72 * queue_splats))
    sums = new_sums(CAMERA, gpu)
    for first, count in ((0, 3), (3, 1), (4, 1)):
        sample_splats(scene, CAMERA, sums, method=method, first_sample=first, samples=count)
    assert torch.equal(wanted, sums)


@METHODS
def test_stochastic_large_image_with_huge_and_tiny_splats(gpu, method):
    camera = Camera.from_focal(900, 1280, 720)
    gaussians = random_scene(30_000, smallest=0.001, largest=0.02).append(random_scene(40, 0.5, 3, seed=1))
    ours = sampled(raw(gaussians.to(gpu)), camera, method=method, samples=2).cpu()
    theirs = sampled(raw(gaussians), camera, method=method, samples=2)
    assert float((ours[..., 3] != theirs[..., 3]).float().mean()) < 0.01


def test_stochastic_scene_formats_and_depth_orders_agree(gpu):
    gaussians = random_scene().to(gpu)
    covars, _ = quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, compute_preci=False, triu=True)
    scene = SplatScene(means=gaussians.means, covars=covars, opacities=gaussians.opacities, sh=gaussians.sh)
    for pixel_order in (False, True):
        a, b = (sampled(s, samples=16, pixel_order=pixel_order) for s in (scene, raw(gaussians)))
        assert float((a[..., 3] != b[..., 3]).float().mean()) < 0.01
        cpu = sampled(raw(gaussians.to("cpu")), samples=16, pixel_order=pixel_order)
        assert float((b.cpu() - cpu).abs().mean()) < 0.05


@METHODS
def test_stochastic_sampling_captured_in_graph(gpu, method):
    scene = raw(random_scene(300).to(gpu))
    wanted = sampled(scene, method=method, samples=5)
    viewmat, K = CAMERA.matrices(gpu)
    index = ["fragments", "points"].index(method)
    options = [CAMERA.width_px, CAMERA.height_px, 0, index, 0, 0, 5, 1, 0, 1 << 20]
    sums = new_sums(CAMERA, gpu)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.ops.gsplat_core.splat_samples_(list(scene), viewmat, K, sums.clone(), options)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        torch.ops.gsplat_core.splat_samples_(list(scene), viewmat, K, sums, options)
    graph.replay()
    torch.cuda.synchronize()
    assert torch.equal(wanted, sums)


@METHODS
def test_stochastic_sampling_of_empty_scene_and_non_finite_values(gpu, method):
    assert not sampled(raw(random_scene(0).to(gpu)), method=method, samples=4).any()
    gaussians = random_scene(40)
    wanted = sampled(raw(gaussians.to(gpu)), method=method, samples=4)
    bad = random_scene(5, seed=2)
    bad.means[0], bad.quats[1], bad.log_scales[2] = float("nan"), float("inf"), float("nan")
    bad.logit_opacities[3:] = torch.tensor([float("nan"), -float("inf")])
    assert torch.equal(wanted, sampled(raw(gaussians.append(bad).to(gpu)), method=method, samples=4))


def test_stochastic_sampling_passes_opcheck(gpu):
    viewmat, K = CAMERA.matrices(gpu)
    options = [CAMERA.width_px, CAMERA.height_px, 0, 0, 0, 0, 2, 1, 0, 1 << 20]
    arguments = (list(raw(random_scene(5).to(gpu))), viewmat, K, new_sums(CAMERA, gpu), options)
    torch.library.opcheck(torch.ops.gsplat_core.splat_samples_.default, arguments)
