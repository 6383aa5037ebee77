"""Correction of the scene's geometry by the depth of frames.

Pictures of one eye hardly constrain distance or motion along the line of sight, so the loss alone
would need thousands of steps. Each Gaussian is therefore moved along its ray of the current camera,
which sees the same picture as before. The first depth places the whole scene, which started on a
plane. Later depth by parallax corrects all times, since it assumes static tissue. Later measured or
stereo depth corrects a single time.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsplat_core.deformation.basis import BasisField
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.scene.layout import POSITION
from gsplat_core.training.captured_correction import CapturedCorrection
from gsplat_core.training.coverage import UNCOVERED_ALPHA
from gsplat_core.training.depth_correction import LARGEST_STEP, SHARE, move_along_rays_, smooth_factor
from gsplat_core.training.initialisation import possible_depth, tissue_depth
from gsplat_core.training.late_depth import LateDepth
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import Seen, beside
from gsplat_core.transfers import tensor_of

CORRECTS_ALL_TIMES = (DepthOrigin.PARALLAX,)
CORRECTS_ONE_TIME = (None, DepthOrigin.MEASURED, DepthOrigin.STEREO)
"""Depth sources trusted to refine geometry after initialisation, at all times or at the frame's
time. None is an unspecified source, treated as measured. Other sources only initialise the scene.
"""


class Placement:
    """Depth corrections of consecutive scenes: the first depth places the whole scene, later ones
    refine it.
    """

    def __init__(self) -> None:
        self._captured: CapturedCorrection | None = None
        self.begin(None)

    def begin(self, first: Frame | None) -> None:
        """Start another scene from the frame `first`, or None."""
        self._first = first
        self.is_placed = _has_depth(first)
        """True once the scene was placed by a depth."""
        self.postpones = False
        """Postpone corrections by a frame's own depth to `catch_up`, so that the displayed picture
        does not wait for them.
        """
        self._postponed: tuple[Frame, Observation] | None = None

    def catch_up(self, step: TrainingStep) -> None:
        """Apply a postponed correction by the newest frame's depth."""
        if self._postponed is not None:
            frame, observation = self._postponed
            self._postponed = None
            self.apply(step, frame, observation, observation.time_s)

    def apply(
        self,
        step: TrainingStep,
        frame: Frame,
        observation: Observation,
        shown_s: float | None = None,
        late: LateDepth | None = None,
    ) -> None:
        """Correct the scene by a frame's depth, if it has any and the field supports it. The field
        must cover the frame's time.

        Args:
            step: training step of the scene.
            frame: frame with depth.
            observation: the same frame as tensors.
            shown_s: time at which motion is corrected, in seconds; None for the frame's own. Later
                for late depth.
            late: prepared depth of the frame, if any.
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
        # The loss ignores shading depth, so observations do not contain it.
        late = late or LateDepth.for_placement(frame, observation.image.device)
        possible = late.possible
        if possible is None:
            return
        with torch.no_grad():
            if self.is_placed and frame.depth_origin in CORRECTS_ONE_TIME:
                self._correct(step, observation, possible, observation.time_s if shown_s is None else shown_s)
            elif self.is_placed:
                _correct_all_times(step, observation, possible)
            else:
                self.is_placed = _place(step, frame, observation, late)

    def _correct(self, step: TrainingStep, observation: Observation, depth: Tensor, shown_s: float) -> None:
        """Move the scene at one time towards a frame's depth [H, W] (0 = unknown)."""
        rows, field = step.fixed_rows, step.field
        if rows is None or rows.device.type != "cuda" or not isinstance(field, BasisField):
            _correct_at(step, observation, depth, shown_s)
            return
        if self._captured is None or not self._captured.fits(rows, field, observation.camera):
            self._captured = CapturedCorrection(rows, field, observation.camera)
        self._captured(observation, depth, shown_s)


def _place(step: TrainingStep, frame: Frame, observation: Observation, late: LateDepth) -> bool:
    """Move the whole scene to the distance of its first depth. Returns False if the depth covers
    none of the scene.
    """
    assert late.possible is not None
    seen = _shown_now(step, observation)
    inside, now, there = seen.inside[:, 0], seen.depth[:, 0], seen.read(late.possible)
    known = inside & (there > 0)
    if not bool(known.any()):
        return False
    # Gaussians without depth move with their neighbours, and those outside the picture with the
    # median.
    everywhere = late.everywhere
    if everywhere is None:
        everywhere = tensor_of(tissue_depth(frame, float(now.median())), now.device)
    factor = seen.read(everywhere) / now
    factor = torch.where(inside, factor, factor[known].median())
    step.scale_about(observation.camera, factor)
    step.take_distance(observation.camera)
    return True


def _correct_all_times(step: TrainingStep, observation: Observation, possible: Tensor) -> None:
    """Move each Gaussian at all times towards the depth [H, W] (0 = unknown) of static tissue."""
    seen = _shown_now(step, observation)
    now, there = seen.depth[:, 0], seen.read(possible)
    target = torch.where(seen.inside[:, 0] & (there > 0), there, now)
    factor = (target / now).pow(SHARE).clamp(1 / LARGEST_STEP, LARGEST_STEP)
    step.scale_about(observation.camera, factor)


def _shown_now(step: TrainingStep, observation: Observation) -> Seen:
    points = step.gaussians.means + step.field.deltas(observation.time_s)[:, POSITION]
    return Seen(observation.camera, points)


def _correct_at(step: TrainingStep, observation: Observation, depth: Tensor, shown_s: float) -> None:
    """Apply the correction of `CapturedCorrection` with separate launches, on any device."""
    camera = observation.camera
    now = step.at(observation.time_s)
    shown = render(now, camera, depth=True)
    known = (depth > 0) & (observation.mask > 0) & (shown.alpha >= UNCOVERED_ALPHA)
    factor = smooth_factor(depth, shown.depth, known, Seen(camera, now.means).pixels)
    deltas = step.field.deltas(shown_s)
    move_along_rays_(deltas, step.gaussians.means, factor, beside(now.means, camera.position))
    step.field.move_to(shown_s, deltas)


def _has_depth(frame: Frame | None) -> bool:
    return frame is not None and bool(np.any(possible_depth(frame)))
