"""Creation of Gaussians where a frame shows tissue that the model does not cover."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.coverage import UNCOVERED_ALPHA, are_worth_filling, uncovered_pixels
from gsplat_core.training.initialisation import gaussians_at_pixels, tissue_colours, tissue_depth
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy


def grid_spacing(pixels: int, gaussians: int) -> float:
    """Return the grid spacing in pixels for an even spread of Gaussians over a picture."""
    return math.sqrt(pixels / gaussians)


def grid_of(height_px: int, width_px: int, spacing: float) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Return pixel coordinates [rows * columns, 2] of a grid over the picture, and (rows, columns)."""
    columns = np.arange(spacing / 2, width_px, spacing)
    rows = np.arange(spacing / 2, height_px, spacing)
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2), (len(rows), len(columns))


@dataclass(frozen=True)
class Uncovered:
    """Uncovered tissue of one frame, being copied to the host."""

    pixels: HostCopy
    """Uncovered pixels, bool [H, W]."""
    depth: HostCopy | None
    """Depth of the scene, float32 [H, W], 0 where uncovered; None if the frame's own depth is used.
    """

    def gaussians(
        self, frame: Frame, observation: Observation, config: ReconstructorConfig, most: int
    ) -> Gaussians | None:
        """Create Gaussians for the uncovered tissue on the observation's device, with the density
        of the first frame.

        Their depth is the frame's own or extrapolated from the covered pixels around. Waits for the
        copies.

        Args:
            frame: frame that provides colours and depth.
            observation: the same view as tensors.
            config: settings.
            most: largest number of Gaussians.

        Returns:
            The Gaussians, or None if there are none to create.
        """
        height, width = frame.image.shape[:2]
        grid, _ = grid_of(height, width, grid_spacing(height * width, config.gaussians))
        is_uncovered = self.pixels.numpy()
        wanted = grid[is_uncovered[grid[:, 1].astype(np.int64), grid[:, 0].astype(np.int64)]]
        depth_mm = frame.depth
        if self.depth is not None:
            depth_mm = np.asarray(cv2.medianBlur(self.depth.numpy(), 5))
        assert depth_mm is not None
        return gaussians_beside(wanted, frame, depth_mm, observation, config, most)


def uncovered_tissue(observation: Observation, current: Gaussians, *, has_depth: bool = False) -> Uncovered | None:
    """Find tissue of an observation that the scene does not cover.

    The search runs on the observation's device and transfers a single number if there is little.

    Args:
        observation: the view.
        current: the scene at the observation's time.
        has_depth: True if the frame has depth, so that the scene's depth is not needed.

    Returns:
        The uncovered tissue, or None if it is not worth filling.
    """
    with torch.no_grad():
        output = render(current, observation.camera, depth=not has_depth)
        uncovered = uncovered_pixels(output.alpha, observation.mask)
        if not are_worth_filling(uncovered):
            return None
        shown = None if has_depth else HostCopy(torch.where(output.alpha >= UNCOVERED_ALPHA, output.depth, 0))
        return Uncovered(HostCopy(uncovered), shown)


def gaussians_beside(
    wanted: NDArray[np.float64],
    frame: Frame,
    depth_mm: NDArray[np.floating],
    observation: Observation,
    config: ReconstructorConfig,
    most: int,
) -> Gaussians | None:
    """Create one Gaussian at each of the given pixels, or at an even subset of them.

    Args:
        wanted: pixel positions [M, 2].
        frame: frame that provides colours.
        depth_mm: depth [H, W], 0 = unknown. Unknown pixels get extrapolated depth.
        observation: the same view as tensors; determines camera and device.
        config: settings.
        most: largest number of Gaussians.

    Returns:
        The Gaussians, or None if there are none to create.
    """
    if len(wanted) == 0 or most <= 0:
        return None
    height, width = frame.image.shape[:2]
    depth = tissue_depth(frame.with_fields(depth=depth_mm), config.default_depth_mm)
    added = gaussians_at_pixels(
        wanted[:: math.ceil(len(wanted) / most)],
        grid_spacing(height * width, config.gaussians),
        tissue_colours(frame),
        depth,
        observation.camera,
        sh_degree=config.sh_degree,
    )
    return added.to(observation.image.device)
