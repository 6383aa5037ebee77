"""Scores are of the model's picture at the frame's time and pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.evaluation.protocols import PictureMaker
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.reconstructor import Reconstructor

WIDTH, HEIGHT = 24, 16
CAMERA = Camera.from_focal(30.0, WIDTH, HEIGHT)


def waves(seq=0, **fields):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    planes = np.stack([np.sin(x / 3 + seq), np.cos(y / 2), np.sin((x + y) / 4)], -1)
    return Frame(seq, seq * 40_000_000, np.rint(128 + 90 * planes).astype(np.uint8), **fields)


def model(version=3):
    gaussians = gaussians_from_frame(waves(), CAMERA, 120, sh_degree=0, default_depth_mm=50.0)
    return Model(version, gaussians, None, CAMERA, (0.0, 1.0))


def test_picture_maker_rounds_model_image_to_bytes():
    picture = PictureMaker(CAMERA)(model(), waves())
    wanted = model().render(0.0)
    np.testing.assert_allclose(picture.unrounded, wanted.image.clamp(0, 1).numpy(), atol=1e-6)
    assert np.abs(picture.image / 255 - picture.unrounded).max() <= 0.5 / 255 + 1e-6
    np.testing.assert_allclose(picture.depth, wanted.depth.numpy(), rtol=1e-5)
    assert picture.model_version == 3


def test_picture_maker_uses_pose_of_frame():
    make = PictureMaker(CAMERA)
    plain = make(model(), waves())
    pose = np.eye(4)
    pose[0, 3] = 4.0
    moved = make(model(), waves(pose=pose))
    assert np.abs(moved.unrounded - plain.unrounded).max() > 0.05


def test_picture_maker_keeps_earlier_images():
    make = PictureMaker(CAMERA)
    first = make(model(), waves())
    kept = first.image.copy(), first.unrounded.copy(), first.depth.copy()
    make(model(4), waves())
    for before, now in zip(kept, (first.image, first.unrounded, first.depth), strict=True):
        np.testing.assert_array_equal(before, now)


@pytest.mark.cuda
def test_picture_maker_on_gpu_equal_for_model_and_published_state(gpu):
    learning = Reconstructor(ReconstructorConfig(gaussians=64, max_gaussians=80), CAMERA, device=gpu)
    make = PictureMaker(CAMERA, gpu)
    for seq in range(4):
        learning.observe(waves(seq), steps=2)
        shown = make(learning.publish(), waves(seq))
        again = PictureMaker(CAMERA)(learning.snapshot().to("cpu"), waves(seq))
        assert np.abs(shown.image.astype(int) - again.image.astype(int)).max() <= 1
    assert torch.cuda.is_available()
