"""`FrameRenderer`: whole frames from one graph, with tile lists that grow, against `render`."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, InvalidInput, render
from gsplat_core.deformation import BasisField
from gsplat_core.rendering.alpha import FrameRenderer

WIDTH_PX, HEIGHT_PX = 150, 101


@pytest.fixture
def camera() -> Camera:
    return Camera.from_focal(120.0, WIDTH_PX, HEIGHT_PX)


@pytest.fixture
def scene(make_gaussians) -> Gaussians:
    return make_gaussians(800, sh_degree=2).to("cuda")


def shifted(camera: Camera, x_mm: float) -> Camera:
    pose = np.linalg.inv(camera.world_to_camera)
    pose[0, 3] += x_mm
    return camera.with_pose(pose)


def assert_same_picture(output, expected):
    torch.testing.assert_close(output.image, expected.image, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(output.alpha, expected.alpha, rtol=1e-4, atol=1e-4)
    seen = expected.alpha > 0.05
    torch.testing.assert_close(output.depth[seen], expected.depth[seen], rtol=1e-3, atol=1e-3)


def test_frame_renderer_equals_render_from_every_camera(scene, camera):
    renderer = FrameRenderer(scene, camera)
    for x_mm in (0.0, 2.0, -3.0):
        assert_same_picture(renderer.render(shifted(camera, x_mm)).result(), render(scene, shifted(camera, x_mm)))


def test_frame_renderer_follows_time_of_field(scene, camera):
    field = BasisField(scene.count, (0.0, 1.0), bumps=6).to("cuda")
    torch.nn.init.normal_(field.weights, std=0.3)
    renderer = FrameRenderer(scene, camera, field)
    pictures = []
    for time_s in (0.0, 0.4, 0.9, 7.0):
        output = renderer.render(time_s=time_s).result()
        with torch.no_grad():
            assert_same_picture(output, render(field(scene, time_s), camera))
        pictures.append(output.image.clone())
    assert not torch.allclose(pictures[0], pictures[1], atol=1e-2)


def test_frame_renderer_uses_parameters_changed_in_place(scene, camera):
    renderer = FrameRenderer(scene, camera)
    renderer.render().result()
    scene.means.add_(1.5)
    assert_same_picture(renderer.render().result(), render(scene, camera))


@pytest.mark.parametrize(("count", "per_tile"), [(300, True), (3000, False)])
def test_frame_renderer_grows_short_tile_lists(make_gaussians, camera, count, per_tile):
    # Each of these covers most of the picture: far more instances than the four per Gaussian that are expected.
    scene = make_gaussians(count).to("cuda")
    scene = dataclasses.replace(scene, log_scales=torch.full_like(scene.log_scales, 2.3))
    renderer = FrameRenderer(scene, camera)
    first = renderer.capacity
    output = renderer.render().result()
    assert first.per_tile
    assert renderer.capacity.per_tile == per_tile
    assert renderer.capacity.capacity > first.capacity
    assert_same_picture(output, render(scene, camera))


def test_frame_renderer_is_deterministic(scene, camera):
    renderer = FrameRenderer(scene, camera)
    first = [t.clone() for t in renderer.render().result()]
    renderer.render(shifted(camera, 4.0)).result()
    for a, b in zip(first, renderer.render().result(), strict=True):
        assert torch.equal(a, b)


def test_frame_renderer_background_equals_render(scene, camera):
    background = torch.tensor([0.2, 0.5, 0.9], device="cuda")
    output = FrameRenderer(scene, camera, background=background).render().result()
    assert_same_picture(output, render(scene, camera, background))


def test_frame_renderer_rejects_result_of_reused_memory(scene, camera):
    renderer = FrameRenderer(scene, camera)
    first = renderer.render()
    renderer.render()
    with pytest.raises(InvalidInput, match="result"):
        first.result()


def test_frame_renderer_rejects_unsupported_inputs(scene, camera):
    with pytest.raises(InvalidInput, match="on cpu"):
        FrameRenderer(scene.to("cpu"), camera)
    with pytest.raises(InvalidInput, match="float64"):
        FrameRenderer(scene.to(dtype=torch.float64), camera)
    with pytest.raises(InvalidInput, match="64x64"):
        FrameRenderer(scene, camera).render(Camera.from_focal(50.0, 64, 64))


def test_frame_renderer_half_precision_close_to_float32(scene, camera):
    field = BasisField(scene.count, (0.0, 1.0), bumps=6).to("cuda")
    torch.nn.init.normal_(field.weights, std=0.1)
    exact = FrameRenderer(scene, camera, field).render(time_s=0.4).result()
    near = FrameRenderer(scene, camera, field, precision="fp16").render(time_s=0.4).result()
    error = (near.image - exact.image).square().mean()
    assert 0 < error < 10 ** -(50 / 10)
    assert (near.alpha - exact.alpha).abs().max() < 0.02
    with pytest.raises(InvalidInput, match="fp8"):
        FrameRenderer(scene, camera, precision="fp8")
