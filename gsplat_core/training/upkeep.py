"""Maintenance of a scene that is trained without end.

Adam moves every parameter by about its learning rate even if pictures hardly constrain it. Unconstrained parameters
therefore drift. Thin Gaussians become needles, opacities and colours diverge, quaternions grow, depths spread along the
line of sight of a static camera, and Gaussians that drift off the tissue never return. The tissue then gets holes. New
Gaussians fill the holes until the capacity is exhausted and the quality falls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.growth.covering import Covering, OutOfView, fill_new_tissue, grid_spacing, has_moved
from gsplat_core.training.growth.initialisation import SIGMA_IN_SPACINGS
from gsplat_core.training.growth.unseen import LastSeen, around_cells, depth_of, pixels_of, value_at
from gsplat_core.training.motion.prior import Following
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies.streaming import halves

RELAX_EVERY = 128
"""Training steps between two relaxation rounds."""
RENEW_EVERY = 512
"""Training steps between two searches for useless Gaussians and sparse tissue, which take milliseconds on a GPU."""
RELAXING_STEPS = 3600
"""Time constant in steps with which sizes, opacities and colours relax to default values where
training does not hold them.
"""
THINNEST_PX = 0.2
"""Smallest standard deviation in pixels; smaller ones give equal pictures because of the renderer's blur of 0.55 px."""
WIDEST = 8.0
"""Largest size, in multiples of the default size."""
MOST_SPLIT = 0.02
"""Share of the Gaussians split in one round."""
SURFACE_STEPS = 100_000
"""Time constant in steps with which depths relax to those of the Gaussians around. It is long, because training also
learns the order along a line of sight.
"""
SURFACE_CELL = 2.0
"""Side of the cells with averaged depth, in default spacings of Gaussians."""
SURFACE_REACH = 2
"""Number of neighbouring cells on each side whose Gaussians count in the mean depth around a cell."""
IDLE = 1e-3
"""Ratio of a Gaussian's mean squared gradient to the scene's mean below which it counts as idle. It
is reached after about 7,000 steps without visibility.
"""


@dataclass(frozen=True)
class Seen:
    """Gaussians of a scene at a frame's time, projected to that frame's picture."""

    now: Gaussians
    """Gaussians of the scene at the frame's time."""
    pixels: Tensor
    """Pixel positions of the Gaussians' centres, [N, 2]."""
    inside: Tensor
    """Marks of centres in the picture, bool [N]."""
    shown: Tensor
    """Marks of centres in the picture and on tissue, bool [N]."""


class Upkeep:
    """Maintenance of one scene, whose first camera is `camera`."""

    def __init__(self, camera: Camera, config: ReconstructorConfig) -> None:
        self._first_camera, self._capacity = camera, config.max_gaussians
        self._spacing_px = grid_spacing(camera.width_px * camera.height_px, config.gaussians)
        self._relaxed_at = self._renewed_at = 0
        self._has_moved = False

    def __call__(self, step: TrainingStep, observation: Observation, last_seen: LastSeen | None = None) -> None:
        """Run the maintenance that is due, which synchronises with the device. Rows of `last_seen` follow the scene's."""
        self._has_moved = self._has_moved or observation.camera != self._first_camera
        if step.steps - self._relaxed_at < RELAX_EVERY:
            return
        with torch.no_grad():
            seen = self._look(step, observation)
            self._relax(step, seen, observation.camera)
            if step.steps - self._renewed_at >= RENEW_EVERY:
                self._renew(step, seen, observation, last_seen, self._useless(step, seen))

    def once(self, step: TrainingStep, observation: Observation, last_seen: LastSeen | None = None) -> None:
        """Run all maintenance immediately, as if the first Gaussian were useless. For warm-up."""
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
        """Relax depths and rotations if the field supports it, remove Gaussians in `leaving`, bool
        [N], and split others in sparse tissue.
        """
        since, self._renewed_at = step.steps - self._renewed_at, step.steps
        if step.capabilities.motion is not None:
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
        """Relax visible Gaussians towards the default size, opacity 0.5 and grey. Limit the sizes of all Gaussians."""
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
        """Return distance factors [N] that relax visible Gaussians to the depth around them, for `since` steps.

        The camera sees the same picture. If it moves or depth is known, training counteracts errors. Otherwise all
        depths would drift together, because equal steps along the line of sight are unequal in the picture. The median
        distance of visible Gaussians is then kept constant.
        """
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
        """Return which idle Gaussians can be removed, bool [N].

        Inside the picture, these are all but one per grid cell, since a tool that hides them may leave. Outside the
        picture, these are all if the camera never moved, otherwise none.
        """
        idle = step.idle(IDLE)
        inside = idle & seen.inside
        crowded = inside & _repeated(torch.floor(seen.pixels / self._spacing_px), inside)
        return crowded if self._has_moved else crowded | (idle & ~seen.inside)

    def _fill_up(self, step: TrainingStep, observation: Observation, shown: Tensor) -> None:
        """Split `shown` Gaussians, bool [N], of the largest gradients towards the initial density: at most `MOST_SPLIT`."""
        wanted = torch.count_nonzero(observation.mask) / self._spacing_px**2
        missing = int(wanted - torch.count_nonzero(shown))
        count = min(missing, round(MOST_SPLIT * step.gaussians.count), self._capacity - step.gaussians.count)
        if count > 0:
            step.split(step.busiest(count, shown), halves)


REVEALED_SHARE = 0.01
"""Width of a newly revealed strip, as a share of the picture's width, from which new tissue is
searched before the first step.
"""


class PostponedGrowth:
    """Growth and maintenance of live scenes, most of which waits until a frame has been displayed."""

    def __init__(self, config: ReconstructorConfig, device: torch.device, covering: Covering) -> None:
        self._config, self._covering = config, covering
        self._out_of_view = OutOfView(config.max_gaussians, device) if config.preallocate else None
        self._upkeep: Upkeep | None = None
        self._camera_before: Camera | None = None
        """Camera at the last search for tissue that came into view."""

    @property
    def archived(self) -> int:
        return 0 if self._out_of_view is None else len(self._out_of_view.archive)

    def unseen_s(self, count: int) -> Tensor | None:
        """Return `Model.unseen_s` of the scene's `count` Gaussians; None if it is not recorded."""
        return None if self._out_of_view is None else self._out_of_view.unseen_s(count)

    def begin(self, camera: Camera) -> None:
        """Start a scene whose first frame is observed by `camera`."""
        if self._out_of_view is not None:
            self._out_of_view.restart()
        self._upkeep = None if self._config.history_s is None else Upkeep(camera, self._config)

    def forget(self) -> None:
        """Discard the previous camera when the stream leaves the scene."""
        self._camera_before = None

    def prepare(self, step: TrainingStep, frame: Frame, observation: Observation, motion: Following) -> None:
        """Fill tissue that came into view because the camera moved or because the motion prior moved the scene away
        from an edge. Called before the first training step on the newest frame.
        """
        before, camera = self._camera_before, observation.camera
        if before is None:
            self._camera_before = camera
        elif before != camera and has_moved(camera, before, step.distance(camera)):
            self._camera_before = camera
            fill_new_tissue(step, frame, observation, before, self._config, self._out_of_view)
        if motion.has_revealed(REVEALED_SHARE * camera.width_px):
            self._cover(step, frame, observation, motion)

    def finish(self, step: TrainingStep, frame: Frame, observation: Observation, motion: Following) -> None:
        """Archive, restore, maintain and add Gaussians after the display of the newest frame."""
        if self._out_of_view is not None:
            self._out_of_view.follow(step, observation)
        if self._upkeep is not None:
            self._upkeep(step, observation, self._last_seen)
        self._cover(step, frame, observation, motion)

    def once(self, step: TrainingStep, observation: Observation) -> None:
        """Run all maintenance immediately, forcing eviction. For warm-up."""
        if self._upkeep is not None:
            self._upkeep.once(step, observation, self._last_seen)

    @property
    def _last_seen(self) -> LastSeen | None:
        return None if self._out_of_view is None else self._out_of_view.last_seen

    def _cover(self, step: TrainingStep, frame: Frame, observation: Observation, motion: Following) -> None:
        self._covering.cover(step, frame, observation)
        motion.cover_revealed()


def _repeated(cells: Tensor, counted: Tensor) -> Tensor:
    """Mark the `counted` elements whose integer cell [N, 2] occurs earlier, bool [N]."""
    count = len(cells)
    number = cells[:, 1].double() * 2**20 + cells[:, 0].double()
    # Give every element that is not counted a cell of its own, so that it repeats none.
    number = torch.where(counted, number, -1.0 - torch.arange(count, device=cells.device))
    ordered, order = number.sort(stable=True)
    marks = torch.zeros(count, dtype=torch.bool, device=cells.device)
    marks[order[1:]] = ordered[1:] == ordered[:-1]
    return marks & counted
