"""What keeps a scene sound that is trained without an end.

Adam moves every parameter by about its learning rate, however little a picture says about it. What no picture shows therefore wanders: thin
Gaussians become needles, opacities and colours drift apart, rotations become long, depths spread along the line of sight of a camera that does not
move, and Gaussians that wandered to where no tissue is seen, below a tool or out of the picture, find no way back. The tissue grows holes, these are filled by new Gaussians, and when there is no room for more
quality falls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.densification import halves
from gsplat_core.training.growth import grid_spacing
from gsplat_core.training.initialisation import SIGMA_IN_SPACINGS
from gsplat_core.training.neighbourhood import around_cells
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.unseen import LastSeen, depth_of, pixels_of, value_at

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
SURFACE_STEPS = 100_000
"""Steps within which depths come back to those around them. Far more than above: order along a line of sight is something to be learned, too."""
SURFACE_CELL = 2.0
"""Width of the cells whose depths are averaged, in the usual spacing of Gaussians."""
SURFACE_REACH = 2
"""So many cells on each side count, too."""
IDLE = 1e-3
"""A Gaussian is idle where the mean of its squared gradients has fallen to this part of the scene's: no picture has shown it for 7,000 steps."""


@dataclass(frozen=True)
class Seen:
    """A scene as a frame sees it."""

    now: Gaussians
    """At the frame's time."""
    pixels: Tensor
    """Of the centres, [N, 2]."""
    inside: Tensor
    """bool [N]: in the picture."""
    shown: Tensor
    """bool [N]: in the picture, and on tissue."""


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
        if step.steps - self._relaxed_at < RELAX_EVERY:
            return
        with torch.no_grad():
            seen = self._look(step, observation)
            self._relax(step, seen, observation.camera)
            if step.steps - self._renewed_at >= RENEW_EVERY:
                self._renew(step, seen, observation, last_seen, self._useless(step, seen))

    def once(self, step: TrainingStep, observation: Observation, last_seen: LastSeen | None = None) -> None:
        """Everything, though it is not time, and as if the first Gaussian were of no use: what takes long the first time has been done then."""
        with torch.no_grad():
            seen = self._look(step, observation)
            self._relax(step, seen, observation.camera)
            self._useless(step, seen)
            first = torch.arange(step.gaussians.count, device=seen.shown.device) == 0
            self._renew(step, seen, observation, last_seen, first)
            count = step.gaussians.count
            if count < self._capacity:
                step.split(step.busiest(1, first.new_ones(count)), halves)
            if last_seen is not None:
                last_seen.join(step.gaussians.count, observation.time_s)

    def _look(self, step: TrainingStep, observation: Observation) -> Seen:
        now = step.at(observation.time_s)
        pixels, inside = pixels_of(now.means, observation.camera)
        return Seen(now, pixels, inside, inside & (value_at(observation.mask, pixels) > 0))

    def _renew(
        self, step: TrainingStep, seen: Seen, observation: Observation, last_seen: LastSeen | None, leaving: Tensor
    ) -> None:
        """Bring depths and rotations back where the field can follow, remove those `leaving`, bool [N], and split what has too much to do."""
        since, self._renewed_at = step.steps - self._renewed_at, step.steps
        if step.field.takes_positions:
            step.scale_about(observation.camera, self._towards_surface(step, seen, since, observation))
        step.shorten_rotations()
        if last_seen is not None:
            last_seen.join(step.gaussians.count, observation.time_s)
        shown = seen.shown & ~leaving
        if bool(leaving.any()):
            moves = step.remove(leaving)
            shown = shown[moves.order]
            if last_seen is not None:
                last_seen.close_gaps(moves)
        self._fill_up(step, observation, shown)
        if last_seen is not None:
            last_seen.join(step.gaussians.count, observation.time_s)

    def _relax(self, step: TrainingStep, seen: Seen, camera: Camera) -> None:
        """Towards the state of a Gaussian of which nothing is known, for those that are shown. The others are what is remembered."""
        share = 1 - math.exp((self._relaxed_at - step.steps) / RELAXING_STEPS)
        self._relaxed_at = step.steps
        scene, pixel = step.gaussians, step.distance(camera) / float(camera.K[0, 0])
        usual = SIGMA_IN_SPACINGS * self._spacing_px * pixel
        part = share * seen.shown.to(scene.means.dtype)
        scene.log_scales.add_(part[:, None] * (math.log(usual) - scene.log_scales))
        scene.log_scales.clamp_(math.log(THINNEST_PX * pixel), math.log(WIDEST * usual))
        scene.logit_opacities.sub_(part * scene.logit_opacities)
        for colours in (scene.sh, scene.right_sh):
            if colours is not None:
                colours.sub_(part[:, None, None] * colours)

    def _towards_surface(self, step: TrainingStep, seen: Seen, since: int, observation: Observation) -> Tensor:
        """Factors [N] of the distances from the camera that bring what is shown nearer to the depth of what lies around it, `since` so many steps.
        The camera sees the same picture; where it moves or depth is known, training holds against it.

        Where neither is so all depths together drift, too: steps along the line of sight that are equally long are not equally far in a picture.
        What is shown then keeps its typical distance."""
        camera = observation.camera
        spacing = SURFACE_CELL * self._spacing_px
        cells = math.ceil(camera.height_px / spacing), math.ceil(camera.width_px / spacing)
        _, around = around_cells(seen.now, camera, spacing, cells, SURFACE_REACH)
        depth = depth_of(seen.now.means, camera)
        share = 1 - math.exp(-since / SURFACE_STEPS)
        factor = 1 + share * (value_at(around, seen.pixels / spacing) / depth - 1)
        if observation.depth is None and not self._has_moved:
            factor = factor * (step.distance(camera) / depth.masked_fill(~seen.shown, torch.nan).nanmedian())
        return torch.where(seen.shown, factor, 1.0)

    def _useless(self, step: TrainingStep, seen: Seen) -> Tensor:
        """Marks, bool [N], of idle Gaussians that can go: where the camera never moved, those outside of the picture; inside, all but one of
        those in the same cell of the grid, for a tool that hides them may leave."""
        idle = step.idle(IDLE)
        inside = idle & seen.inside
        crowded = inside & _repeated(torch.floor(seen.pixels / self._spacing_px), inside)
        return crowded if self._has_moved else crowded | (idle & ~seen.inside)

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
