"""Moving a scene to where depth of a frame says it is.

Pictures of one eye hardly tell how far away tissue is, nor how it moves along the line of sight; the loss alone would take thousands of steps for that
way. So each Gaussian is moved along its ray of the camera that shows it, which sees the same picture as before: by the first depth the whole scene, which
had started on a plane at an arbitrary distance; then by depth that was found by parallax at all times, because that takes tissue to be at rest, and by
measured or matched depth at the frame's own time.
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
from gsplat_core.training.initialisation import tissue_depth
from gsplat_core.training.observations import Observation
from gsplat_core.training.start_on_device import filled
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import Seen, beside
from gsplat_core.transfers import tensor_of

LARGEST_STEP = 1.4
"""Factor by which one frame changes the depth of one Gaussian at most, once the scene's distance is known."""
SHARE = 0.5
"""Of the way that a later frame moves a Gaussian: depths of several frames are averaged."""

TOGETHER_PX = 16
"""Side of the squares of a picture whose Gaussians are moved together."""


class Placement:
    """Of one scene: the first depth places all of it, later ones correct what they are sure of."""

    def __init__(self, first: Frame | None) -> None:
        """first: the frame that the scene started from."""
        self._first, self._is_placed = first, _tells_depth(first)

    def apply(self, step: TrainingStep, frame: Frame, observation: Observation) -> None:
        """Correct the scene by the depth of a frame, if it has any that may be learned from; the field covers its time already."""
        if frame is self._first or observation.depth is None or not _tells_depth(frame):
            return
        if observation.camera.model != "pinhole":
            return
        with torch.no_grad():
            deltas = step.field.deltas(observation.time_s)
            points = step.gaussians.means + deltas[:, POSITION]
            seen = Seen(observation.camera, points)
            column, row = seen.pixels.long().clamp(min=0).unbind(1)
            height, width = observation.depth.shape
            at = row.clamp(max=height - 1), column.clamp(max=width - 1)
            inside, now = seen.inside[:, 0], seen.depth[:, 0]
            known = inside & (observation.depth[at] > 0) & (observation.mask[at] > 0)
            if not self._is_placed:
                if bool(known.any()):
                    self._place(step, frame, observation, now, inside, known, at)
                return
            if frame.depth_origin is DepthOrigin.PARALLAX:
                told = torch.where(known, observation.depth[at], now)
                factor = (told / now).pow(SHARE).clamp(1 / LARGEST_STEP, LARGEST_STEP)
                step.scale_about(observation.camera, factor)
                return
            factor = _moved_together(step.at(observation.time_s), observation, seen.pixels)
            centre = beside(points, observation.camera.position)
            deltas[:, POSITION] += (factor - 1)[:, None] * (points - centre)
            deltas[:, LOG_SCALE] += factor.log()[:, None]
            step.field.move_to(observation.time_s, deltas)

    def _place(
        self,
        step: TrainingStep,
        frame: Frame,
        observation: Observation,
        now: Tensor,
        inside: Tensor,
        known: Tensor,
        at: tuple[Tensor, Tensor],
    ) -> None:
        """Move the whole scene, whose Gaussians are in depth `now` [N], to the first depth that there is."""
        # What is not sure goes along with what is sure beside it, and what the picture does not show with all of it.
        everywhere = tensor_of(tissue_depth(frame, float(now.median())), now.device)[at]
        factor = everywhere / now
        step.scale_about(observation.camera, torch.where(inside, factor, factor[known].median()))
        step.take_distance(observation.camera)
        self._is_placed = True


def _moved_together(now: Gaussians, observation: Observation, pixels: Tensor) -> Tensor:
    """By which factor the depth of Gaussians at `pixels` [N, 2] changes, so that the scene comes nearer to a frame's depth [N].

    Neighbours by the same one: tissue moves smoothly, and Gaussians that change their order along the line of sight change the picture.
    """
    assert observation.depth is not None
    shown = render(now, observation.camera, depth=True)
    known = (observation.depth > 0) & (observation.mask > 0) & (shown.alpha >= UNCOVERED_ALPHA)
    ratio = torch.where(known, observation.depth / shown.depth, 1.0).log()
    smooth = filled(ratio[None], known[None].to(ratio.dtype), TOGETHER_PX)
    grid = 2 * pixels / beside(pixels, [ratio.shape[1], ratio.shape[0]]) - 1
    there = grid_sample(smooth[None], grid[None, None], padding_mode="border", align_corners=False)[0, 0, 0]
    return (SHARE * there).exp().clamp(1 / LARGEST_STEP, LARGEST_STEP)


def _tells_depth(frame: Frame | None) -> bool:
    """Whether a frame has depth that is learned from. That of light is only started from."""
    return (
        frame is not None
        and frame.depth_origin is not DepthOrigin.LIGHT
        and frame.depth is not None
        and bool(np.any(frame.depth))
    )
