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
"""Origins of depth that goes on correcting the scene; that of a frame which does not say is measured. Other depth is only started from."""


class Placement:
    """Of one scene after another: the first depth places all of it, later ones correct what they are sure of."""

    def __init__(self) -> None:
        self._captured: CapturedCorrection | None = None
        self.begin(None)

    def begin(self, first: Frame | None) -> None:
        """Another scene, which starts from the frame `first`."""
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

    def apply(
        self,
        step: TrainingStep,
        frame: Frame,
        observation: Observation,
        shown_s: float | None = None,
        late: LateDepth | None = None,
    ) -> None:
        """Correct the scene by the depth of a frame, if it has any and the field takes positions; the field covers its time already.

        shown_s: the time at which motion is corrected; None: the frame's own. Later where depth is found after newer frames were trained on.
        late: the frame's, where that was made ready.
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
        """Move the scene nearer to a frame's depth [H, W] (0: unknown) at one time."""
        rows, field = step.fixed_rows, step.field
        if rows is None or rows.device.type != "cuda" or not isinstance(field, BasisField):
            _correct_at(step, observation, depth, shown_s)
            return
        if self._captured is None or not self._captured.fits(rows, field, observation.camera):
            self._captured = CapturedCorrection(rows, field, observation.camera)
        self._captured(observation, depth, shown_s)


def _place(step: TrainingStep, frame: Frame, observation: Observation, late: LateDepth) -> bool:
    """Move the whole scene to where its first depth says it is; False where the scene shows nothing of that."""
    assert late.possible is not None
    seen = _shown_now(step, observation)
    inside, now, there = seen.inside[:, 0], seen.depth[:, 0], seen.read(late.possible)
    known = inside & (there > 0)
    if not bool(known.any()):
        return False
    # What is not sure goes along with what is sure beside it, and what the picture does not show with all of it.
    everywhere = late.everywhere
    if everywhere is None:
        everywhere = tensor_of(tissue_depth(frame, float(now.median())), now.device)
    factor = seen.read(everywhere) / now
    factor = torch.where(inside, factor, factor[known].median())
    step.scale_about(observation.camera, factor)
    step.take_distance(observation.camera)
    return True


def _correct_all_times(step: TrainingStep, observation: Observation, possible: Tensor) -> None:
    """Move each Gaussian nearer to the depth [H, W] (0: unknown) of tissue that is at rest."""
    seen = _shown_now(step, observation)
    now, there = seen.depth[:, 0], seen.read(possible)
    told = torch.where(seen.inside[:, 0] & (there > 0), there, now)
    factor = (told / now).pow(SHARE).clamp(1 / LARGEST_STEP, LARGEST_STEP)
    step.scale_about(observation.camera, factor)


def _shown_now(step: TrainingStep, observation: Observation) -> Seen:
    points = step.gaussians.means + step.field.deltas(observation.time_s)[:, POSITION]
    return Seen(observation.camera, points)


def _correct_at(step: TrainingStep, observation: Observation, depth: Tensor, shown_s: float) -> None:
    """As `CapturedCorrection`, launch by launch and on any device."""
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
