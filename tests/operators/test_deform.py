"""Deforming takes the frame's time and the frame's camera."""

from __future__ import annotations

import numpy as np
import torch

from gsplat_core.deformation import BasisField
from gsplat_core.models import Model
from operators.messages import Reconstruction
from operators.rasterize import DeformOp


def test_deform_evaluates_gaussians_at_frame_time(frame, model, camera, compute):
    still = model()
    field = BasisField(still.gaussians.count, (0.0, 1.0), bumps=4)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
            parameter.requires_grad_(False)
    moving = Model(3, still.gaussians, field, camera, (0.0, 1.0))
    (scene,) = compute(DeformOp(None), reconstruction=Reconstruction(frame(5), moving, trained=True))
    assert scene.model.version == 3 and scene.trained
    torch.testing.assert_close(scene.gaussians.means, moving.at(0.2).means)
    assert not torch.allclose(scene.gaussians.means, still.gaussians.means)
    assert scene.camera == camera


def test_deform_uses_pose_of_frame_for_camera(frame, model, compute):
    pose = np.eye(4)
    pose[2, 3] = 4.0
    (scene,) = compute(DeformOp(None), reconstruction=Reconstruction(frame(0, pose=pose), model(), trained=False))
    np.testing.assert_array_equal(scene.camera.world_to_camera, pose)
    assert not scene.trained
