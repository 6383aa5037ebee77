"""Correction of the scene's geometry by the depth of frames, and the standard errors that remain.

Pictures of one eye hardly constrain distance or motion along the line of sight, so the loss alone would need
thousands of steps. Each visible Gaussian is therefore moved along its ray of the current camera, whose picture does
not change. The first depth places the whole scene, which started on a plane. Later depth by parallax corrects all
times, since it assumes static tissue. Later measured or stereo depth corrects a single time.

Depth may become available after its frame was trained on (`LateDepth`). On a GPU the correction is a CUDA graph,
because a live stream has no time for about a hundred launches.

The error of a model's depth has two parts. The depth of a frame has a standard error of its own. The model differs from that
depth, most of all where tissue moved along the line of sight faster than the model followed. Both are relative to the depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsplat_core.deformation.field import CapturedMotion, EditableMotion
from gsplat_core.depth.maps import possible_depth
from gsplat_core.models import Model
from gsplat_core.ops.frame import STATUS_OVERFLOW, FrameMode, View, render_frame
from gsplat_core.rendering.alpha import (
    CapturedSequence,
    FrameControls,
    FrameStatusCopy,
    GraphMemory,
    capacity_for,
)
from gsplat_core.rendering.surface import COVERED
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthError, Frame
from gsplat_core.scene.gaussians import LOG_SCALE, POSITION, Gaussians
from gsplat_core.training.covering import UNCOVERED_ALPHA
from gsplat_core.training.image_motion import NEAREST, Seen, beside
from gsplat_core.training.initialisation import filled, tissue_depth
from gsplat_core.training.observations import Observation, error_of_depth, known_depth, learned_depth
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import tensor_of

MOST_LATE = 30
"""Largest number of frames that may have followed a frame when its depth arrives late; the depth of an older frame is ignored."""


@dataclass(frozen=True)
class LateDepth:
    """Depth of a frame as tensors on the training device, prepared concurrently with training."""

    believed: Tensor | None
    """Target of the depth loss, float32 [H, W], 0 where not confident; None if the loss ignores this depth source."""
    possible: Tensor | None
    """Depth towards which the scene is moved, float32 [H, W], 0 where unknown; None if unknown everywhere."""
    everywhere: Tensor | None
    """`possible` extrapolated to all pixels, for moving a whole scene to its first depth; None if not yet computed."""

    @staticmethod
    def of(frame: Frame, device: torch.device | str, *, places: bool = False) -> LateDepth:
        """Prepare the depth of a frame. `places` also computes `everywhere`.

        Copies to a GPU are queued on the thread's current stream, which must be the training stream.
        """
        possible = possible_depth(frame)
        is_known = bool(possible.any())
        return LateDepth(
            learned_depth(frame, device),
            known_depth(possible, device) if is_known else None,
            tensor_of(tissue_depth(frame, 1.0), device) if places and is_known else None,
        )

    @staticmethod
    def for_placement(frame: Frame, device: torch.device | str) -> LateDepth:
        """Prepare only `possible`, the depth towards which the scene is moved. For a frame whose depth loss was already
        trained.
        """
        possible = possible_depth(frame)
        return LateDepth(None, known_depth(possible, device) if possible.any() else None, None)

    def added_to(self, seen: Observation, frame: Frame) -> Observation:
        """Return the frame's observation `seen` with its confident depth `believed`, and that depth's error, for the depth
        loss.
        """
        return replace(seen, depth=self.believed, depth_error=error_of_depth(frame))


LARGEST_STEP = 1.4
"""Largest factor by which the depth map of one frame may change a Gaussian's depth, up or down."""
SHARE = 0.5
"""Share of a correction (of log depth) that one frame applies. Several frames are thus averaged."""
CORRECTED_PX = 16
"""Side of the picture blocks whose Gaussians move together, in pixels."""


def smooth_factor(depth: Tensor, shown: Tensor, known: Tensor, pixels: Tensor) -> Tensor:
    """Return factors [N] that move Gaussians a share (`SHARE`) of the way from the shown to the target depth, at most by
    `LARGEST_STEP`. Neighbours get the same factor, because tissue moves smoothly, and different ones would reorder
    Gaussians along the line of sight.

    Args:
        depth: target depth [H, W].
        shown: depth of the scene [H, W].
        known: bool [H, W], where both are known.
        pixels: positions of the Gaussians [N, 2].
    """
    ratio = torch.where(known, depth / shown, 1.0).log()
    smooth = filled(ratio[None], known[None].to(ratio.dtype), CORRECTED_PX)
    height, width = ratio.shape
    grid = torch.stack([2 * pixels[:, 0] / width - 1, 2 * pixels[:, 1] / height - 1], dim=1)
    there = grid_sample(smooth[None], grid[None, None], padding_mode="border", align_corners=False)[0, 0, 0]
    return (SHARE * there).exp().clamp(1 / LARGEST_STEP, LARGEST_STEP)


def move_along_rays_(deltas: Tensor, means: Tensor, factor: Tensor, centre: Tensor) -> None:
    """Change raw field rows so that Gaussians move along their rays and scale with the distance, in place.

    The camera at `centre` sees the same picture as before.

    Args:
        deltas: rows that the field adds.
        means: canonical positions [N, 3].
        factor: factor of the distance from the camera [N].
        centre: camera position [3].
    """
    points = means + deltas[:, POSITION]
    deltas[:, POSITION] += (factor - 1)[:, None] * (points - centre)
    deltas[:, LOG_SCALE] += factor.log()[:, None]


class CapturedCorrection:
    """Depth correction of `Placement` at one time, captured for a scene whose tensors keep their addresses.

    A frame that overflows the tile lists corrects nothing; the lists are enlarged for the next one.
    """

    def __init__(self, rows: Gaussians, motion: CapturedMotion, camera: Camera) -> None:
        """Allocate the buffers for correcting the depths of a scene.

        Args:
            rows: the scene's tensors with all allocated rows.
            motion: motion of the scene.
            camera: camera with the size of every frame.
        """
        device, shape = rows.device, (camera.height_px, camera.width_px)
        self._rows, self._motion, self._tensors, self._camera = rows, motion, motion.motion_tensors(), camera
        self._controls = FrameControls(device, rates=1)
        self._depth = torch.zeros(shape, device=device)
        self._mask = torch.zeros(shape, dtype=torch.uint8, device=device)
        self._status = FrameStatusCopy()
        self._memory = GraphMemory(device)
        self._capacity = capacity_for(4 * rows.count)
        self._captured: CapturedSequence[None] | None = None

    def fits(self, rows: Gaussians, motion: CapturedMotion, camera: Camera) -> bool:
        """Return True if the graph fits these tensors and this size."""
        same_scene = rows is self._rows and motion is self._motion
        same_scene &= all(a is b for a, b in zip(motion.motion_tensors(), self._tensors, strict=True))
        size = self._camera.width_px, self._camera.height_px
        return same_scene and size == (camera.width_px, camera.height_px)

    def __call__(self, observation: Observation, depth: Tensor, shown_s: float) -> None:
        """Queue the correction for an observation.

        Args:
            observation: camera, time and mask of the frame.
            depth: float32 [H, W], 0 = unknown.
            shown_s: time in seconds at which the scene is changed.
        """
        if (needs := self._status.wait()).overflowed:
            self._capacity, self._captured = capacity_for(needs.instances), None
        self._depth.copy_(depth)
        self._mask.copy_(observation.mask)
        time, shown = self._motion.frame_time(observation.time_s), self._motion.frame_time(shown_s)
        self._controls.set(observation.camera, time, [shown])
        with torch.no_grad():
            if self._captured is None:
                self._correct()
                self._captured = CapturedSequence(self._correct, self._depth.device, self._memory, warm_up=False)
            else:
                self._captured.replay()
        self._status.launched(self._depth.device)

    def _correct(self) -> None:
        scene, controls, camera = self._rows, self._controls, self._camera
        deltas_at = self._motion.frame_deltas(scene)
        seen = deltas_at(controls.time)
        view = View(controls.viewmat, controls.intrinsics, camera.width_px, camera.height_px)
        frame = render_frame(scene.left_tensors, seen, view, self._capacity, FrameMode.SHARED)
        self._status.queue(frame.status)
        known = (self._depth > 0) & (self._mask > 0) & (frame.alphas >= UNCOVERED_ALPHA)
        known &= frame.status[STATUS_OVERFLOW] == 0
        # Projected here instead of by `Seen`, which copies the camera from the host and cannot be captured in a CUDA graph.
        rotation, translation = controls.viewmat[:3, :3], controls.viewmat[:3, 3]
        local = ((scene.means + seen[:, POSITION])[:, None, :] * rotation).sum(2) + translation
        focal, middle = controls.intrinsics.diagonal()[:2], controls.intrinsics[:2, 2]
        pixels = local[:, :2] / local[:, 2:].clamp(min=NEAREST) * focal + middle
        factor = smooth_factor(self._depth, frame.image[..., 3], known, pixels)
        factor = torch.where(scene.logit_opacities.isfinite(), factor, 1.0)  # unused rows keep their values
        moved = deltas_at(controls.rates)
        move_along_rays_(moved, scene.means, factor, -(rotation * translation[:, None]).sum(0))
        self._motion.move_to_at(controls.rates, moved)


class Placement:
    """Moves the Gaussians of consecutive scenes to the depth that frames bring.

    The first depth map moves a whole scene to its distance. Later ones move its regions by smaller amounts.
    """

    def __init__(self, *, postpones: bool = False) -> None:
        """Create the corrections of a stream, before its first scene.

        Args:
            postpones: postpone corrections by a frame's own depth to `catch_up`, so that the
                displayed picture does not wait for them.
        """
        self._postpones = postpones
        self._captured: CapturedCorrection | None = None
        self.begin(None)

    def begin(self, first: Frame | None) -> None:
        """Start another scene from the frame `first`; None counts as a frame without depth."""
        self._first = first
        self.is_placed = _has_depth(first)
        """True once the scene started with, or was moved to, the distance of a frame's depth."""
        self._postponed: tuple[Frame, Observation] | None = None

    def catch_up(self, step: TrainingStep) -> None:
        """Move the scene to the newest frame's depth if that correction was postponed."""
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
        """Correct the scene by a frame's depth, if it has any and the field supports it. The field must cover the
        frame's time.

        Args:
            step: training step of the scene.
            frame: frame with depth.
            observation: the same frame as tensors.
            shown_s: time at which motion is corrected, in seconds; None for the frame's own. Later for late depth.
            late: prepared depth of the frame, if any.
        """
        if self._postpones and self.is_placed and shown_s is None:
            self._postponed = frame, observation
            return
        origin = frame.depth_origin
        if frame is self._first or frame.depth is None or origin is None:
            return
        motion = step.capabilities.motion
        if observation.camera.model != "pinhole" or motion is None:
            return
        if self.is_placed and origin.initialises_only:
            return
        # Read depth from the frame, because observations omit depth sources that the loss ignores.
        late = late or LateDepth.for_placement(frame, observation.image.device)
        possible = late.possible
        if possible is None:
            return
        with torch.no_grad():
            if not self.is_placed:
                self.is_placed = _place(step, motion, frame, observation, late)
            elif origin.is_of_still_tissue:
                _correct_all_times(step, motion, observation, possible)
            else:
                self._correct(step, motion, observation, possible, observation.time_s if shown_s is None else shown_s)

    def _correct(
        self, step: TrainingStep, motion: EditableMotion, observation: Observation, depth: Tensor, shown_s: float
    ) -> None:
        """Move the scene at `shown_s` towards a frame's depth [H, W] (0 = unknown), on CUDA if possible as a CUDA graph."""
        rows, captured = step.fixed_rows, step.capabilities.captured_motion
        if rows is None or rows.device.type != "cuda" or captured is None or not step.is_trained_by_alpha:
            _correct_at(step, motion, observation, depth, shown_s)
            return
        if self._captured is None or not self._captured.fits(rows, captured, observation.camera):
            self._captured = CapturedCorrection(rows, captured, observation.camera)
        self._captured(observation, depth, shown_s)


def _place(step: TrainingStep, motion: EditableMotion, frame: Frame, observation: Observation, late: LateDepth) -> bool:
    """Move the whole scene to the distance of its first depth. Returns False if the depth covers none of the scene."""
    assert late.possible is not None
    seen = _shown_now(step, motion, observation)
    inside, now, there = seen.inside[:, 0], seen.depth[:, 0], seen.read(late.possible)
    known = inside & (there > 0)
    if not bool(known.any()):
        return False
    # Gaussians without depth take the factor of their neighbours. Those outside the picture take the median factor.
    everywhere = late.everywhere
    if everywhere is None:
        everywhere = tensor_of(tissue_depth(frame, float(now.median())), now.device)
    factor = seen.read(everywhere) / now
    factor = torch.where(inside, factor, factor[known].median())
    step.scale_about(observation.camera, factor)
    step.take_distance(observation.camera)
    return True


def _correct_all_times(step: TrainingStep, motion: EditableMotion, observation: Observation, possible: Tensor) -> None:
    """Move the Gaussians inside the picture towards a frame's depth, whose source assumes static tissue.

    A Gaussian's distance from the camera changes by the same factor at all times. One frame applies `SHARE` of the
    correction of the log depth. Gaussians where the depth is unknown are not moved.

    Args:
        step: training step; the means and scales of its Gaussians are changed in place.
        motion: motion of the field; it gives the depths at the observation's time, and is scaled in place.
        observation: the frame's observation, of which only camera and time are used.
        possible: depth towards which the Gaussians are moved, float32 [H, W]; 0 = unknown.
    """
    seen = _shown_now(step, motion, observation)
    now, there = seen.depth[:, 0], seen.read(possible)
    target = torch.where(seen.inside[:, 0] & (there > 0), there, now)
    factor = (target / now).pow(SHARE).clamp(1 / LARGEST_STEP, LARGEST_STEP)
    step.scale_about(observation.camera, factor)


def _shown_now(step: TrainingStep, motion: EditableMotion, observation: Observation) -> Seen:
    points = step.gaussians.means + motion.deltas(observation.time_s)[:, POSITION]
    return Seen(observation.camera, points)


def _correct_at(
    step: TrainingStep, motion: EditableMotion, observation: Observation, depth: Tensor, shown_s: float
) -> None:
    """Apply the correction of `CapturedCorrection` with separate launches, on any device."""
    camera = observation.camera
    now = step.at(observation.time_s)
    shown = step.picture(now, camera)
    known = (depth > 0) & (observation.mask > 0) & (shown.alpha >= UNCOVERED_ALPHA)
    factor = smooth_factor(depth, shown.depth, known, Seen(camera, now.means).pixels)
    deltas = motion.deltas(shown_s)
    move_along_rays_(deltas, step.gaussians.means, factor, beside(now.means, camera.position))
    motion.move_to(shown_s, deltas)


def _has_depth(frame: Frame | None) -> bool:
    return frame is not None and bool(np.any(possible_depth(frame)))


MOST_TIMES = 8
"""Largest number of frames with whose depth maps a model's depth is compared to estimate its error."""
STEP_PX = 4
"""Distance in pixels between neighbouring pixels whose depth is compared."""
FEWEST_PIXELS = 50
"""Smallest number of compared pixels with which the depth error of a frame is estimated."""
WITHIN_ONE = 0.683
"""Share of the values of a normal distribution within one standard deviation."""


def depth_errors(model: Model, observations: Sequence[Observation]) -> tuple[DepthError, ...]:
    """Return the model's standard errors, relative to the depth, at times of frames with depth, in temporal order.

    A frame with fewer than `FEWEST_PIXELS` compared pixels has none.

    Args:
        model: the trained model.
        observations: frames that it was trained on. At most `MOST_TIMES` of them are used, evenly spread.
    """
    start_s, end_s = model.time_window_s
    known = [each for each in observations if each.depth is not None and start_s <= each.time_s <= end_s]
    chosen = np.unique(np.linspace(0, len(known) - 1, min(MOST_TIMES, len(known))).round().astype(int))
    found = (_error_at(model, known[index]) for index in chosen.tolist())
    return tuple(each for each in found if each is not None)


def _error_at(model: Model, seen: Observation) -> DepthError | None:
    assert seen.depth is not None
    with torch.no_grad():
        surface = model.surface(seen.time_s, seen.camera)
    parts = (seen.depth, seen.mask, surface.ray_depth, surface.alpha)
    depth, mask, shown, alpha = (each[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX] for each in parts)
    there = (depth > 0) & (mask > 0) & (alpha >= COVERED) & (shown > 0)
    off = (shown[there] / depth[there] - 1).abs().cpu().numpy()
    if len(off) < FEWEST_PIXELS:
        return None
    relative = math.hypot(seen.depth_error, float(np.quantile(off, WITHIN_ONE)))
    return DepthError(seen.time_s, min(relative, 1.0))
