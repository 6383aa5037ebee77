"""Prediction of motion after the newest frame, for display between frames and as start of training on the next frame.

A `MotionPrior` processes each frame before the model is trained on it, and predicts the velocity after it. Further
priors are added as modules registered in `MOTION_PRIORS`.

With known camera motion, optical flow also gives the depth of a scene without measured depth (`DepthFromMotion`). Such
a scene starts on a plane at an arbitrary distance. With known poses that plane moves wrongly, and the field would have
to learn the error of every frame. The position of a point in a second frame is linear in its inverse depth w (Hartley
and Zisserman 2004, section 12.2), so every Gaussian has a least-squares w. A correction moves a Gaussian along its ray
of the first camera, so the first camera's picture does not change.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.choices import MOTION_PRIORS
from gsplat_core.deformation.field import Continuation, DeformationField, EditableMotion, NewestState, displaced
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import LOG_SCALE, POSITION, RAW_COLUMNS, Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.image_motion import Flow, ImageMotion, SurfaceMotion, beside, revealed_px, typical_px
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import tensor_of

AT_FIRST = 0.6
"""Assumed share of a motion that continues in the next frame interval, before such a share was observed. See
benchmarks/results/constants.md.
"""
FOLLOWS = 0.15
"""Weight of the newest frame in the moving average of the share of motion that continues."""
ONE_FRAME = (-0.5, 1.5)
"""Bounds of the share of motion observed to continue in one frame, which limit the effect of optical-flow outliers."""


class Damping:
    """Share of a motion that continues in the next interval: exponentially weighted mean of the least-squares share in
    realised = share * last. The share stays on the device without synchronisation.
    """

    def __init__(self) -> None:
        self._share: Tensor | None = None

    def learn(self, last: Tensor, realised: Tensor) -> None:
        """Update the share of motion that continues with the velocities [N, 3] of the Gaussians in two successive
        intervals. A frame without motion changes nothing.
        """
        # Summed in float64, where the order of summation does not affect the result.
        last, realised = last.double(), realised.double()
        share = self._share if self._share is not None else last.new_full((), AT_FIRST)
        seen = (last * realised).sum() / (last * last).sum()
        step = FOLLOWS * (seen.clamp(*ONE_FRAME) - share)
        self._share = share + torch.where(seen.isfinite(), step, torch.zeros_like(step))

    def damped(self, moved: Tensor) -> Tensor:
        """Return the part of a motion [N, 3] that is expected to continue, between none and all of it."""
        return moved * (AT_FIRST if self._share is None else self._share.clamp(0, 1).to(moved.dtype))


FLOW_ERROR_PX = 1.0
"""Standard deviation in pixels of motion that the camera does not explain: tissue motion and errors of flow and pose.
"""
RELATIVE_ERROR = 0.15
"""Prior standard deviation of a Gaussian's inverse depth, relative to it."""
LARGEST_STEP = 1.4
"""Largest change of a Gaussian's depth by one frame, as a factor, once the scene's distance is known."""
LEAST_PARALLAX_PX = 1.5
"""Smallest median parallax of the points, in pixels, at which the scene's distance is estimated."""
LEAST_EXPLAINED = 0.5
"""Share of the motion remaining after camera rotation that a single distance must explain."""
SMALLEST_SHIFT = 1e-9
"""Displacement of a camera along an axis, in scene units, below which it counts as a rounding error and as no displacement."""
ROUNDS = 4
"""Rounds of reweighting in the fit of the scene's distance, which reduce the influence of points that move on their own."""


class DepthFromMotion:
    """Estimator of depth from optical flow of a moving camera: of the scene's distance once, then of each Gaussian's depth
    with every frame.
    """

    def __init__(self) -> None:
        self._distance_is_known = False

    def apply(self, step: TrainingStep, motion: SurfaceMotion, before_s: float) -> None:
        """Correct the scene's depth by the image motion since the frame at `before_s`, at whose time the scene fits its
        picture.

        Nothing changes if the camera only rotated or did not move. On a GPU the host synchronises in every call until
        the scene's distance is known.
        """
        if not np.any(translation_between(motion.before, motion.after)):
            return
        with torch.no_grad():
            deltas = motion_of(step).deltas(before_s)[:, POSITION]
            points = step.gaussians.means + deltas
            seen = motion.seen_before(points)
            target = seen.pixels + motion.at(seen.pixels)
            measured, information = inverse_depths(seen.pixels, target, motion.before, motion.after)
            information = torch.where(seen.inside[:, 0] & (measured > 0), information / FLOW_ERROR_PX**2, 0.0)
            known = 1 / seen.depth[:, 0]
            whole = torch.ones_like(known)
            found = not self._distance_is_known
            if found:
                distance = self._distance(seen.pixels, target, motion, known, information)
                if distance is None:
                    return
                self._distance_is_known = True
                whole = whole * float(known.median()) * distance
                known = known / whole
            gain = information / (information + 1 / (RELATIVE_ERROR * known) ** 2)
            refined = known + gain * (measured - known)
            factor = whole * (known / refined).clamp(1 / LARGEST_STEP, LARGEST_STEP)
            factor = torch.where(seen.inside[:, 0] & factor.isfinite() & (factor > 0), factor, whole)
            step.scale_about(motion.before, factor)
            if found:
                step.take_distance(motion.after)

    def _distance(
        self, pixels: Tensor, target: Tensor, motion: SurfaceMotion, known: Tensor, information: Tensor
    ) -> float | None:
        """Return the depth of the plane parallel to the picture that explains most of the motion. None with too little
        parallax, or if no such plane explains enough.
        """
        c, d = parallax_terms(pixels, target, motion.before, motion.after)
        focal = float(motion.after.K[0, 0])
        weight = (information > 0).to(c.dtype)
        inverse = known.median()
        for _ in range(ROUNDS):
            inverse = (weight * (c * d).sum(1)).sum() / (weight * (c * c).sum(1)).sum().clamp(min=1e-20)
            error_px = focal * (d - inverse * c).norm(dim=1)
            weight = (information > 0) / (1 + (error_px / FLOW_ERROR_PX) ** 2)
        counted = information > 0
        parallax_px = focal * inverse * c.norm(dim=1)
        explained = 1 - (d - inverse * c)[counted].square().sum() / d[counted].square().sum().clamp(min=1e-20)
        enough = counted.any() and bool(parallax_px[counted].median() >= LEAST_PARALLAX_PX)
        return float(1 / inverse) if enough and bool(explained >= LEAST_EXPLAINED) and float(inverse) > 0 else None


def parallax_terms(pixels: Tensor, target: Tensor, before: Camera, after: Camera) -> tuple[Tensor, Tensor]:
    """Return c and d [N, 2] of the equation w c = d for inverse depths w, in units of the focal length.

    Args:
        pixels: positions before [N, 2].
        target: positions after [N, 2].
        before, after: cameras of both frames. c is 0 if only the rotation differs.
    """
    between = after.world_to_camera @ np.linalg.inv(before.world_to_camera)
    rotation = beside(pixels, between[:3, :3])
    tx, ty, tz = (float(value) for value in between[:3, 3])
    first, second = _normalised(pixels, before), _normalised(target, after)
    ray = torch.cat([first, torch.ones_like(first[:, :1])], dim=1) @ rotation.T
    c = second * tz - beside(second, [tx, ty])
    return c, ray[:, :2] - second * ray[:, 2:]


def inverse_depths(pixels: Tensor, target: Tensor, before: Camera, after: Camera) -> tuple[Tensor, Tensor]:
    """Return least-squares inverse depths [N] in the first camera, and their information [N]
    (inverse variance for an error of one pixel).
    """
    c, d = parallax_terms(pixels, target, before, after)
    squared = (c * c).sum(dim=1)
    return (c * d).sum(dim=1) / squared.clamp(min=1e-20), squared * float(after.K[0, 0]) ** 2


def translation_between(before: Camera, after: Camera) -> NDArray[np.float64]:
    """Return the first camera's centre in coordinates of the second [3]; exactly 0 without translation."""
    moved = before.position - after.position
    return np.asarray(after.world_to_camera[:3, :3] @ np.where(np.abs(moved) < SMALLEST_SHIFT, 0.0, moved))


def _normalised(pixels: Tensor, camera: Camera) -> Tensor:
    focal = beside(pixels, [camera.K[0, 0], camera.K[1, 1]])
    return (pixels - beside(pixels, [camera.K[0, 2], camera.K[1, 2]])) / focal


HORIZON_S = 0.15
"""Longest time in seconds after the newest frame for which motion is extrapolated. Later the scene is static."""
LONGEST_GAP_S = 0.15
"""Longest interval between frames that gives a velocity, in seconds."""
UNCERTAINTY = 0.05
"""Variance of a Gaussian's predicted position, relative to the squared length of its last motion."""
MOST_WIDENED = 0.7
"""Largest increase of a Gaussian's log-scales that accounts for the uncertainty of its predicted position (`widened`)."""
SUDDEN = 5.0
"""Ratio to the usual median motion of frames above which a motion over `SUDDEN_PX` pixels is a jump, not extrapolated."""
SUDDEN_PX = 1.0
USUAL_DECAY = 0.1
"""Weight of the newest frame in the usual motion, a moving average of the median motion in pixels."""


class MotionPrior(Protocol):
    """Motion prediction of one stream. Memory and time per call do not grow with the stream."""

    def observe(self, frame: Frame, time_s: float, camera: Camera, step: TrainingStep) -> None:
        """Process the next frame before the model is trained on it. The field must already cover
        `time_s`. The prior may move the scene to match the frame.
        """

    def velocity(self, step: TrainingStep, deltas: Tensor | None = None) -> Tensor | None:
        """Return the rate of change per second of the raw parameters after the newest frame, [N, 16]; None if unknown.
        `deltas` are the field's raw deltas at that frame's time, if already computed.
        """

    @property
    def newest_s(self) -> float:
        """Time of the newest frame processed, in seconds."""

    @property
    def horizon_s(self) -> float:
        """Time after the newest frame for which the velocity applies, in seconds."""

    revealed_px: float
    """Width in pixels of the strip revealed at an edge of the picture since the attribute was last set to 0."""

    def forget(self) -> None:
        """Reset for a new scene."""


class FlowPrior:
    """Motion prior that continues the motion between the last two frames, damped by its observed persistence. The
    motion is measured as optical flow of the tissue.

    Flow is more accurate than the model's own past, since temporal basis functions average over several frames.
    """

    def __init__(self, config: ReconstructorConfig) -> None:
        self._starts_there, self._finds_depth = config.start_from_motion, config.depth_from_motion
        self._image_motion = ImageMotion(config.motion_detail)
        self.forget()

    def forget(self) -> None:
        """Reset for a new scene."""
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
        """Time in seconds after the newest frame for which the velocity applies: always `HORIZON_S`."""
        return HORIZON_S

    def observe(self, frame: Frame, time_s: float, camera: Camera, step: TrainingStep) -> None:
        """Measure the optical flow from the previous frame to `frame` and update the damping, for pinhole cameras only.

        If the settings say so, also correct the depth of the Gaussians by the flow (`depth_from_motion`), and start the
        training at `time_s` from the scene moved by the flow (`start_from_motion`).
        """
        before, before_s = self._camera, self.newest_s
        self._camera, self.newest_s = camera, time_s
        last, last_interval_s, self._motion = self._usable_motion(), self._interval_s, None
        flow = self._image_motion.follow(frame.image, frame.tissue)
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
            held = motion_of(step).deltas(before_s)
            points = step.gaussians.means + held[:, POSITION]
            ahead = self._motion.ahead(points)
            if last is not None and learns:
                self._damping.learn(last.arrived(points) / last_interval_s, ahead / self._interval_s)
            if self._starts_there:
                # Replace the field's extrapolation at `time_s` by the state at `before_s` moved by the flow.
                held[:, POSITION] += ahead
                motion_of(step).move_to(time_s, held)

    def velocity(self, step: TrainingStep, deltas: Tensor | None = None) -> Tensor | None:
        """Return the velocity of the raw parameters [N, 16], per second, that continues the last motion, damped; None without
        a usable motion.

        Args:
            step: training of the scene.
            deltas: offsets of the raw parameters at the newest frame; None to evaluate the field.
        """
        motion = self._usable_motion()
        if motion is None:
            return None
        with torch.no_grad():
            deltas = motion_of(step).deltas(self.newest_s) if deltas is None else deltas
            moved = motion.arrived(step.gaussians.means + deltas[:, POSITION])
            velocity = moved.new_zeros(moved.shape[0], RAW_COLUMNS)
            velocity[:, POSITION] = self._damping.damped(moved)
            velocity[:, LOG_SCALE] = widened(step.gaussians.log_scales + deltas[:, LOG_SCALE], moved)
        return velocity / self._interval_s

    def _take(self, frame: Frame, flow: Flow | None, device: torch.device) -> None:
        """Update further state of a subclass from a frame. `flow` is the motion from the previous picture, or None if
        unknown.
        """

    def _usable_motion(self) -> SurfaceMotion | None:
        """Return the motion between the last two frames; None if it was a jump, or took more than `LONGEST_GAP_S`."""
        return self._motion if 0 < self._interval_s <= LONGEST_GAP_S and not self._is_sudden else None

    def _judge(self, moved_px: float) -> None:
        """Update the moving average of the median motion in pixels, and mark a far larger newest motion as a jump."""
        usual = moved_px if self._usual_px is None else self._usual_px
        self._is_sudden = moved_px > max(SUDDEN * usual, SUDDEN_PX)
        self._usual_px = usual + USUAL_DECAY * (min(moved_px, SUDDEN * usual) - usual)


def widened(log_scales: Tensor, moved: Tensor) -> Tensor:
    """Return the increase of log-scales [N, 3] that accounts for the uncertainty of the next motion.

    The least-squares prediction of an uncertain picture is its mean, and the mean of a Gaussian over normally
    distributed positions is a wider Gaussian. The standard deviation is proportional to the last motion `moved` [N, 3].
    """
    variance = UNCERTAINTY * moved.square().sum(dim=1, keepdim=True)
    return (0.5 * torch.log1p(variance * torch.exp(-2 * log_scales))).clamp(max=MOST_WIDENED)


def no_prior(config: ReconstructorConfig) -> None:
    """Select no prior; the field's own extrapolation is then used."""


def new_motion_prior(config: ReconstructorConfig, field: DeformationField) -> MotionPrior | None:
    """Create the configured prior; None if the configuration selects none, or for a field without continuation or
    editable motion.

    Raises:
        InvalidSetting: for an unknown name.
    """
    prior: MotionPrior | None = MOTION_PRIORS[config.motion_prior](config)
    has = field.capabilities
    return None if has.continuation is None or has.motion is None else prior


def motion_of(step: TrainingStep) -> EditableMotion:
    """Return the editable motion of a field with a prior, as ensured by `new_motion_prior`."""
    motion = step.capabilities.motion
    assert motion is not None
    return motion


class Following:
    """Queue of trained frames for a stream's motion prior.

    The prior is needed only for frames that are displayed without training. Processing a frame takes the prior longer
    than some training steps. Without `at_once`, the queue therefore keeps the two newest trained frames, and the prior
    processes them only when training skips a frame.
    """

    def __init__(self, config: ReconstructorConfig, *, at_once: bool) -> None:
        self.prior: MotionPrior | None = None
        """Prior of the current scene; None if the settings or the field have none."""
        self._config, self._at_once = config, at_once
        self._waiting: deque[tuple[Frame, Observation]] = deque(maxlen=2)

    def begin(self, field: DeformationField) -> None:
        """Create the prior of a new scene."""
        self.prior = new_motion_prior(self._config, field)

    def restart(self) -> None:
        """Reset the prior for a scene that reuses the memory of the previous one."""
        if self.prior is not None:
            self.prior.forget()

    def forget(self) -> None:
        """Discard the frames of a scene that is left."""
        self._waiting.clear()

    def observe(self, step: TrainingStep, frame: Frame, observation: Observation, *, first: bool) -> None:
        """Give the prior a frame before the model is trained on it. Unless `at_once` is set, only queue the frame for
        `skip`, and ignore the `first` frame of a scene.
        """
        if self._at_once:
            self._deliver(step, frame, observation)
        elif not first:
            self._waiting.append((frame, observation))

    def skip(self, step: TrainingStep) -> None:
        """Give the prior the two newest trained frames. Called when a frame is displayed without training, so that the
        published scene keeps moving.
        """
        if self._at_once:
            return
        if len(self._waiting) == 2 and self.prior is not None:
            self.prior.forget()
            for frame, observation in self._waiting:
                self._deliver(step, frame, observation)
        self._waiting.clear()

    def has_revealed(self, least_px: float) -> bool:
        """Return True if a strip of at least `least_px` pixels was revealed at an edge and the prior moved the scene
        accordingly.
        """
        return self.prior is not None and self._at_once and self.prior.revealed_px >= least_px

    def cover_revealed(self) -> None:
        """Reset the width of the revealed strip after the strip was searched for uncovered tissue."""
        if self.prior is not None:
            self.prior.revealed_px = 0.0

    def _deliver(self, step: TrainingStep, frame: Frame, observation: Observation) -> None:
        if self.prior is not None:
            self.prior.observe(frame, observation.time_s, observation.camera, step)


@contextmanager
def continued(step: TrainingStep, prior: MotionPrior | None, learned_s: float) -> Iterator[None]:
    """Make the field extrapolate with the prior's velocities inside the block, in which a copy is published.

    Training is not affected.

    Args:
        step: training step of the scene.
        prior: motion prior; None to leave the field unchanged.
        learned_s: time of the newest trained frame in seconds, from which the field extrapolates. If the prior has not
            processed this frame, the scene is static after this time.
    """
    continuation = step.capabilities.continuation
    if prior is None or continuation is None:
        yield
        return
    # Set a continuation even without a velocity. Snapshot slots then allocate its tensors at the
    # start and need no other memory later.
    velocity = prior.velocity(step) if prior.newest_s == learned_s else None
    still = step.gaussians.means.new_zeros(0, RAW_COLUMNS)
    continuation.continue_with(still if velocity is None else velocity, learned_s, prior.horizon_s)
    try:
        yield
    finally:
        continuation.stop_continuing()


def newest_state(step: TrainingStep, prior: MotionPrior, learned_s: float) -> tuple[Gaussians, NewestState]:
    """Return a copy of the scene at `learned_s`, the time of the newest trained frame, and a field that continues it with the
    prior's velocity. The field does not contain the past.
    """
    with torch.no_grad():
        deltas = motion_of(step).deltas(learned_s)
        velocity = prior.velocity(step, deltas) if prior.newest_s == learned_s else None
        still = step.gaussians.means.new_zeros(0, RAW_COLUMNS)
        continuation = Continuation(step.gaussians.count, step.gaussians.device)
        continuation.write(still if velocity is None else velocity, learned_s, prior.horizon_s)
        now = displaced(step.gaussians, deltas)
        # The field does not change opacities, so the displaced scene shares them with training and they must be copied.
        right = None if now.right_sh is None else now.right_sh.clone()
        extra = {name: tensor.clone() for name, tensor in now.extra.items()}
        own = replace(now, logit_opacities=now.logit_opacities.clone(), right_sh=right, extra=extra)
        return own, NewestState(learned_s, continuation)
