"""New Gaussians where a frame shows tissue that the model does not cover yet."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.coverage import UNCOVERED_ALPHA, are_worth_filling, uncovered_pixels
from gsplat_core.training.initialisation import gaussians_at_pixels, tissue_colours, tissue_depth
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy


def gaussians_for_uncovered_tissue(
    frame: Frame, observation: Observation, current: Gaussians, config: ReconstructorConfig, most: int
) -> Gaussians | None:
    """Gaussians for the tissue pixels of `frame` that `current` (the model at the frame's time) leaves uncovered.

    At most `most`, as dense as the first frame's. Their depth is measured where the frame has depth, else that of the nearest covered
    pixel. None when there is nothing worth adding.

    They are on the device of `current`, which also looks for uncovered pixels; a frame that has few costs the host one number.
    """
    camera = observation.camera
    with torch.no_grad():
        output = render(current, camera, depth=frame.depth is None)
        uncovered = uncovered_pixels(output.alpha, observation.mask)
    height, width = frame.image.shape[:2]
    if not are_worth_filling(uncovered):
        return None
    is_uncovered = HostCopy(uncovered).numpy()
    spacing = math.sqrt(height * width / config.gaussians)
    columns = np.arange(spacing / 2, width, spacing)
    rows = np.arange(spacing / 2, height, spacing)
    grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    wanted = grid[is_uncovered[grid[:, 1].astype(np.int64), grid[:, 0].astype(np.int64)]]
    if len(wanted) == 0:
        return None
    wanted = wanted[:: math.ceil(len(wanted) / most)]
    if frame.depth is None:
        covered = torch.where(output.alpha >= UNCOVERED_ALPHA, output.depth, 0)
        covered_mm = cv2.medianBlur(HostCopy(covered).numpy(), 5)
        depth = tissue_depth(frame.with_fields(depth=covered_mm), config.default_depth_mm)
    else:
        depth = tissue_depth(frame, config.default_depth_mm)
    added = gaussians_at_pixels(wanted, spacing, tissue_colours(frame), depth, camera, sh_degree=config.sh_degree)
    return added.to(current.device)
