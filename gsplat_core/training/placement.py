"""Moving a scene to where depth that was found later says it is.

A stream starts before its scope has moved, on a plane at an arbitrary distance. When parallax shows where tissue is, each Gaussian is moved along its ray
of the camera that shows it, which sees the same picture as before; the loss alone would take thousands of steps for that way.
"""

from __future__ import annotations

import numpy as np
import torch

from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.scene.layout import POSITION
from gsplat_core.training.initialisation import tissue_depth
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import Seen
from gsplat_core.transfers import tensor_of

LARGEST_STEP = 1.4
"""Factor by which one frame changes the depth of one Gaussian at most, once the scene's distance is known."""
SHARE = 0.5
"""Of the way that a later frame moves a Gaussian: depths of several frames are averaged."""


class Placement:
    """Of one scene: the first depth that parallax shows places all of it, later ones correct what they are sure of."""

    def __init__(self, first: Frame | None) -> None:
        """first: the frame that the scene started from."""
        self._first, self._is_placed = first, _has_parallax(first)

    def apply(self, step: TrainingStep, frame: Frame, observation: Observation) -> None:
        """Correct the scene by the depth of a frame, if it has any and it was found by parallax; the field covers its time already."""
        if frame is self._first or observation.depth is None or not _has_parallax(frame):
            return
        if observation.camera.model != "pinhole":
            return
        with torch.no_grad():
            points = step.gaussians.means + step.field.deltas(observation.time_s)[:, POSITION]
            seen = Seen(observation.camera, points)
            column, row = seen.pixels.long().clamp(min=0).unbind(1)
            height, width = observation.depth.shape
            at = row.clamp(max=height - 1), column.clamp(max=width - 1)
            inside, now = seen.inside[:, 0], seen.depth[:, 0]
            known = inside & (observation.depth[at] > 0)
            if self._is_placed:
                told = torch.where(known, observation.depth[at], now)
                factor = (told / now).pow(SHARE).clamp(1 / LARGEST_STEP, LARGEST_STEP)
            else:
                if not bool(known.any()):
                    return
                # What is not sure goes along with what is sure beside it, and what the picture does not show with all of it.
                everywhere = tensor_of(tissue_depth(frame, float(now.median())), points.device)[at]
                factor = everywhere / now
                factor = torch.where(inside, factor, (everywhere / now)[known].median())
            step.scale_about(observation.camera, factor)
            if not self._is_placed:
                step.take_distance(observation.camera)
        self._is_placed = True


def _has_parallax(frame: Frame | None) -> bool:
    return frame is not None and frame.depth_origin is DepthOrigin.PARALLAX and bool(np.any(frame.depth))
