"""Pictures of a static cloud with their cameras, for tests of training."""

import cv2
import numpy as np
import torch

from gsplat_core import Camera, Gaussians, render
from gsplat_core.training.static import Points, TrainingPicture


def posed_pictures(factor=1.0, shift=0.0, count=5):
    """Pictures of a cloud around the origin, and its centres as points, in a world of another unit and origin."""
    generator = torch.Generator().manual_seed(0)
    n = 60
    cloud = Gaussians(
        torch.randn(n, 3, generator=generator) * 0.5,
        torch.randn(n, 4, generator=generator),
        torch.full((n, 3), -2.0),
        torch.full((n,), 2.0),
        torch.randn(n, 1, 3, generator=generator),
    )
    pictures = []
    for k in range(count):
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(np.array([0.2 * k, 0.5 * k - 1, 0.1]))
        pose[:3, 3] = 0.1, 0.05 * k, 3
        camera = Camera.from_focal(30, 32, 24, pose)
        with torch.inference_mode():
            image = (render(cloud, camera).image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        pose = pose.copy()
        pose[:3, 3] = factor * pose[:3, 3] - pose[:3, :3] @ np.broadcast_to(shift, 3)
        pictures.append(TrainingPicture(f"{k}.png", camera.with_pose(pose), image))
    positions = cloud.means.double().numpy() * factor + shift
    return pictures, Points(positions, np.full((n, 3), 128, np.uint8))
