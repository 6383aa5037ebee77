"""Where the surface goes over a recording of which all frames are known and have depth: a trajectory for every Gaussian, before the first step.

Pictures of one eye hardly tell how tissue moves along the line of sight, so that the loss alone would leave each Gaussian about as far away as it was
when it was made. Where its point goes across the picture is followed by optical flow from frame to frame, and how far away it is, is read there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.geometry.depth_fill import filled_depth
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.training.image_motion import SMALLEST_PX, Flow, ImageMotion
from gsplat_core.training.initialisation import possible_depth
from gsplat_core.training.motion_prior import followed
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import Seen, SurfaceMotion, beside
from gsplat_core.transfers import tensor_of

OF_ONE_PICTURE = (DepthOrigin.LIGHT, DepthOrigin.LEARNED)
"""Depth whose differences from frame to frame are no motion: it is right up to a factor that no two frames need to share. Depth by light is more where the
tissue was followed (`light_of_recording`)."""
EDGE_PX = 1
"""Beside a tool or a hole depth is not read: a point that is followed is not exact to the pixel."""
ROWS_AT_ONCE = 1 << 14
"""Bounds the memory for trajectories: Gaussians times frames."""


class SurfaceTracks:
    """The motion of the surface that the frames of a recording show; nothing where they do not show it."""

    def __init__(
        self,
        frames: Sequence[Frame],
        observations: Sequence[Observation],
        at_rest: bool = False,
        light_shows_motion: bool = False,
    ) -> None:
        """As many of both. at_rest: the frames' depth is that of tissue that stands still, see `WithParallax`. light_shows_motion: depth by light was
        found by following the tissue through all frames."""
        self._at_rest, self._followed = at_rest, (DepthOrigin.LIGHT,) if light_shows_motion else ()
        self._frames, self._seen = frames, observations
        self._device = observations[0].image.device
        self._times = observations[0].image.new_tensor([one.time_s for one in observations], dtype=torch.float32)

    def apply(self, step: TrainingStep, number: int, first_row: int) -> None:
        """Let the Gaussians from `first_row` on, which are where frame `number` shows the surface, follow it at all times. Nothing changes where
        the field does not take positions, or the frames do not show the motion."""
        if not step.field.takes_positions or not self._show_motion:
            return
        times = [one.time_s for one in self._seen]
        with torch.no_grad():
            for start in range(first_row, step.gaussians.count, ROWS_AT_ONCE):
                rows = slice(start, min(start + ROWS_AT_ONCE, step.gaussians.count))
                points = step.gaussians.means[rows]
                step.field.follow(rows, times, self.trajectories(points, number) - points[:, None])

    def trajectories(self, points: Tensor, number: int) -> Tensor:
        """Where `points` [N, 3] of the surface that frame `number` shows are in every frame [N, T, 3]."""
        if self._at_rest:
            return self._across(points, number)
        pixels = self._pixels(points, number)
        nothing = points.new_zeros(len(points))
        read = [
            (nothing, nothing) if depth is None else depth.at(here)
            for depth, here in zip(self._depths, pixels, strict=True)
        ]
        smooth, relief = (torch.stack(each, dim=1) for each in zip(*read, strict=True))
        # What a tool hides for a while stands out from what is around it as it did before and does afterwards.
        depth = smooth * between_known(relief, torch.ones_like(relief), self._times)
        depth = 1 / steady_course(1 / between_known(depth, depth, self._times), self._times)
        return torch.stack([_world(pixels[k], depth[:, k], one) for k, one in enumerate(self._seen)], dim=1)

    def _across(self, points: Tensor, number: int) -> Tensor:
        """As `trajectories`, with motion across each picture alone: depths of tissue at rest differ from frame to frame by what is uncertain, and a
        point that came nearer by that would stand before all others."""
        after, before = [points], [points]
        for motion in self._ahead[number:]:
            after.append(after[-1] + motion.ahead(after[-1]))
        for motion in self._back[:number][::-1]:
            before.append(before[-1] + motion.ahead(before[-1]))
        return torch.stack(before[:0:-1] + after, dim=1)

    @cached_property
    def _show_motion(self) -> bool:
        """Whether half of the frames at least have depth whose differences are motion, a pinhole camera saw them, and flow can be found in
        pictures of their size."""
        sizes = {frame.image.shape[:2] for frame in self._frames}
        pinhole = all(one.camera.model == "pinhole" for one in self._seen)
        if not pinhole or len(self._frames) < 2 or len(sizes) > 1 or min(min(sizes)) < SMALLEST_PX:
            return False
        return 2 * sum(depth is not None for depth in self._depths) >= len(self._frames)

    @cached_property
    def _depths(self) -> list[SurfaceDepth | None]:
        """Of each frame; None where nothing is believed, or it shows no motion."""
        return [
            None if not self._shows_surface(frame, one) else SurfaceDepth.of(possible_depth(frame), self._device)
            for frame, one in zip(self._frames, self._seen, strict=True)
        ]

    def _shows_surface(self, frame: Frame, one: Observation) -> bool:
        if frame.depth_origin in self._followed:  # the loss does not see it, so that it is in no observation
            return frame.depth is not None and bool(frame.depth.any())
        return frame.depth_origin not in OF_ONE_PICTURE and one.depth is not None and bool(one.depth.any())

    @cached_property
    def _ahead(self) -> list[SurfaceMotion]:
        """From each frame to the next."""
        return self._motions(_flows(self._frames), self._seen)

    @cached_property
    def _back(self) -> list[SurfaceMotion]:
        """From each frame but the first to the one before."""
        return self._motions(_flows(self._frames[::-1]), self._seen[::-1])[::-1]

    def _motions(self, flows: Sequence[Flow], seen: Sequence[Observation]) -> list[SurfaceMotion]:
        return [
            SurfaceMotion(tensor_of(flow, self._device), one.camera, following.camera)
            for flow, (one, following) in zip(flows, pairwise(seen), strict=True)
        ]

    def _pixels(self, points: Tensor, number: int) -> list[Tensor]:
        """Where each frame shows the points: T times [N, 2]."""
        here = Seen(self._seen[number].camera, points).pixels
        after, before = [here], [here]
        for motion in self._ahead[number:]:
            after.append(after[-1] + motion.at(after[-1]))
        for motion in self._back[:number][::-1]:
            before.append(before[-1] + motion.at(before[-1]))
        return before[:0:-1] + after


@dataclass(frozen=True)
class SurfaceDepth:
    """One frame's depth, read at points that are followed."""

    planes: Tensor
    """[3, H, W]: depth where tissue and depth are known and nothing else is near, 0 elsewhere; whether that is so; the surface continued smoothly
    everywhere."""

    @staticmethod
    def of(depth: NDArray[np.float32], device: torch.device) -> SurfaceDepth | None:
        """depth: of tissue [H, W], 0 where it is not known. None where nothing is known."""
        known = np.isfinite(depth) & (depth > 0)
        if not known.any():
            return None
        side = 2 * EDGE_PX + 1
        inner = cv2.erode(known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        planes = np.stack([np.where(inner, depth, 0), inner, filled_depth(depth, known)]).astype(np.float32)
        return SurfaceDepth(tensor_of(planes, device))

    def at(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """At pixels [N, 2], bilinear: the smooth depth [N], and the share of it that the depth itself is [N], 0 where that is not known."""
        size = beside(pixels, [self.planes.shape[2], self.planes.shape[1]])
        grid = (2 * pixels / size - 1)[None, None]
        found, known, smooth = torch.nn.functional.grid_sample(
            self.planes[None], grid, padding_mode="border", align_corners=False
        )[0, :, 0]
        return smooth, torch.where(known > 1 - 1e-3, found / smooth, 0.0)


def between_known(values: Tensor, otherwise: Tensor, times: Tensor) -> Tensor:
    """`values` [N, T], of which 0 are not known, with these on the straight line in time [T] between the known ones before and after, at either end
    like the nearest one, and in a row without any as in `otherwise` [N, T]."""
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
    """Return each row of `values` [N, T] with the share of its changes over `times` [T] that noise does not explain; the rest stays at the row's median.

    The noise is what a value differs by from the line between its two neighbours in time, as in `steadiness`. The share is that of a Wiener filter. Two
    values or fewer are no evidence of motion. No result lies outside of the range of its row.
    """
    middle = values.median(dim=1, keepdim=True).values
    if values.shape[1] < 3:
        return middle.expand_as(values)
    span = times[2:] - times[:-2]
    share = torch.where(span > 0, (times[1:-1] - times[:-2]) / span.clamp(min=1e-9), 0.5)
    off = values[:, 1:-1] - torch.lerp(values[:, :-2], values[:, 2:], share)
    # The variance of a value and that of the line between two others add up.
    noise = (off.square() / (1 + share.square() + (1 - share).square())).mean(dim=1, keepdim=True)
    found = (values - middle).square().mean(dim=1, keepdim=True)
    return middle + (1 - noise / found.clamp(min=torch.finfo(found.dtype).tiny)).clamp(0, 1) * (values - middle)


def _flows(frames: Sequence[Frame]) -> list[Flow]:
    """From each frame to the next."""
    motion = ImageMotion()
    flows = [motion.follow(frame.image, followed(frame)) for frame in frames]
    return [flow for flow in flows[1:] if flow is not None]


def _world(pixels: Tensor, depth: Tensor, one: Observation) -> Tensor:
    """The points [N, 3] that a frame's camera sees at pixels [N, 2] in depth [N]."""
    view, intrinsics = one.camera.matrices(pixels.device, pixels.dtype)
    slopes = (pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    local = torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1) * depth[:, None]
    return (local - view[:3, 3]) @ view[:3, :3]
