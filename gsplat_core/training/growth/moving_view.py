"""Tissue that enters and leaves the view of a moving camera.

Gaussians that have been out of view are archived, to free capacity in a scene of fixed size. Tissue that comes into view
is filled before training.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.growth.covering import gaussians_beside, grid_of, grid_spacing, uncovered_pixels
from gsplat_core.training.growth.initialisation import unprojected
from gsplat_core.training.growth.unseen import Archive, LastSeen, around_cells, pixels_of, value_at
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import HostCopy, tensor_of

SEE_EVERY = 8
"""Number of frames between two visibility tests. With little free capacity, every frame is tested."""
ROOM_SHARE = 0.1
"""Share of the capacity kept free for new tissue, as long as there are Gaussians to archive."""
UNSEEN_S = 0.5
"""Seconds out of view after which a Gaussian may be archived."""
MARGIN_SHARE = 0.1
"""Distance from the picture, as a share of its width, within which Gaussians stay because their
extent may reach into it.
"""
ARCHIVED_SCENES = 8
"""Capacity of the archive, in multiples of the scene's capacity."""
REACH_PX = 5
"""Distance from an uncovered pixel, in pixels, within which archived Gaussians are restored."""


class OutOfView:
    """Visibility times of a scene's Gaussians, and the archive of those that left the camera's view."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._capacity = capacity
        self.last_seen = LastSeen(capacity, device)
        self.archive = Archive(ARCHIVED_SCENES * capacity)
        self._looks = 0
        self._looked_from: Camera | None = None
        """Camera for which the archive was last searched."""
        self._unseen_s: torch.Tensor | None = None
        """Cached result of `unseen_s` since the last test."""

    def restart(self) -> None:
        """Empty the archive and forget when Gaussians were visible, for a new scene."""
        self.last_seen.restart()
        self._unseen_s = None
        self.archive = Archive(ARCHIVED_SCENES * self._capacity)
        self._looks = 0

    def unseen_s(self, count: int) -> torch.Tensor:
        """Return for each of the `count` Gaussians how long it was out of view at the last test, in
        seconds (`Model.unseen_s`). The returned tensor is never modified.
        """
        if self._unseen_s is None or len(self._unseen_s) != count:
            self._unseen_s = self.last_seen.unseen_s(count)
        return self._unseen_s

    def follow(self, step: TrainingStep, observation: Observation) -> None:
        """Process the newest observation before the scene grows: test visibility, archive Gaussians
        if capacity is short, and restore those that come into view.
        """
        self._unseen_s = None
        kept_free = round(ROOM_SHARE * self._capacity)
        if self._looks % SEE_EVERY == 0 or self._capacity - step.gaussians.count < kept_free // 2:
            self.last_seen.see(step.at(observation.time_s), observation)
            self.make_room(step, observation, kept_free, UNSEEN_S)
        self._looks += 1
        if len(self.archive) and observation.camera != self._looked_from:
            self._looked_from = observation.camera
            if self.has_in_view(observation.camera):
                with torch.no_grad():
                    alpha = step.picture(step.at(observation.time_s), observation.camera, depth=False).alpha
                self.bring_back(step, observation, uncovered_pixels(alpha, torch.ones_like(observation.mask)))

    def has_in_view(self, camera: Camera) -> bool:
        """Return True if any archived Gaussian projects into a camera's picture."""
        return bool(self.archive.in_view(camera).any())

    def make_room(self, step: TrainingStep, observation: Observation, wanted: int, unseen_s: float) -> None:
        """Archive Gaussians until enough rows are free, as far as possible.

        Only Gaussians outside the picture are archived. Those hidden by a tool stay, since they
        can be uncovered at any moment.

        Args:
            step: training step of the scene.
            observation: newest observation.
            wanted: number of rows to free.
            unseen_s: seconds for which a Gaussian must have been out of view.
        """
        short = wanted - (self._capacity - step.gaussians.count)
        if short <= 0:
            return
        now = step.at(observation.time_s)
        margin_px = MARGIN_SHARE * observation.camera.width_px
        outside = ~pixels_of(now.means, observation.camera, margin_px)[1]
        leaving = self.last_seen.longest_unseen(short, observation.time_s - unseen_s, outside)
        if bool(leaving.any()):
            self.archive.put(now.select(leaving))
            self.last_seen.close_gaps(step.remove(leaving))

    def bring_back(self, step: TrainingStep, observation: Observation, wanted: Tensor) -> None:
        """Restore archived Gaussians whose centre is near a marked pixel of `wanted`, bool [H, W].
        Synchronises with the device.
        """
        marks = HostCopy(wanted).numpy().astype(np.uint8)
        if not marks.any():
            return
        near = torch.from_numpy(cv2.dilate(marks, np.ones((2 * REACH_PX + 1,) * 2, np.uint8)) > 0)
        back = self.archive.take_uncovered(observation.camera, near, self._capacity)
        if back is None:
            return
        self.last_seen.see(step.at(observation.time_s), observation)
        self.make_room(step, observation, back.count, unseen_s=0.0)
        room = self._capacity - step.gaussians.count
        if back.count > room:
            self.archive.put(back.select(slice(room, None)))
        step.append(back.select(slice(0, room)).to(wanted.device))
        self.last_seen.join(step.gaussians.count, observation.time_s)


USUAL_DENSITY = 0.3
"""Ratio to the usual Gaussian density below which a cell counts as empty."""
LOOKS_AFTER = 0.02
"""Motion of the picture, as a share of its width, after which the picture is searched again for new tissue; each search
takes some milliseconds.
"""
EDGE_CELLS = 1.0
"""Margin in cells at the previous picture's edge that counts as new, so that slow motion leaves no gap."""


def has_moved(camera: Camera, before: Camera, distance: float) -> bool:
    """Return True if content at a distance has moved far enough since `before` for another search."""
    sides = np.array([0.0, 0.5, 1.0])
    pixels = np.stack(np.meshgrid(sides * camera.width_px, sides * camera.height_px), -1).reshape(-1, 2)
    if camera.model == before.model == "pinhole":
        x, y, z = _by_homography(pixels, camera, before, distance)
        earlier = np.stack([x, y], axis=1) / np.where(z > 0, z, np.inf)[:, None]
    else:
        earlier = pixels_of(_points_of(pixels, camera, distance), before)[0].numpy()
    return bool(np.abs(earlier - pixels).max() >= LOOKS_AFTER * camera.width_px)


def _points_of(pixels: NDArray[np.float64], camera: Camera, distance: float) -> Tensor:
    """Return world points [M, 3] at `pixels` [M, 2] and a distance from a camera."""
    points, _ = unprojected(pixels, np.full(len(pixels), distance), camera)
    to_world = np.linalg.inv(camera.world_to_camera)
    return torch.from_numpy((points @ to_world[:3, :3].T + to_world[:3, 3]).astype(np.float32))


def _by_homography(
    pixels: NDArray[np.float64], camera: Camera, before: Camera, distance: float
) -> NDArray[np.floating]:
    """Return homogeneous coordinates [3, M] in an earlier camera of the content of `pixels` [M, 2] at a distance.

    Training of a frame waits for it. Moving the points of all cells takes ten times as long.
    """
    between = before.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    homography = distance * before.K @ between[:3, :3] @ np.linalg.inv(camera.K)
    moved: NDArray[np.floating] = homography[:, :2] @ pixels.T
    return moved + (homography[:, 2] + before.K @ between[:3, 3])[:, None]


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
    if camera.model == before.model == "pinhole":
        x, y, z = _by_homography(pixels, camera, before, distance)
        across = (x >= edge_px * z) & (x < (before.width_px - edge_px) * z)
        down = (y >= edge_px * z) & (y < (before.height_px - edge_px) * z)
        return ~(across & down & (z > 0))
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
        """Return the cells that came into view and have almost no Gaussians, bool [rows, columns], and the mean depth
        around each cell.
        """
        count, depth = around_cells(now, self._camera, self._spacing, self._shape)
        return tensor_of(self._entered.reshape(self._shape), now.device) & (count < 9 * USUAL_DENSITY), depth

    def pixels(self, now: Gaussians) -> Tensor:
        """Return the pixels of the grid cells that came into view and have almost no Gaussians, bool [H, W].

        Does not synchronise with the device.
        """
        return self._of_cells(self._empty(now)[0])

    def unfilled(self, now: Gaussians, mask: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the centres [M, 2] of empty new cells on tissue, and the scene's depth [H, W], 0 where unknown.

        Depth is the mean over Gaussians. A rendered depth is biased towards the camera. Tissue created at it would come
        nearer with every step of a moving camera. Synchronises with the device.
        """
        empty, depth = self._empty(now)
        wanted = HostCopy(empty.flatten() & (value_at(mask, tensor_of(self._grid, mask.device)) > 0))
        depth_mm = HostCopy(self._of_cells(depth))
        return self._grid[wanted.numpy()], depth_mm.numpy()

    def _of_cells(self, values: Tensor) -> Tensor:
        """Return the values of cells [rows, columns] at each pixel in them, [H, W]."""
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
    """Fill tissue that came into view before the first step on a frame, from the archive or with new Gaussians.

    Without this, training would stretch neighbouring Gaussians over the new tissue. They would then follow the
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
