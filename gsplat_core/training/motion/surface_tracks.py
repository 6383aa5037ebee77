"""Trajectories of Gaussians over a recording, estimated before training.

Optical flow tracks each surface point from frame to frame. Frames with depth give the distance at its position, because
one eye's pictures hardly show motion along the line of sight, and the loss alone would leave each Gaussian near its
initial distance. Without depth the points move across the picture only. Training from static Gaussians would explain
large motion by changing colours, which are wrong between the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.depth.maps import possible_depth
from gsplat_core.depth.plane_fits import filled_depth
from gsplat_core.machine import usable_cores
from gsplat_core.ops.surface_motion import surface_path
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.motion.image_motion import SMALLEST_PX, Flow, ImageMotion, Seen, SurfaceMotion, beside
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import tensor_of

EDGE_PX = 1
"""Margin in pixels around tools and holes where depth is not read, since tracked positions are inaccurate."""
POSITIONS_AT_ONCE = 1 << 22
"""Number of positions of trajectories that are computed at once, to limit memory."""
FEWEST_ROWS = 64
"""Smallest number of trajectories computed at once, for very long recordings."""


class SurfaceTracks:
    """Trajectories of surface points through the frames of a recording, if pictures show the motion."""

    def __init__(
        self,
        frames: Sequence[Frame],
        observations: Sequence[Observation],
        at_rest: bool = False,
    ) -> None:
        """Prepare the trajectories.

        Args:
            frames: all frames.
            observations: the same frames as tensors.
            at_rest: True if depth was estimated for static tissue (`RecordingDepth.at_rest`).
        """
        self._at_rest = at_rest
        self._frames, self._seen = frames, observations
        self._device = observations[0].image.device
        self._times = observations[0].image.new_tensor([one.time_s for one in observations], dtype=torch.float32)

    def apply(self, step: TrainingStep, number: int, first_row: int) -> None:
        """Set the trajectories of the Gaussians from `first_row` on, which are on the surface shown by frame `number`.
        Nothing changes if the field does not support it or the pictures have no optical flow.
        """
        follow = step.capabilities.follow
        if follow is None or not self._show_motion:
            return
        times = [one.time_s for one in self._seen]
        with torch.no_grad():
            at_once = max(FEWEST_ROWS, POSITIONS_AT_ONCE // len(times))
            for start in range(first_row, step.gaussians.count, at_once):
                rows = slice(start, min(start + at_once, step.gaussians.count))
                points = step.gaussians.means[rows]
                follow(rows, times, self.trajectories(points, number) - points[:, None])

    def trajectories(self, points: Tensor, number: int) -> Tensor:
        """Return the positions in every frame [N, T, 3] of points [N, 3] on the surface shown by frame `number`."""
        if self._at_rest or not self._have_depth:
            return self._across(points, number)
        pixels = self._pixels(points, number)
        nothing = points.new_zeros(len(points))
        read = [
            (nothing, nothing) if depth is None else depth.at(here)
            for depth, here in zip(self._depths, pixels, strict=True)
        ]
        smooth, relief = (torch.stack(each, dim=1) for each in zip(*read, strict=True))
        # Interpolate the ratio to the surrounding surface while a tool hides a point.
        depth = smooth * between_known(relief, torch.ones_like(relief), self._times)
        depth = 1 / steady_course(1 / between_known(depth, depth, self._times), self._times)
        return torch.stack([_world(pixels[k], depth[:, k], one) for k, one in enumerate(self._seen)], dim=1)

    def _across(self, points: Tensor, number: int) -> Tensor:
        """Return trajectories with motion across the picture only. Depth differences of static tissue are errors. They
        would move points in front of other points.
        """
        cameras = [one.camera for one in self._seen]
        after = _path(points, self._flows_ahead[number:], cameras[number:])
        before = _path(points, self._flows_back[:number].flip(0), cameras[number::-1])
        return torch.cat([before.flip(1), points[:, None], after], dim=1)

    @cached_property
    def _show_motion(self) -> bool:
        """True if the camera is a pinhole, and pictures are large enough for flow."""
        sizes = {frame.image.shape[:2] for frame in self._frames}
        pinhole = all(one.camera.model == "pinhole" for one in self._seen)
        return pinhole and len(self._frames) > 1 and len(sizes) == 1 and min(min(sizes)) >= SMALLEST_PX

    @cached_property
    def _have_depth(self) -> bool:
        """True if at least half of the frames have depth that shows motion."""
        return 2 * sum(depth is not None for depth in self._depths) >= len(self._frames)

    @cached_property
    def _depths(self) -> list[SurfaceDepth | None]:
        """Depth of each frame; None if it is not confident or its scale varies, so that the loss ignores it."""
        return [
            None if one.depth is None or not one.depth.any() else SurfaceDepth.of(possible_depth(frame), self._device)
            for frame, one in zip(self._frames, self._seen, strict=True)
        ]

    @cached_property
    def _flows_ahead(self) -> Tensor:
        """Flow from each frame to the next one, [T - 1, h, w, 2]."""
        return self._stacked(_flows(list(pairwise(self._frames))))

    @cached_property
    def _flows_back(self) -> Tensor:
        """Flow from each frame except the first to the previous frame, [T - 1, h, w, 2]."""
        return self._stacked(_flows([(after, before) for before, after in pairwise(self._frames)]))

    def _stacked(self, flows: Sequence[Flow]) -> Tensor:
        return tensor_of(np.stack(flows), self._device)

    def _pixels(self, points: Tensor, number: int) -> list[Tensor]:
        """Return the points' positions in each frame: T times [N, 2]."""
        here = Seen(self._seen[number].camera, points).pixels
        after, before = [here], [here]
        cameras = [one.camera for one in self._seen]
        for flow, camera in zip(self._flows_ahead[number:], cameras[number:], strict=False):
            after.append(after[-1] + SurfaceMotion(flow, camera, camera).at(after[-1]))
        for flow, camera in zip(self._flows_back[:number].flip(0), cameras[number:0:-1], strict=True):
            before.append(before[-1] + SurfaceMotion(flow, camera, camera).at(before[-1]))
        return before[:0:-1] + after


@dataclass(frozen=True)
class SurfaceDepth:
    """Depth of one frame, prepared for sampling at tracked points."""

    planes: Tensor
    """Planes [3, H, W]: depth away from edges, 0 elsewhere; validity of it; surface extrapolated everywhere."""

    @staticmethod
    def of(depth: NDArray[np.float32], device: torch.device) -> SurfaceDepth | None:
        """Prepare tissue depth [H, W], 0 where unknown. Returns None if it is unknown everywhere."""
        known = np.isfinite(depth) & (depth > 0)
        if not known.any():
            return None
        side = 2 * EDGE_PX + 1
        inner = cv2.erode(known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        planes = np.stack([np.where(inner, depth, 0), inner, filled_depth(depth, known)]).astype(np.float32)
        return SurfaceDepth(tensor_of(planes, device))

    def at(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Sample at pixels [N, 2] bilinearly. Returns the smooth depth [N], and the ratio of the
        depth to it [N], 0 where unknown.
        """
        size = beside(pixels, [self.planes.shape[2], self.planes.shape[1]])
        grid = (2 * pixels / size - 1)[None, None]
        found, known, smooth = torch.nn.functional.grid_sample(
            self.planes[None], grid, padding_mode="border", align_corners=False
        )[0, :, 0]
        return smooth, torch.where(known > 1 - 1e-3, found / smooth, 0.0)


def between_known(values: Tensor, otherwise: Tensor, times: Tensor) -> Tensor:
    """Interpolate unknown values linearly in time.

    Args:
        values: [N, T], 0 where unknown. Values before the first and after the last known one are constant.
        otherwise: [N, T], used for rows without any known value.
        times: [T].
    """
    known = values > 0
    index = torch.arange(values.shape[1], device=values.device).expand_as(values)
    last = torch.where(known, index, -1).cummax(dim=1).values
    following = torch.where(known, index, values.shape[1]).flip(1).cummin(dim=1).values.flip(1)
    has_last, has_next = last >= 0, following < values.shape[1]
    last, following = last.clamp(min=0), following.clamp(max=values.shape[1] - 1)
    last, following = torch.where(has_last, last, following), torch.where(has_next, following, last)
    a, b = values.gather(1, last), values.gather(1, following)
    span = times[following] - times[last]
    share = torch.where(span > 0, (times - times[last]) / span.clamp(min=1e-9), torch.zeros_like(span))
    return torch.where(known.any(dim=1, keepdim=True), a + share * (b - a), otherwise)


def steady_course(values: Tensor, times: Tensor) -> Tensor:
    """Shrink each row of `values` [N, T] towards its median by the share of its variation over
    `times` [T] that noise explains.

    Noise is estimated from deviations of values from the line between their temporal neighbours, as
    in `steadiness`; the share is that of a Wiener filter. With fewer than three values the result
    is the median. Results stay within the range of their row.
    """
    middle = values.median(dim=1, keepdim=True).values
    if values.shape[1] < 3:
        return middle.expand_as(values)
    span = times[2:] - times[:-2]
    share = torch.where(span > 0, (times[1:-1] - times[:-2]) / span.clamp(min=1e-9), 0.5)
    off = values[:, 1:-1] - torch.lerp(values[:, :-2], values[:, 2:], share)
    # The variances of a value and of the interpolation between its two temporal neighbours add up.
    noise = (off.square() / (1 + share.square() + (1 - share).square())).mean(dim=1, keepdim=True)
    found = (values - middle).square().mean(dim=1, keepdim=True)
    return middle + (1 - noise / found.clamp(min=torch.finfo(found.dtype).tiny)).clamp(0, 1) * (values - middle)


def _path(points: Tensor, flows: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return the positions [N, T, 3] of points [N, 3] after each of the flows [T, h, w, 2] between the cameras' frames."""
    if points.dtype == torch.float32:
        return surface_path(points, flows, cameras)
    positions = [points]
    for flow, (before, after) in zip(flows, pairwise(cameras), strict=True):
        positions.append(positions[-1] + SurfaceMotion(flow.to(points), before, after).ahead(positions[-1]))
    return torch.stack(positions[1:], dim=1) if len(positions) > 1 else points.new_empty(len(points), 0, 3)


def _flows(pairs: Sequence[tuple[Frame, Frame]]) -> list[Flow]:
    """Return the flow from the first to the second frame of each pair."""
    with ThreadPoolExecutor(usable_cores(), thread_name_prefix="flow") as pool:
        return list(pool.map(_flow, pairs))


def _flow(pair: tuple[Frame, Frame]) -> Flow:
    motion = ImageMotion()
    for frame in pair:
        flow = motion.follow(frame.image, frame.tissue)
    assert flow is not None  # pictures of one size, large enough
    return flow


def _world(pixels: Tensor, depth: Tensor, one: Observation) -> Tensor:
    """Return the points [N, 3] that a frame's camera sees at pixels [N, 2] and depth [N]."""
    view, intrinsics = one.camera.matrices(pixels.device, pixels.dtype)
    slopes = (pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    local = torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1) * depth[:, None]
    return (local - view[:3, 3]) @ view[:3, :3]
