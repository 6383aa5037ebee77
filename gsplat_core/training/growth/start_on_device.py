"""Creation of a scene's first Gaussians on the device. The result equals that of `initialisation` and takes a few
milliseconds on a GPU.

cuBLAS and cuDNN are avoided: each takes tens of milliseconds for its first use in a thread, which
would delay a stream's first picture.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.growth.initialisation import (
    FIRST_OPACITY,
    SIGMA_IN_SPACINGS,
    THICKNESS,
    TOOL_MARGIN_PX,
    blur_sigma_px,
    facing,
    filled,
    jittered_grid,
    tissue_depth,
    unprojected,
)
from gsplat_core.training.motion.image_motion import beside
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import tensor_of


class StartOnDevice:
    """Jittered grid for one size and camera, prepared before the first frame."""

    def __init__(self, camera: Camera, count: int, device: torch.device, seed: int = 0) -> None:
        """Prepare the grid as `gaussians_from_frame` does. Only the camera's pose may differ later."""
        self.camera, self._device = camera, device
        pixels, self._spacing_px = jittered_grid(camera.width_px, camera.height_px, count, seed)
        columns = np.clip(pixels[:, 0].astype(np.int64), 0, camera.width_px - 1)
        rows = np.clip(pixels[:, 1].astype(np.int64), 0, camera.height_px - 1)
        self._cells = torch.from_numpy(rows * camera.width_px + columns).to(device)
        # In every camera model the point of a pixel is linear in depth. Two depths therefore determine
        # the point at any depth.
        at_zero, at_one = (unprojected(pixels, np.full(len(pixels), z), camera) for z in (0.0, 1.0))
        self._points = self._float32(at_zero[0]), self._float32(at_one[0] - at_zero[0])
        self._pixel_mm = self._float32(at_zero[1]), self._float32(at_one[1] - at_zero[1])

    def fits(self, camera: Camera) -> bool:
        """Return True if the grid fits a camera, ignoring its pose."""
        mine = self.camera
        same_size = (mine.width_px, mine.height_px, mine.model) == (camera.width_px, camera.height_px, camera.model)
        return same_size and bool((mine.K == camera.K).all())

    def __call__(self, frame: Frame, observation: Observation, *, sh_degree: int, default_depth_mm: float) -> Gaussians:
        """Create the Gaussians of `frame`, which is `observation` on the device, without synchronisation."""
        image, camera = observation.image, observation.camera
        z = image.new_full((len(self._cells),), default_depth_mm, dtype=torch.float32)
        if frame.depth is not None:
            z = tensor_of(tissue_depth(frame, default_depth_mm), self._device).flatten()[self._cells]
        colours = _blurred(_without_tools(frame, image), blur_sigma_px(self._spacing_px))
        colour = colours.flatten(1)[:, self._cells].T
        camera_to_world = np.linalg.inv(camera.world_to_camera)
        pose = beside(z, camera_to_world[:3].ravel()).view(3, 4)
        local = self._points[0] + self._points[1] * z[:, None]
        sigma = SIGMA_IN_SPACINGS * self._spacing_px * (self._pixel_mm[0] + self._pixel_mm[1] * z)
        count = len(z)
        sh = z.new_zeros(count, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = (colour - 0.5) / SH_C0
        flattened = beside(z, np.log([1, 1, THICKNESS]))
        return Gaussians(
            means=(local[:, None, :] * pose[:, :3]).sum(dim=2) + pose[:, 3],
            quats=beside(z, facing(np.asarray(camera_to_world[:3, :3], np.float64))).repeat(count, 1),
            log_scales=sigma.log()[:, None] + flattened,
            logit_opacities=torch.full_like(z, math.log(FIRST_OPACITY / (1 - FIRST_OPACITY))),
            sh=sh,
        )

    def _float32(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(self._device)


def _without_tools(frame: Frame, image: Tensor) -> Tensor:
    """Return the picture as float [3, H, W] in 0..1 with tools filled from the surrounding tissue."""
    picture = image.permute(2, 0, 1).float() / 255
    if frame.mask is None or frame.mask.all() or not frame.mask.any():
        return picture
    tissue = tensor_of(frame.mask, image.device)
    bare = (tissue == 0).float()[None, None]
    margin = 2 * TOOL_MARGIN_PX + 1
    tool = max_pool2d(bare, margin, stride=1, padding=TOOL_MARGIN_PX)
    tool = torch.where(tool.min() > 0, bare, tool)[0]  # without the margin if no tissue would be left
    return torch.where(tool > 0, filled(picture, 1 - tool), picture)


def _blurred(picture: Tensor, sigma_px: float) -> Tensor:
    """Blur `picture` [C, H, W] with a Gaussian and reflected borders."""
    reach = max(1, math.ceil(3 * sigma_px))
    height, width = picture.shape[1:]
    if min(height, width) <= reach:
        return picture
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    weights = (taps / taps.sum()).tolist()
    wide = pad(picture[None], (reach, reach, reach, reach), mode="reflect")[0]
    across = sum((weight * wide[:, :, k : k + width] for k, weight in enumerate(weights)), start=torch.zeros(()))
    return sum((weight * across[:, k : k + height] for k, weight in enumerate(weights)), start=torch.zeros(()))
