"""Archive of Gaussians that have been out of view, to free capacity in a scene of fixed size. They
are restored when the camera returns.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.coverage import uncovered_pixels
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.unseen import Archive, LastSeen, pixels_of
from gsplat_core.transfers import HostCopy

SEE_EVERY = 8
"""Number of frames between two visibility tests; with little free capacity every frame is tested.
"""
ROOM_SHARE = 0.1
"""Share of the capacity kept free for new tissue, if there are Gaussians to archive."""
UNSEEN_S = 0.5
"""Seconds out of view after which a Gaussian may be archived."""
MARGIN_SHARE = 0.1
"""Distance from the picture, as a share of its width, within which Gaussians stay because their
extent may reach into it.
"""
ARCHIVED_SCENES = 8
"""Capacity of the archive, in multiples of the scene's."""
REACH_PX = 5
"""Distance from an uncovered pixel, in pixels, within which archived Gaussians are restored."""


class OutOfView:
    """Visibility times and archive of one scene."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._capacity = capacity
        self.last_seen = LastSeen(capacity, device)
        self.archive = Archive(ARCHIVED_SCENES * capacity)
        self._looks = 0
        self._looked_from: Camera | None = None
        """Camera of the last search in the archive."""
        self._unseen_s: torch.Tensor | None = None
        """Cached result of `unseen_s` since the last test."""

    def restart(self) -> None:
        """Reset for another scene."""
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
                    alpha = render(step.at(observation.time_s), observation.camera, depth=False).alpha
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
