"""A camera that was moved is brought back by what it sees."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.photometric_pose import refine_pose
from gsplat_core.poses.se3 import exp
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

TWISTS = [
    [0.3, 0.0, 0.0, 0.0, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
    [0.0, 0.0, 0.0, 0.01, -0.01, 0.03],
    [0.2, -0.2, 0.5, -0.005, 0.01, -0.02],
]


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    """A lumpy wall in many colours, 20 away."""
    random = torch.Generator().manual_seed(5)
    count = 900
    means = torch.rand(count, 3, generator=random) * torch.tensor([20.0, 16.0, 5.0]) + torch.tensor([-10.0, -8.0, 18.0])
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1)
    log_scales = torch.full((count, 3), -0.2)
    return Gaussians(means, quats, log_scales, torch.full((count,), 2.0), torch.randn(count, 1, 3, generator=random))


CAMERA = Camera.from_focal(110, 96, 80)


def picture(scene: Gaussians, camera: Camera = CAMERA) -> np.ndarray:
    return (render(scene, camera).image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def moved(twist: list[float]) -> Camera:
    return CAMERA.with_pose(exp(torch.tensor(twist, dtype=torch.float64)).numpy())


def seen(scene: Gaussians, camera: Camera) -> torch.Tensor:
    viewmat, K = camera.matrices(torch.device("cpu"), torch.float64)
    local = scene.means.cpu().double() @ viewmat[:3, :3].T + viewmat[:3, 3]
    return local[:, :2] / local[:, 2:] * K[0, 0] + K[:2, 2]


def off_px(scene: Gaussians, camera: Camera) -> float:
    """Return the median displacement of the Gaussians in pixels. In front of a wall, rotation and sideways motion look alike."""
    return float((seen(scene, camera) - seen(scene, CAMERA)).norm(dim=1).median())


@pytest.mark.parametrize("twist", TWISTS)
def test_the_pose_is_found_again(scene, twist):
    start = moved(twist)
    found = refine_pose(scene, start, picture(scene))
    assert off_px(scene, found.camera) < 0.1 and off_px(scene, start) > 0.8
    assert found.after < 0.1 * found.before
    rotation = found.camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_a_tool_that_is_masked_decides_nothing(scene):
    image, mask = picture(scene), np.ones((80, 96), np.uint8)
    image[20:60, :40] = [250, 250, 255]
    mask[20:60, :40] = 0
    assert off_px(scene, refine_pose(scene, moved(TWISTS[3]), image, mask).camera) < 0.1


def test_what_is_off_without_a_mask_decides_little(scene):
    image = picture(scene)
    image[30:50, :20] = [250, 250, 255]
    assert off_px(scene, refine_pose(scene, moved(TWISTS[3]), image).camera) < 0.2


def test_a_picture_of_something_else_is_never_made_worse(scene):
    found = refine_pose(scene, CAMERA, np.random.default_rng(0).integers(0, 255, (80, 96, 3)).astype(np.uint8))
    assert found.after <= found.before and found.after > 0.1


def test_what_cannot_be_compared_is_refused(scene):
    with pytest.raises(InvalidInput, match=r"image is \[40, 96, 3\], the camera sees \[80, 96\]"):
        refine_pose(scene, CAMERA, picture(scene)[:40])
    with pytest.raises(InvalidInput, match="only 0 pixels"):
        refine_pose(scene, CAMERA, picture(scene), np.zeros((80, 96), np.uint8))


def test_the_same_on_any_device(scene, device):
    found = refine_pose(scene.to(device), moved(TWISTS[3]), picture(scene))
    assert off_px(scene, found.camera) < 0.1
