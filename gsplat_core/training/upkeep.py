"""What keeps a scene sound that is trained without an end.

Adam moves every parameter by about its learning rate, however little a picture says about it. What no picture shows therefore wanders: thin
Gaussians become needles, opacities and colours drift apart, rotations become long, and Gaussians that wandered to where no tissue is seen, below
a tool or out of the picture, find no way back. The tissue grows holes, these are filled by new Gaussians, and when there is no room for more
quality falls.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.densification import halves
from gsplat_core.training.growth import grid_spacing
from gsplat_core.training.initialisation import SIGMA_IN_SPACINGS
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.unseen import LastSeen, pixels_of, value_at

RELAX_EVERY = 128
"""Training steps between two rounds of relaxing."""
RENEW_EVERY = 512
"""Training steps between two looks for Gaussians that are of no use, and for tissue that has too few: on a GPU that takes some milliseconds."""
RELAXING_STEPS = 3600
"""Steps within which sizes, opacities and colours fall back to usual ones by 1 - 1/e where training does not hold them."""
THINNEST_PX = 0.2
"""What is thinner looks the same: a picture's blur is 0.55 px (standard deviation)."""
WIDEST = 8.0
"""In usual sizes."""
MOST_SPLIT = 0.02
"""Share of the Gaussians that are split in one round."""
IDLE = 1e-3
"""A Gaussian is idle where the mean of its squared gradients has fallen to this part of the scene's: no picture has shown it for 7,000 steps."""


class Upkeep:
    """Of one scene, which `camera` sees first."""

    def __init__(self, camera: Camera, config: ReconstructorConfig) -> None:
        self._first_camera, self._capacity = camera, config.max_gaussians
        self._spacing_px = grid_spacing(camera.width_px * camera.height_px, config.gaussians)
        self._relaxed_at = self._renewed_at = 0
        self._has_moved = False

    def __call__(self, step: TrainingStep, observation: Observation, last_seen: LastSeen | None = None) -> None:
        """Look after the scene where it is time. Waits for the device then. `last_seen` follows the rows."""
        self._has_moved = self._has_moved or observation.camera != self._first_camera
        since = step.steps - self._relaxed_at
        if since < RELAX_EVERY:
            return
        self._relaxed_at = step.steps
        with torch.no_grad():
            pixels, inside = pixels_of(step.at(observation.time_s).means, observation.camera)
            shown = inside & (value_at(observation.mask, pixels) > 0)
            self._relax(step, shown, 1 - math.exp(-since / RELAXING_STEPS), observation.camera)
            if step.steps - self._renewed_at >= RENEW_EVERY:
                self._renewed_at = step.steps
                self._renew(step, observation, (pixels, inside, shown), last_seen)

    def _renew(
        self,
        step: TrainingStep,
        observation: Observation,
        where: tuple[Tensor, Tensor, Tensor],
        last_seen: LastSeen | None,
    ) -> None:
        """Let go what is of no use, and split what has too much to do. `where`: pixels, and which Gaussians are in the picture and on tissue."""
        pixels, inside, shown = where
        step.shorten_rotations()
        if last_seen is not None:
            last_seen.join(step.gaussians.count, observation.time_s)
        leaving = self._useless(step, pixels, inside)
        shown &= ~leaving
        if bool(leaving.any()):
            moves = step.remove(leaving)
            shown = shown[moves.order]
            if last_seen is not None:
                last_seen.close_gaps(moves)
        self._fill_up(step, observation, shown)
        if last_seen is not None:
            last_seen.join(step.gaussians.count, observation.time_s)

    def _relax(self, step: TrainingStep, shown: Tensor, share: float, camera: Camera) -> None:
        """Towards the state of a Gaussian of which nothing is known, for those that are `shown`, bool [N]. The others are what is remembered."""
        scene, pixel = step.gaussians, step.distance(camera) / float(camera.K[0, 0])
        usual = SIGMA_IN_SPACINGS * self._spacing_px * pixel
        part = share * shown.to(scene.means.dtype)
        scene.log_scales.add_(part[:, None] * (math.log(usual) - scene.log_scales))
        scene.log_scales.clamp_(math.log(THINNEST_PX * pixel), math.log(WIDEST * usual))
        scene.logit_opacities.sub_(part * scene.logit_opacities)
        scene.sh.sub_(part[:, None, None] * scene.sh)

    def _useless(self, step: TrainingStep, pixels: Tensor, inside: Tensor) -> Tensor:
        """Marks, bool [N], of idle Gaussians that can go: where the camera never moved, those outside of the picture; inside, all but one of
        those in the same cell of the grid, for a tool that hides them may leave."""
        idle = step.idle(IDLE)
        crowded = idle & inside & _repeated(torch.floor(pixels / self._spacing_px), idle & inside)
        return crowded if self._has_moved else crowded | (idle & ~inside)

    def _fill_up(self, step: TrainingStep, observation: Observation, shown: Tensor) -> None:
        """Split Gaussians where tissue has fewer than it began with: those of the `shown`, bool [N], whose gradients are largest."""
        wanted = torch.count_nonzero(observation.mask) / self._spacing_px**2
        missing = int(wanted - torch.count_nonzero(shown))
        count = min(missing, round(MOST_SPLIT * step.gaussians.count), self._capacity - step.gaussians.count)
        if count > 0:
            step.split(step.busiest(count, shown), halves)


def _repeated(cells: Tensor, counted: Tensor) -> Tensor:
    """Marks, bool [N], of those `counted` whose cell [N, 2], whole numbers, an earlier one of them has."""
    count = len(cells)
    number = cells[:, 1].double() * 2**20 + cells[:, 0].double()
    # Each of the others has a cell of its own.
    number = torch.where(counted, number, -1.0 - torch.arange(count, device=cells.device))
    ordered, order = number.sort(stable=True)
    marks = torch.zeros(count, dtype=torch.bool, device=cells.device)
    marks[order[1:]] = ordered[1:] == ordered[:-1]
    return marks & counted
