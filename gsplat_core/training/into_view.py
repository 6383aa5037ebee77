"""Handling of tissue that a moving camera brings into view. It is filled before training, which
would otherwise stretch neighbouring Gaussians over it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.growth import gaussians_beside, grid_of, grid_spacing
from gsplat_core.training.initialisation import unprojected
from gsplat_core.training.neighbourhood import around_cells
from gsplat_core.training.observations import Observation
from gsplat_core.training.out_of_view import OutOfView
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.unseen import pixels_of, value_at
from gsplat_core.transfers import HostCopy, tensor_of

USUAL_DENSITY = 0.3
"""Share of the usual Gaussian density below which a cell counts as empty."""

LOOKS_AFTER = 0.02
"""Motion of the picture, as a share of its width, after which new tissue is searched again; each
search takes some milliseconds.
"""
EDGE_CELLS = 1.0
"""Margin in cells at the previous picture's edge that counts as new, so that slow motion leaves no
gap.
"""


def has_moved(camera: Camera, before: Camera, distance: float) -> bool:
    """Return True if content at a distance has moved far enough since `before` for another search."""
    sides = np.array([0.0, 0.5, 1.0])
    pixels = np.stack(np.meshgrid(sides * camera.width_px, sides * camera.height_px), -1).reshape(-1, 2)
    earlier = pixels_of(_points_of(pixels, camera, distance), before)[0].numpy()
    return bool(np.abs(earlier - pixels).max() >= LOOKS_AFTER * camera.width_px)


def _points_of(pixels: NDArray[np.float64], camera: Camera, distance: float) -> Tensor:
    """Return world points [M, 3] at `pixels` [M, 2] and a distance from a camera."""
    points, _ = unprojected(pixels, np.full(len(pixels), distance), camera)
    to_world = np.linalg.inv(camera.world_to_camera)
    return torch.from_numpy((points @ to_world[:3, :3].T + to_world[:3, 3]).astype(np.float32))


def entered(
    pixels: NDArray[np.float64], camera: Camera, before: Camera, distance: float, edge_px: float = 0.0
) -> NDArray[np.bool_]:
    """Find pixels whose content was not visible to an earlier camera.

    Args:
        pixels: positions [M, 2].
        camera: present camera.
        before: earlier camera.
        distance: assumed distance of the content.
        edge_px: margin at the edge of the earlier picture that counts as not visible.

    Returns:
        bool [M].
    """
    return ~pixels_of(_points_of(pixels, camera, distance), before, -edge_px)[1].numpy()


class NewTissue:
    """Grid cells of the picture that came into view with the newest frame."""

    def __init__(self, observation: Observation, before: Camera, spacing: float, distance: float) -> None:
        self._camera, self._spacing = observation.camera, spacing
        self._grid, self._shape = grid_of(self._camera.height_px, self._camera.width_px, spacing)
        self._entered = entered(self._grid, self._camera, before, distance, EDGE_CELLS * spacing)

    def __bool__(self) -> bool:
        return bool(self._entered.any())

    def _empty(self, now: Gaussians) -> tuple[Tensor, Tensor]:
        """Return which new cells are almost empty of Gaussians, bool [rows, columns], and the mean
        depth around each.
        """
        count, depth = around_cells(now, self._camera, self._spacing, self._shape)
        return tensor_of(self._entered.reshape(self._shape), now.device) & (count < 9 * USUAL_DENSITY), depth

    def pixels(self, now: Gaussians) -> Tensor:
        """Mark pixels of new cells without Gaussians, bool [H, W]. Does not synchronise."""
        return self._of_cells(self._empty(now)[0])

    def unfilled(self, now: Gaussians, mask: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the centres [M, 2] of empty new cells on tissue, and the scene's depth [H, W], 0
        where unknown.

        Depth is the mean over Gaussians. A rendered depth is biased to the front, so tissue placed
        by it would come nearer and nearer as the camera moves. Synchronises with the device.
        """
        empty, depth = self._empty(now)
        wanted = HostCopy(empty.flatten() & (value_at(mask, tensor_of(self._grid, mask.device)) > 0))
        depth_mm = HostCopy(self._of_cells(depth))
        return self._grid[wanted.numpy()], depth_mm.numpy()

    def _of_cells(self, values: Tensor) -> Tensor:
        """Expand cell values [rows, columns] to pixels [H, W]."""
        size = self._camera.height_px, self._camera.width_px
        row, column = (
            (torch.arange(pixels, device=values.device) / self._spacing).long().clamp(max=cells - 1)
            for pixels, cells in zip(size, self._shape, strict=True)
        )
        return values[row][:, column]


def fill_new_tissue(
    step: TrainingStep,
    frame: Frame,
    observation: Observation,
    before: Camera,
    config: ReconstructorConfig,
    out_of_view: OutOfView | None,
) -> None:
    """Fill tissue that came into view before the first step on a frame, from the archive or with
    new Gaussians.

    Otherwise training would stretch neighbouring Gaussians over it, which would follow the
    picture's edge as the camera moves.

    Args:
        step: training step of the scene.
        frame: newest frame.
        observation: the same frame as tensors.
        before: camera at the last search for new tissue.
        config: settings.
        out_of_view: archive of the scene, or None.
    """
    camera = observation.camera
    spacing = grid_spacing(camera.width_px * camera.height_px, config.gaussians)
    new = NewTissue(observation, before, spacing, step.distance(camera))
    if not new:
        return
    if out_of_view is not None and out_of_view.has_in_view(camera):
        out_of_view.bring_back(step, observation, new.pixels(step.at(observation.time_s)))
    now = step.at(observation.time_s)
    wanted, depth_mm = new.unfilled(now, observation.mask)
    if out_of_view is not None and len(wanted):
        out_of_view.last_seen.see(now, observation)
        out_of_view.make_room(step, observation, len(wanted), unseen_s=0.0)
    most = config.max_gaussians - step.gaussians.count
    known_mm = depth_mm if frame.depth is None else frame.depth
    added = gaussians_beside(wanted, frame, known_mm, observation, config, most)
    if added is not None:
        step.append(added)
