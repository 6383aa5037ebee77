"""Difference between the rendered flow and the optical flow of the pictures."""

from __future__ import annotations

from collections import OrderedDict
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.flow import nearest_splats, render_flow
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.motion.image_motion import SMALL_PIXELS, consistent_flow
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy, tensor_of

SMOOTH_PX = 0.1
"""Error in pixels below which the loss is quadratic."""
KEPT_PAIRS = 256
"""Number of frame pairs whose flow is kept."""
SEARCH_EVERY = 200
"""Number of comparisons after which the nearest splats are searched again."""


class FlowLoss:
    """Mean distance in pixels between rendered and observed flow, over pixels with reliable flow.

    The observed flow is DIS flow from the preceding or following frame to the observation, by turns. Where forward and
    backward flow disagree, where a tool is, and where nothing is rendered, nothing is compared. The scene at the other
    frame's time is constant, so the loss moves the Gaussians at the observation's time. Pictures of more than
    `SMALL_PIXELS` pixels are compared at half size.
    """

    name: ClassVar[str] = "flow"
    default_weight: ClassVar[float] = 0.05

    def __init__(self) -> None:
        self._flows: OrderedDict[tuple[int, int], Tensor] = OrderedDict()
        """Flow [h, w, 2] by the numbers of both frames; NaN where unreliable."""
        self._neighbours = torch.empty(0, 0, dtype=torch.int64)
        self._calls = 0

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean flow error between the observation and the frame before or after it; None without a pair, and
        for a right eye.
        Raises InvalidSetting for a camera other than a pinhole.
        """
        if observation.camera.model != "pinhole":
            raise InvalidSetting(
                f"the loss 'flow' is for pinhole cameras, this one is {observation.camera.model}; remove it from the losses"
            )
        other = None if observation.of_right else self._other(observation, context)
        if other is None:
            return None
        turn, self._calls = self._calls, self._calls + 1
        target = self._flow(other, observation)
        before, after = (_compared_size(each.camera) for each in (other, observation))
        first = context.at(other.time_s)
        if len(self._neighbours) != scene.count or turn % SEARCH_EVERY == 0:
            self._neighbours = nearest_splats(first)
        rendered = render_flow(first, scene, before, after, neighbours=self._neighbours)
        known = target[..., 0].isfinite() & rendered.observed  # both components are NaN where flow is unreliable
        off = torch.where(known[..., None], rendered.flow - target, 0)
        lengths = (off.square().sum(-1) + SMOOTH_PX**2).sqrt() - SMOOTH_PX
        return lengths.sum() / known.sum().clamp(min=1)

    def _other(self, observation: Observation, context: LossContext) -> Observation | None:
        """Return the preceding or the following frame, by turns; the only one at an end of the window. None without such
        a frame of the same size.
        """
        left = [one for one in context.frames if not one.of_right]
        index = next((k for k, one in enumerate(left) if one.seq == observation.seq), None)
        if index is None:
            return None
        nearest = [left[k] for k in (index - 1, index + 1) if 0 <= k < len(left)]
        nearest = [one for one in nearest if one.image.shape == observation.image.shape]
        return nearest[self._calls % len(nearest)] if nearest else None

    def _flow(self, first: Observation, second: Observation) -> Tensor:
        """Return the observed flow between two frames at the compared size."""
        key = first.seq, second.seq
        known = self._flows.get(key)
        if known is None:
            images, masks = (
                [HostCopy(each).numpy() for each in pair] for pair in zip(*map(_picture, (first, second)), strict=True)
            )
            flow = consistent_flow(*images, *masks)
            size = _compared_size(first.camera)
            if (size.height_px, size.width_px) != flow.shape[:2]:
                # Take the nearest value, because a mean that includes an unreliable one would be unreliable.
                rows, columns = (np.arange(n) * 2 for n in (size.height_px, size.width_px))
                flow = flow[np.ix_(rows, columns)] * np.float32(size.width_px / first.camera.width_px)
            known = self._flows[key] = tensor_of(np.ascontiguousarray(flow, np.float32), first.image.device)
            if len(self._flows) > KEPT_PAIRS:
                self._flows.popitem(last=False)
        return known


def _picture(observation: Observation) -> tuple[Tensor, Tensor]:
    return observation.image, observation.mask


def _compared_size(camera: Camera) -> Camera:
    """Return the camera at half its size, at which flow is compared; unchanged if its picture is small."""
    if camera.width_px * camera.height_px <= SMALL_PIXELS:
        return camera
    return camera.resized(camera.width_px // 2, camera.height_px // 2)
