"""What is assumed about motion after the newest frame: how the model is shown between frames, and where training on the next one starts.

A `MotionPrior` sees each frame before the model is trained on it, and is asked for the velocity after it. Others than those of `MOTION_PRIORS`
are a module and a line there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.deformation.field import Continuation, DeformationField, NewestState, displaced
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import LOG_SCALE, POSITION, RAW_COLUMNS
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.damping import Damping
from gsplat_core.training.depth_from_motion import DepthFromMotion
from gsplat_core.training.image_motion import Flow, ImageMotion, revealed_px, typical_px
from gsplat_core.training.motion_priors import MOTION_PRIORS
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import SurfaceMotion
from gsplat_core.transfers import tensor_of

HORIZON_S = 0.15
"""How long after the newest frame its motion goes on at most; then the model holds still."""
LONGEST_GAP_S = 0.15
"""Frames further apart do not show a velocity."""
UNCERTAINTY = 0.05
"""Variance of where a Gaussian will be, in squares of the length of its last motion."""
MOST_WIDENED = 0.7
"""Bound of what is added to a log-scale from one frame to the next."""
SUDDEN = 5.0
"""A motion so many times the usual one, and more than `SUDDEN_PX`, is a jump of the picture and does not go on."""
SUDDEN_PX = 1.0
USUAL_DECAY = 0.1
"""How fast the usual motion follows the newest one."""


class MotionPrior(Protocol):
    """One stream's assumption about motion. Its memory and the time of a call do not grow with the stream."""

    def observe(self, frame: Frame, time_s: float, camera: Camera, step: TrainingStep) -> None:
        """Take the next frame before the model is trained on it; the field covers `time_s` already. The scene may be moved to where the
        frame shows it."""

    def velocity(self, step: TrainingStep, deltas: Tensor | None = None) -> Tensor | None:
        """What the raw parameters change by per second after the newest frame, [N, 16]; None for nothing. `deltas` are what the field adds
        at that frame's time, where they are known already."""

    @property
    def newest_s(self) -> float:
        """Time of the newest frame that was observed."""

    @property
    def horizon_s(self) -> float:
        """How long after the newest frame its velocity goes on; then the model holds still."""

    revealed_px: float
    """How wide a strip at an edge the picture shows that it did not show when this was set to 0 last."""

    def forget(self) -> None:
        """A new scene begins."""


class FlowPrior:
    """The motion between the last two frames goes on, as much of it as went on before. It is measured in the pictures, as optical flow of the tissue.

    That is more exact than the model's own past: bumps in time average over several frames.
    """

    def __init__(self, config: ReconstructorConfig) -> None:
        self._starts_there, self._finds_depth = config.start_from_motion, config.depth_from_motion
        self._image_motion = ImageMotion(config.motion_detail)
        self.forget()

    def forget(self) -> None:
        """See `MotionPrior.forget`."""
        self._image_motion.forget()
        self._depth = DepthFromMotion()
        self._damping = Damping()
        self._camera: Camera | None = None
        self._motion: SurfaceMotion | None = None
        self._interval_s = 0.0
        self._usual_px: float | None = None
        self._is_sudden = False
        self.newest_s = self.revealed_px = 0.0

    @property
    def horizon_s(self) -> float:
        """See `MotionPrior.horizon_s`."""
        return HORIZON_S

    def observe(self, frame: Frame, time_s: float, camera: Camera, step: TrainingStep) -> None:
        """See `MotionPrior.observe`."""
        before, before_s = self._camera, self.newest_s
        self._camera, self.newest_s = camera, time_s
        last, last_interval_s, self._motion = self._usable_motion(), self._interval_s, None
        flow = self._image_motion.follow(frame.image, followed(frame))
        if flow is None or before is None or camera.model != "pinhole":
            self._take(frame, None, step.gaussians.device)
            return
        self._interval_s = time_s - before_s
        self._judge(typical_px(flow))
        self.revealed_px += revealed_px(flow)
        self._motion = SurfaceMotion(tensor_of(flow, step.gaussians.device), before, camera)
        self._take(frame, flow, step.gaussians.device)
        if self._finds_depth and frame.pose is not None and frame.depth is None:
            self._depth.apply(step, self._motion, before_s)
        learns = last is not None and self._usable_motion() is not None
        if not (learns or self._starts_there):
            return
        with torch.no_grad():
            held = step.field.deltas(before_s)
            points = step.gaussians.means + held[:, POSITION]
            ahead = self._motion.ahead(points)
            if last is not None and learns:
                self._damping.learn(last.arrived(points) / last_interval_s, ahead / self._interval_s)
            if self._starts_there:
                # The scene at `time_s` is its state at `before_s`, moved on by the flow, in place of what the bumps go on with.
                held[:, POSITION] += ahead
                step.field.move_to(time_s, held)

    def velocity(self, step: TrainingStep, deltas: Tensor | None = None) -> Tensor | None:
        """See `MotionPrior.velocity`."""
        motion = self._usable_motion()
        if motion is None:
            return None
        with torch.no_grad():
            deltas = step.field.deltas(self.newest_s) if deltas is None else deltas
            moved = motion.arrived(step.gaussians.means + deltas[:, POSITION])
            velocity = moved.new_zeros(moved.shape[0], RAW_COLUMNS)
            velocity[:, POSITION] = self._damping.damped(moved)
            velocity[:, LOG_SCALE] = widened(step.gaussians.log_scales + deltas[:, LOG_SCALE], moved)
        return velocity / self._interval_s

    def _take(self, frame: Frame, flow: Flow | None, device: torch.device) -> None:
        """What else is to be learned from a frame, and from how the picture before moved to it; None where that is not known."""

    def _usable_motion(self) -> SurfaceMotion | None:
        """The newest motion where it says how the next frame will be."""
        return self._motion if 0 < self._interval_s <= LONGEST_GAP_S and not self._is_sudden else None

    def _judge(self, moved_px: float) -> None:
        """Whether the motion is a jump; learn the usual one."""
        usual = moved_px if self._usual_px is None else self._usual_px
        self._is_sudden = moved_px > max(SUDDEN * usual, SUDDEN_PX)
        self._usual_px = usual + USUAL_DECAY * (min(moved_px, SUDDEN * usual) - usual)


def widened(log_scales: Tensor, moved: Tensor) -> Tensor:
    """What makes Gaussians [N, 3] as wide as the places [N, 3] where they may be by the next frame: added to their log-scales.

    The picture that is nearest to all that may come is their mean, and the mean of a Gaussian over normally distributed places is a wider
    one. The spread is taken in proportion to the last motion.
    """
    variance = UNCERTAINTY * moved.square().sum(dim=1, keepdim=True)
    return (0.5 * torch.log1p(variance * torch.exp(-2 * log_scales))).clamp(max=MOST_WIDENED)


def followed(frame: Frame) -> NDArray[np.uint8] | None:
    """Where the frame shows tissue that can be followed; None: everywhere."""
    if frame.mask is None or frame.loss_mask is None:
        return frame.mask if frame.loss_mask is None else frame.loss_mask
    return frame.mask & frame.loss_mask


def no_prior(config: ReconstructorConfig) -> None:
    """The field's bumps go on as they do."""


def new_motion_prior(config: ReconstructorConfig, field: DeformationField) -> MotionPrior | None:
    """The prior that is configured, where the field can be continued. Raises InvalidSetting for an unknown name."""
    prior: MotionPrior | None = MOTION_PRIORS[config.motion_prior](config)
    return prior if field.continues else None


@contextmanager
def continued(step: TrainingStep, prior: MotionPrior | None, learned_s: float) -> Iterator[None]:
    """For the time of a copy for publishing the scene goes on as the prior says after `learned_s`, the time of the newest frame that was
    trained on; training knows nothing of it. The scene holds still there where the prior has not seen that frame yet."""
    if prior is None:
        yield
        return
    # Also without a velocity: slots whose fields have a continuation from the start need no other memory later.
    velocity = prior.velocity(step) if prior.newest_s == learned_s else None
    still = step.gaussians.means.new_zeros(0, RAW_COLUMNS)
    step.field.continue_with(still if velocity is None else velocity, learned_s, prior.horizon_s)
    try:
        yield
    finally:
        step.field.continuation = None


def newest_state(step: TrainingStep, prior: MotionPrior, learned_s: float) -> tuple[Gaussians, NewestState]:
    """The scene at `learned_s`, the time of the newest frame that was trained on, and how the prior lets it go on: what `continued` copies
    shows from then on, without the past, in memory of its own."""
    with torch.no_grad():
        deltas = step.field.deltas(learned_s)
        velocity = prior.velocity(step, deltas) if prior.newest_s == learned_s else None
        still = step.gaussians.means.new_zeros(0, RAW_COLUMNS)
        continuation = Continuation(step.gaussians.count, step.gaussians.device)
        continuation.write(still if velocity is None else velocity, learned_s, prior.horizon_s)
        now = displaced(step.gaussians, deltas)
        # The field adds nothing to opacities, so that these are still those that training changes.
        right = None if now.right_sh is None else now.right_sh.clone()
        own = replace(now, logit_opacities=now.logit_opacities.clone(), right_sh=right)
        return own, NewestState(learned_s, continuation)
