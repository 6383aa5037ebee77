"""The Gaussians that a scene starts with, made on the device: those of the host, but for what lies under a tool, which is a guess."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import SH_C0
from gsplat_core.training.initialisation import StartOnDevice, filled, gaussians_from_frame
from gsplat_core.training.observations import Observation

TURNED = np.array([[0.0, 0, 1, 5], [0, 1, 0, -3], [-1, 0, 0, 80], [0, 0, 0, 1]])
CPU = torch.device("cpu")


def both(frame, camera, count=200, sh_degree=0):
    """Made on the host, and by a start that was laid out before, for another pose."""
    laid_out = StartOnDevice(replace(camera, world_to_camera=np.eye(4)), count, CPU)
    observation = Observation.of(frame, camera)
    host = gaussians_from_frame(frame, camera, count, sh_degree=sh_degree, default_depth_mm=60.0)
    return host, laid_out(frame, observation, sh_degree=sh_degree, default_depth_mm=60.0)


@pytest.mark.parametrize(("model", "focal"), [("pinhole", 50.0), ("fisheye", 40.0), ("ortho", 0.8)])
@pytest.mark.parametrize("pose", [np.eye(4), TURNED])
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("sh_degree", [0, 2])
def test_start_on_device_equals_host_initialisation(make_frame, model, focal, pose, with_depth, sh_degree):
    frame = make_frame()
    if with_depth:
        depth = np.linspace(40, 80, frame.image[..., 0].size, dtype=np.float32).reshape(frame.image.shape[:2])
        depth[:5] = 0
        frame = frame.with_fields(depth=depth)
    camera = Camera(np.array([[focal, 0, 24], [0, focal, 20], [0, 0, 1]]), 48, 40, pose, model=model)
    host, device = both(frame, camera, sh_degree=sh_degree)
    for name, tensor in host.tensors().items():
        # Colours differ by the rounding of the host's blurred bytes.
        tolerance = {"rtol": 0, "atol": 0.02} if name == "sh" else {"rtol": 1e-4, "atol": 1e-4}
        torch.testing.assert_close(device.tensors()[name], tensor, **tolerance)


def test_start_on_device_fills_tool_with_surrounding_colours(make_frame):
    frame = make_frame()
    image = np.full_like(frame.image, 90)
    image[10:30, 10:30] = 250
    mask = np.ones(image.shape[:2], np.uint8)
    mask[10:30, 10:30] = 0
    camera = Camera.from_focal(50.0, 48, 40)
    _, device = both(frame.with_fields(image=image, mask=mask), camera)
    torch.testing.assert_close(0.5 + SH_C0 * device.sh, torch.full_like(device.sh, 90 / 255))


@pytest.mark.parametrize("value", [0, 1])
def test_start_on_device_ignores_uniform_mask(make_frame, value):
    frame = make_frame()
    mask = np.full(frame.image.shape[:2], value, np.uint8)
    camera = Camera.from_focal(50.0, 48, 40)
    _, masked = both(frame.with_fields(mask=mask), camera)
    _, plain = both(frame.with_fields(mask=None), camera)
    assert torch.equal(masked.sh, plain.sh)


@pytest.mark.parametrize(("width", "height", "count"), [(1, 1, 4), (3, 2, 1), (5, 40, 7), (48, 1, 50)])
def test_start_on_device_accepts_any_picture_size(width, height, count):
    frame = Frame(0, 0, np.full((height, width, 3), 120, np.uint8), mask=np.eye(height, width, dtype=np.uint8))
    _, device = both(frame, Camera.from_focal(20.0, width, height), count)
    assert all(tensor.isfinite().all() for tensor in device.tensors().values())


def test_start_on_device_fits_own_camera_in_any_pose():
    camera = Camera.from_focal(50.0, 48, 40)
    start = StartOnDevice(camera, 100, CPU)
    assert start.fits(replace(camera, world_to_camera=TURNED))
    assert not start.fits(Camera.from_focal(51.0, 48, 40))
    assert not start.fits(Camera.from_focal(50.0, 40, 48))
    assert not start.fits(replace(camera, model="fisheye"))


def test_filled_keeps_constant_picture_and_value_range():
    generator = torch.Generator().manual_seed(0)
    known = (torch.rand(1, 37, 53, generator=generator) < 0.1).float()
    constant = filled(torch.full((3, 37, 53), 0.4), known)
    torch.testing.assert_close(constant, torch.full_like(constant, 0.4))
    picture = torch.rand(3, 37, 53, generator=generator)
    whole = filled(picture, known)
    assert float(whole.min()) >= float(picture.min())
    assert float(whole.max()) <= float(picture.max())


def test_initial_scene_is_transparent_far_outside_loss_mask(make_frame):
    frame = make_frame()
    inside = np.zeros(frame.image.shape[:2], np.uint8)
    inside[8:32, 12:36] = 1
    camera = Camera.from_focal(50.0, 48, 40)
    for excluding in (inside, 1 - inside):
        for gaussians in both(frame.with_fields(loss_mask=excluding), camera, count=480):
            alpha = render(gaussians, camera).alpha
            assert float(alpha[excluding > 0].min()) > 0.7
            assert float(alpha[cv2.dilate(excluding, np.ones((17, 17), np.uint8)) == 0].max()) < 0.05
    for said_nothing in (np.zeros_like(inside), np.ones_like(inside), None):
        host, device = both(frame.with_fields(loss_mask=said_nothing), camera)
        assert torch.equal(host.logit_opacities, both(frame, camera)[0].logit_opacities)
        torch.testing.assert_close(device.logit_opacities, host.logit_opacities)
