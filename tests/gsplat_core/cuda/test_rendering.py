"""`render` on CUDA: the frame path without gradients and the plain ops with gradients give the same picture."""

import pytest
import torch

from gsplat_core.rendering import rasterization as rendering
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera

CAMERA = Camera.from_focal(70.0, 90, 70)


def largest_difference(a, b):
    return max(float((x - y).detach().abs().max()) for x, y in zip(a[:2], b[:2], strict=True))


@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
@pytest.mark.parametrize("background", [None, (0.2, 0.4, 0.6)])
def test_render_with_and_without_gradient_gives_same_image(gpu, make_gaussians, model, background):
    gaussians = make_gaussians(500).to(gpu)
    camera = Camera(CAMERA.K, CAMERA.width_px, CAMERA.height_px, model=model)
    behind = None if background is None else torch.tensor(background, device=gpu)
    followed = render(gaussians.clone().requires_grad_(), camera, behind)
    assert followed.image.requires_grad
    free = render(gaussians, camera, behind)
    assert not free.image.requires_grad
    assert largest_difference(followed, free) < 5e-3
    opaque = free.alpha > 0.5
    torch.testing.assert_close(free.depth[opaque], followed.depth[opaque].detach(), rtol=1e-2, atol=1e-2)
    assert not render(gaussians, camera, behind, depth=False).depth.any()


def test_render_grows_short_tile_lists(gpu, make_gaussians, monkeypatch):
    gaussians = make_gaussians(500).to(gpu)
    expected = render(gaussians, CAMERA)
    monkeypatch.setattr(rendering, "SMALLEST_SCENE", 1)
    monkeypatch.setattr(rendering, "INSTANCES_PER_GAUSSIAN", 1)
    seen = render(gaussians, CAMERA)
    assert torch.equal(seen.image, expected.image) and torch.equal(seen.depth, expected.depth)


def test_render_of_empty_scene_is_background(gpu, make_gaussians):
    seen = render(make_gaussians(0).to(gpu), CAMERA, torch.tensor([0.1, 0.2, 0.3], device=gpu))
    torch.testing.assert_close(seen.image.cpu(), torch.tensor([0.1, 0.2, 0.3]).expand(70, 90, 3))
    assert not seen.alpha.any()
