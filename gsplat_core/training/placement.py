"""Moving a scene to where depth of a frame says it is.

Pictures of one eye hardly tell how far away tissue is, nor how it moves along the line of sight; the loss alone would take thousands of steps for that
way. So each Gaussian is moved along its ray of the camera that shows it, which sees the same picture as before: by the first depth the whole scene, which
had started on a plane at an arbitrary distance, because its scope had not moved yet or its eyes had not been matched; then by depth that was found by
parallax at all times, because that takes tissue to be at rest, and by measured or matched depth at one time.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import LOG_SCALE, POSITION
from gsplat_core.training.coverage import UNCOVERED_ALPHA
from gsplat_core.training.hole_filling import filled
from gsplat_core.training.initialisation import possible_depth, tissue_depth
from gsplat_core.training.observations import Observation, known_depth
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import Seen, beside
from gsplat_core.transfers import tensor_of

LARGEST_STEP = 1.4
"""Factor by which one frame changes the depth of one Gaussian at most, once the scene's distance is known."""
CORRECTS_ALL_TIMES = (DepthOrigin.PARALLAX,)
CORRECTS_ONE_TIME = (None, DepthOrigin.MEASURED, DepthOrigin.STEREO)
"""Origins of depth that goes on correcting the scene; that of a frame which does not say is measured. Other depth is only started from."""
SHARE = 0.5
"""Of the way that a later frame moves a Gaussian: depths of several frames are averaged."""
CORRECTED_PX = 16
"""Side of the squares of a picture whose Gaussians are moved together."""


class Placement:
    """Of one scene: the first depth places all of it, later ones correct what they are sure of."""

    def __init__(self, first: Frame | None) -> None:
        """first: the frame that the scene started from."""
        self._first = first
        self.is_placed = _has_depth(first)
        """Whether the scene is where a depth says."""
        self.postpones = False
        """Whether depth that a frame comes with corrects the scene when `catch_up` is called: pictures do not wait for it then."""
        self._postponed: tuple[Frame, Observation] | None = None

    def catch_up(self, step: TrainingStep) -> None:
        """What the newest frame's depth corrects, if that was postponed."""
        if self._postponed is not None:
            frame, observation = self._postponed
            self._postponed = None
            self.apply(step, frame, observation, observation.time_s)

    def apply(self, step: TrainingStep, frame: Frame, observation: Observation, shown_s: float | None = None) -> None:
        """Correct the scene by the depth of a frame, if it has any and the field takes positions; the field covers its time already.

        shown_s: the time at which motion is corrected; None: the frame's own. Later where depth is found after newer frames were trained on.
        """
        if self.postpones and self.is_placed and shown_s is None:
            self._postponed = frame, observation
            return
        if frame is self._first or frame.depth is None:
            return
        if observation.camera.model != "pinhole" or not step.field.takes_positions:
            return
        if self.is_placed and frame.depth_origin not in CORRECTS_ALL_TIMES + CORRECTS_ONE_TIME:
            return
        # Depth by light is in no observation: the loss does not see it.
        there_is = possible_depth(frame)
        if not there_is.any():
            return
        possible = known_depth(there_is, observation.image.device)
        with torch.no_grad():
            if self.is_placed and frame.depth_origin in CORRECTS_ONE_TIME:
                _correct(step, observation, possible, observation.time_s if shown_s is None else shown_s)
                return
            points = step.gaussians.means + step.field.deltas(observation.time_s)[:, POSITION]
            seen = Seen(observation.camera, points)
            inside, now, there = seen.inside[:, 0], seen.depth[:, 0], seen.read(possible)
            known = inside & (there > 0)
            if self.is_placed:
                told = torch.where(known, there, now)
                factor = (told / now).pow(SHARE).clamp(1 / LARGEST_STEP, LARGEST_STEP)
            else:
                if not bool(known.any()):
                    return
                # What is not sure goes along with what is sure beside it, and what the picture does not show with all of it.
                everywhere = seen.read(tensor_of(tissue_depth(frame, float(now.median())), points.device))
                factor = everywhere / now
                factor = torch.where(inside, factor, (everywhere / now)[known].median())
            step.scale_about(observation.camera, factor)
            if not self.is_placed:
                step.take_distance(observation.camera)
        self.is_placed = True


def _correct(step: TrainingStep, observation: Observation, depth: Tensor, shown_s: float) -> None:
    """Move the scene nearer to a frame's depth [H, W] (0: unknown) at one time."""
    camera = observation.camera
    now = step.at(observation.time_s)
    factor = _smooth_factor(now, observation, depth, Seen(camera, now.means).pixels)
    deltas = step.field.deltas(shown_s)
    points = step.gaussians.means + deltas[:, POSITION]
    deltas[:, POSITION] += (factor - 1)[:, None] * (points - beside(points, camera.position))
    deltas[:, LOG_SCALE] += factor.log()[:, None]
    step.field.move_to(shown_s, deltas)


def _smooth_factor(now: Gaussians, observation: Observation, depth: Tensor, pixels: Tensor) -> Tensor:
    """By which factor [N] the depth of Gaussians at `pixels` [N, 2] changes. It is the same for neighbours: tissue moves smoothly, and Gaussians that
    change their order along the line of sight change the picture."""
    shown = render(now, observation.camera, depth=True)
    known = (depth > 0) & (observation.mask > 0) & (shown.alpha >= UNCOVERED_ALPHA)
    ratio = torch.where(known, depth / shown.depth, 1.0).log()
    smooth = filled(ratio[None], known[None].to(ratio.dtype), CORRECTED_PX)
    grid = 2 * pixels / beside(pixels, [ratio.shape[1], ratio.shape[0]]) - 1
    there = grid_sample(smooth[None], grid[None, None], padding_mode="border", align_corners=False)[0, 0, 0]
    return (SHARE * there).exp().clamp(1 / LARGEST_STEP, LARGEST_STEP)


def _has_depth(frame: Frame | None) -> bool:
    return frame is not None and bool(np.any(possible_depth(frame)))
