"""Unscented projection, blending along rays, and the gradient of intrinsics on CUDA against the CPU."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import RollingShutterType, fully_fused_projection_with_ut, rasterization
from gsplat_core.poses.se3 import exp
from tests.gsplat_core.ops.test_unscented_kernels import CAMERAS, project, wide_scene
from tests.gsplat_core.ops.test_unscented_projection import H, W
from tests.gsplat_core.rendering import test_unscented as pictures


def moved(values, device):
    return {name: value.to(device) if isinstance(value, torch.Tensor) else value for name, value in values.items()}


@pytest.mark.parametrize("rolls", [None, RollingShutterType.ROLLING_TOP_TO_BOTTOM])
@pytest.mark.parametrize("name", CAMERAS)
def test_unscented_projection_equals_cpu_and_is_deterministic(gpu, name, rolls):
    given, options = wide_scene(3000), dict(CAMERAS[name])
    if rolls is not None:
        end = exp(torch.tensor([[0.04, 0.02, 0.0, 0.03, -0.05, 0.2]], dtype=torch.float64)) @ given["viewmats"]
        options |= {"rolling_shutter": rolls, "viewmats_rs": end}
    expected, expected_gradients = project(given, torch.float32, **options)
    found, gradients = project(moved(given, gpu), torch.float32, **moved(options, gpu))
    again, gradients_again = project(moved(given, gpu), torch.float32, **moved(options, gpu))
    for first, second in zip((*found, *gradients), (*again, *gradients_again), strict=True):
        assert torch.equal(first, second)
    same = (found.radii.cpu() == expected.radii).all(-1)
    assert same.float().mean() > 0.99  # a radius may be rounded the other way
    for actual, wanted in zip(found[1:], expected[1:], strict=True):
        torch.testing.assert_close(
            actual.detach().cpu()[same],
            wanted.detach()[same],
            rtol=2e-3,
            atol=2e-4 * float(wanted.detach().abs().max()),
        )
    for actual, wanted in zip(gradients, expected_gradients, strict=True):
        close = (actual.cpu() - wanted).abs() <= 5e-3 * wanted.abs() + 5e-4 * wanted.abs().max()
        assert close.float().mean() > 0.99


def test_unscented_projection_captured_in_graph(gpu):
    given = moved({name: value.float() for name, value in wide_scene(500).items()}, gpu)
    options = {name: value.float().to(gpu) for name, value in CAMERAS["distorted"].items()}
    run = lambda: fully_fused_projection_with_ut(**given, width=W, height=H, **options)
    with torch.no_grad():
        expected = run()
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            found = run()
        graph.replay()
    torch.cuda.synchronize()
    for actual, wanted in zip(found[:4], expected[:4], strict=True):
        assert torch.equal(actual, wanted)


@pytest.mark.parametrize("kind", ["plain", "packed", "unscented", "eval3d"])
def test_unscented_images_and_gradients_equal_cpu(gpu, kind):
    results = []
    for device in ("cpu", gpu, gpu):
        given = pictures.scene()
        options = {"packed": kind == "packed"}
        if kind in ("unscented", "eval3d"):
            given["radial_coeffs"] = torch.tensor([[-0.2, 0.05, 0, 0.01, 0, 0]])
            options |= {"with_ut": True, "with_eval3d": kind == "eval3d"}
        given = {name: value.to(device).requires_grad_() for name, value in given.items()}
        image, alphas, _ = rasterization(**given, **options, width=pictures.W, height=pictures.H, render_mode="RGB+ED")
        (image.square().sum() + alphas.sum()).backward()
        results.append({"image": image.detach(), **{name: each.grad for name, each in given.items()}})
    expected, found, again = results
    for name, value in expected.items():
        assert torch.equal(found[name], again[name]), name
        largest = float(value.abs().max())
        torch.testing.assert_close(found[name].cpu(), value, rtol=5e-3, atol=5e-3 * largest, msg=name)


@pytest.mark.parametrize("channels", [1, 3, 21])
def test_blending_along_rays_without_gradients_equals_cpu(gpu, channels):
    results = []
    for device in ("cpu", gpu, gpu):
        given = moved(pictures.scene(), device)
        given["colors"] = torch.rand(60, channels, generator=torch.Generator().manual_seed(3)).to(device)
        options = {
            "with_ut": True,
            "with_eval3d": True,
            "radial_coeffs": torch.tensor([[-0.2, 0.05, 0, 0, 0, 0]], device=device),
        }
        results.append(rasterization(**given, **options, width=pictures.W, height=pictures.H)[:2])
    for expected, found, again in zip(*results, strict=True):
        assert torch.equal(found, again)
        assert (found.cpu() - expected).abs().max() < 5e-3 and (found.cpu() - expected).abs().mean() < 2e-5
