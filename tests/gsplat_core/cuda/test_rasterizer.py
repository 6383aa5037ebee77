"""`Rasterizer` on CUDA: pictures from its graph are those of `rasterization`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Rasterizer
from gsplat_core.rendering.alpha import TileListCapacity

CAMERA = Camera.from_focal(120.0, 150, 101)


def moved(x_mm):
    pose = np.linalg.inv(CAMERA.world_to_camera)
    pose[0, 3] += x_mm
    return CAMERA.with_pose(pose)


@pytest.mark.parametrize("mode", ["RGB", "ED", "RGB+ED"])
def test_captured_rasterizer_equals_uncaptured(make_gaussians, mode):
    scene = make_gaussians(800, sh_degree=2).to("cuda")
    graph, plain = Rasterizer(render_mode=mode), Rasterizer(render_mode=mode, capture=False)
    pictures = []
    for x_mm in (0.0, 2.0, -3.0):
        found, wanted = graph(scene, moved(x_mm)), plain(scene, moved(x_mm))
        assert found.meta is None and wanted.meta is not None
        seen = wanted.alphas[..., 0] > 0.05
        torch.testing.assert_close(found.colors[seen], wanted.colors[seen], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(found.alphas, wanted.alphas, rtol=1e-4, atol=1e-4)
        pictures.append(found.colors)
    assert not torch.equal(pictures[0], pictures[1])


def test_captured_rasterizer_handles_changed_count_and_size(make_gaussians):
    graph, plain = Rasterizer(), Rasterizer(capture=False)
    smaller = Camera.from_focal(60.0, 64, 48)
    for count, camera in ((300, CAMERA), (500, CAMERA), (500, smaller)):
        scene = make_gaussians(count, sh_degree=1).to("cuda")
        torch.testing.assert_close(graph(scene, camera).colors, plain(scene, camera).colors, rtol=1e-3, atol=1e-3)


def test_captured_rasterizer_grows_small_workspace(make_gaussians):
    scene = make_gaussians(800, sh_degree=2).to("cuda")
    graph = Rasterizer(capacity=TileListCapacity(32, per_tile=True))
    wanted = Rasterizer(capture=False)(scene, CAMERA)
    torch.testing.assert_close(graph(scene, CAMERA).colors, wanted.colors, rtol=1e-3, atol=1e-3)
    assert graph.capacity is not None and graph.capacity.capacity >= 32


def test_captured_rasterizer_supports_gradients(make_gaussians):
    scene = make_gaussians(100, sh_degree=1).to("cuda").requires_grad_()
    Rasterizer()(scene, CAMERA).colors.sum().backward()
    assert scene.means.grad is not None and scene.means.grad.abs().sum() > 0
