"""Renderers that sample: pictures against alpha blending, progressive frames, and formats of scenes."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from gsplat_core.deformation import new_field
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.models import Model
from gsplat_core.ops.stochastic import new_sums, picture_of, sample_splats
from gsplat_core.rendering.renderer import RendererOptions, new_renderer
from gsplat_core.rendering.stochastic import dequantised, morton_codes, prepared_splats, quantised_splats, raw_splats
from gsplat_core.scene.cameras import Camera
from tests.gsplat_core.ops.stochastic_scenes import random_scene

CAMERA = Camera.from_focal(90, 48, 36)


def model_of(gaussians):
    return Model(1, gaussians, None, CAMERA, (0.0, 1.0))


def psnr(a, b):
    return -10 * math.log10(max(float((a - b).square().mean()), 1e-12))


def rendered(name, model, options=None, background=None, camera=CAMERA):
    renderer = new_renderer(name, camera, options=options, background=background)
    renderer.prepare(model)
    return renderer.render(camera, 0.0).result()


@pytest.mark.parametrize("name", ["stochastic", "points"])
def test_sampling_renderer_mean_approaches_alpha_blending(name):
    model = model_of(random_scene(80, smallest=0.05, largest=0.2))
    background = torch.tensor([0.2, 0.4, 0.6])
    wanted = rendered("alpha", model, background=background)
    # Points integrate over a sub-pixel, so they need supersampling to approach the value at a pixel's centre.
    options = RendererOptions(samples=256, supersampling=3 if name == "points" else 1)
    seen = rendered(name, model, options, background)
    assert psnr(seen.image, wanted.image) > 33
    assert (seen.alpha - wanted.alpha).abs().mean() < 0.02
    covered = wanted.alpha > 0.5
    assert ((seen.depth - wanted.depth) / wanted.depth)[covered].abs().mean() < 0.02


@pytest.mark.parametrize("name", ["stochastic", "points"])
def test_progressive_frames_accumulate_samples_until_change(name):
    model = model_of(random_scene(50))
    renderer = new_renderer(name, CAMERA, options=RendererOptions(samples=4, progressive=True))
    renderer.prepare(model)
    for _ in range(3):
        last = renderer.render(CAMERA, 0.0).result().image
    assert renderer.samples_drawn == 12
    assert torch.equal(last, rendered(name, model, RendererOptions(samples=12)).image)
    moved = CAMERA.with_pose([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    renderer.render(moved, 0.0)
    assert renderer.samples_drawn == 4
    renderer.prepare(model_of(model.gaussians))
    renderer.render(moved, 0.0)
    assert renderer.samples_drawn == 4


def test_non_progressive_frames_independent_of_earlier_frames():
    model = model_of(random_scene(50))
    renderer = new_renderer("stochastic", CAMERA, options=RendererOptions(samples=2))
    renderer.prepare(model)
    first, second = (renderer.render(CAMERA, 0.0).result().image for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, rendered("stochastic", model, RendererOptions(samples=2, seed=1)).image)


def test_pixel_order_supported_by_stochastic_renderer_only():
    model = model_of(random_scene(50))
    by_splat, by_pixel = (
        rendered("stochastic", model, RendererOptions(samples=8, order=order)).image for order in ("splat", "pixel")
    )
    assert not torch.equal(by_splat, by_pixel) and psnr(by_splat, by_pixel) > 10
    with pytest.raises(InvalidSetting, match="renderer 'points' has no option order; choose stochastic"):
        new_renderer("points", CAMERA, options=RendererOptions(order="pixel"))
    fisheye = dataclasses.replace(CAMERA, model="fisheye")
    with pytest.raises(InvalidSetting, match="order pixel needs a pinhole camera, not fisheye; choose order splat"):
        new_renderer("stochastic", fisheye, options=RendererOptions(order="pixel"))


def test_stochastic_renderer_rejects_misuse():
    renderer = new_renderer("stochastic", CAMERA)
    with pytest.raises(InvalidInput, match="prepare"):
        renderer.render(CAMERA, 0.0)
    renderer.prepare(model_of(random_scene(5)))
    with pytest.raises(InvalidSetting, match="has no output 'normals'"):
        renderer.render(CAMERA, 0.0, ["normals"])
    assert set(renderer.render(CAMERA, 0.0, ["image"]).outputs()) == {"image"}


def picture(scene, samples=512):
    sums = new_sums(CAMERA, "cpu")
    sample_splats(scene, CAMERA, sums, samples=samples)
    return picture_of(sums, samples).image


def test_prepared_splats_omit_invisible_splats_without_image_change():
    gaussians = random_scene(100)
    gaussians.logit_opacities[::3] = -9.0
    scene = prepared_splats(gaussians)
    assert scene.splat_count == int((gaussians.opacities >= 1 / 255).sum()) < 100
    assert psnr(picture(scene, 16), picture(raw_splats(gaussians), 16)) > 40
    whole = prepared_splats(random_scene(20).select(slice(0, 3)))
    assert whole.file_index is None


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_quantised_splats_image_psnr(degree):
    gaussians = random_scene(5000, smallest=0.02, largest=0.1, degree=degree)
    scene = quantised_splats(gaussians)
    assert scene.packed.element_size() * scene.packed.shape[1] == 16
    # The random numbers are the same, so the difference is that of the values.
    assert psnr(picture(scene), picture(raw_splats(gaussians))) > 38


@pytest.mark.parametrize("degree", [0, 3, 4])
def test_quantised_kernel_decoding_equals_python(degree):
    scene = quantised_splats(random_scene(6000, smallest=0.02, largest=0.1, degree=degree))
    decoded = raw_splats(dequantised(scene))._replace(file_index=scene.file_index)
    assert psnr(picture(scene, 4), picture(decoded, 4)) > 45


def test_quantised_values_close_to_original():
    gaussians = random_scene(1)
    for w in range(4):
        quat = torch.full((1, 4), 0.2)
        quat[0, w] = -0.9
        one = dataclasses.replace(gaussians, quats=quat, logit_opacities=torch.tensor([2.0]))
        assert psnr(picture(quantised_splats(one), 4), picture(raw_splats(one), 4)) > 40
    assert quantised_splats(random_scene(0)).splat_count == 0


def test_morton_codes_interleave_axes():
    corners = torch.tensor([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
    assert morton_codes(corners).argsort().tolist() == list(range(8))
    assert morton_codes(corners)[-1] == (1 << 63) - 1


@pytest.mark.parametrize("name", ["stochastic", "points"])
def test_storages_give_same_image_with_same_random_numbers(name):
    model = model_of(random_scene(80, smallest=0.05, largest=0.2))
    raw, prepared, quantised = (
        rendered(name, model, RendererOptions(samples=8, storage=storage)).image
        for storage in ("raw", "prepared", "quantised")
    )
    assert psnr(raw, prepared) > 60
    assert psnr(raw, quantised) > 30
    assert not torch.equal(raw, quantised)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_stochastic_renderer_rejects_other_precisions(dtype):
    renderer = new_renderer("stochastic", CAMERA)
    renderer.prepare(model_of(random_scene(20).to(dtype=dtype)))
    with pytest.raises(InvalidInput, match=f"means of the splats must be float32, got {dtype}; convert the Gaussians"):
        renderer.render(CAMERA, 0.0)


def test_moving_model_requires_raw_storage():
    gaussians = random_scene(20)
    moving = dataclasses.replace(model_of(gaussians), field=new_field("basis", gaussians, (0.0, 1.0)).detached_copy())
    renderer = new_renderer("stochastic", CAMERA, options=RendererOptions(storage="quantised"))
    with pytest.raises(InvalidSetting, match="choose storage raw"):
        renderer.prepare(moving)
    with pytest.raises(InvalidSetting, match="unknown storage 'zip'; choose raw or prepared or quantised"):
        RendererOptions(storage="zip")
