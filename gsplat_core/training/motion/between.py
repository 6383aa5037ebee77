"""Pictures at the times of missing frames, interpolated from the two neighbouring frames.

A frame is missing if it is withheld, damaged or held out. A model that is fine in time can have any state there. The
interpolated pictures are further targets of offline training, so that the model is at least as good as they are. They
are made from training frames alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.poses.se3 import between
from gsplat_core.training.motion.image_motion import SMALLEST_PX
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy, tensor_of

SHORTEST, LONGEST = 1.5, 2.5
"""Range of an interval with one missing frame, in multiples of the usual interval. Longer ones are not interpolated."""
COMPARED = 12
"""Number of frames, spread over the recording, in which both kinds of interpolation are compared."""
NO_FRAME = -1
"""Frame number of interpolated pictures, which no frame has."""


class _Picture(NamedTuple):
    image: NDArray[np.float32]
    """Colours RGB [H, W, 3], in levels from 0 to 255."""
    tissue: NDArray[np.float32]
    """Weight of tissue [H, W]: 1 on tissue, 0 on tools."""


def between_frames(seen: Sequence[Observation]) -> list[Observation]:
    """Return an interpolated observation for each frame that is missing between two.

    The interpolation is the mean of the neighbours, or their mean after each was moved half-way along the optical flow to
    the other. The kind is the one that predicts the frames between two other training frames better.

    Args:
        seen: training frames in temporal order.
    """
    intervals = [after.time_s - before.time_s for before, after in pairwise(seen)]
    if len(intervals) < 2:
        return []
    usual = median(intervals)
    gaps = [
        pair
        for pair, interval in zip(pairwise(seen), intervals, strict=True)
        if SHORTEST * usual < interval < LONGEST * usual and pair[0].image.shape == pair[1].image.shape
    ]
    if not gaps:
        return []
    flows = _flow_is_better(seen, usual)
    return [_observation(*pair, flows) for pair in gaps]


def _flow_is_better(seen: Sequence[Observation], usual: float) -> bool:
    """Return True if flow predicts training frames from their two neighbours better than the neighbours' mean."""
    inner = [
        number
        for number in range(1, len(seen) - 1)
        if seen[number + 1].time_s - seen[number - 1].time_s < LONGEST * usual
        and len({one.image.shape for one in seen[number - 1 : number + 2]}) == 1
    ]
    errors = np.zeros(2)
    for number in inner[:: max(1, -(-len(inner) // COMPARED))]:
        before, now, after = (_picture_of(one) for one in seen[number - 1 : number + 2])
        for kind in (0, 1):
            shown = _interpolated(before, after, kind == 1)
            tissue = (now.tissue * shown.tissue)[..., None]
            errors[kind] += float((np.square(shown.image - now.image) * tissue).sum())
    return bool(errors[1] < errors[0])


def _observation(before: Observation, after: Observation, flows: bool) -> Observation:
    shown = _interpolated(_picture_of(before), _picture_of(after), flows)
    device = before.image.device
    camera = before.camera
    if after.camera != camera:
        poses = [torch.tensor(one.camera.world_to_camera, dtype=torch.float64) for one in (before, after)]
        camera = camera.with_pose(between(poses[0], poses[1], 0.5).numpy())
    return replace(
        before,
        seq=NO_FRAME,
        time_s=(before.time_s + after.time_s) / 2,
        camera=camera,
        image=tensor_of(np.rint(shown.image).clip(0, 255).astype(np.uint8), device),
        mask=tensor_of((shown.tissue > 1 - 1e-3).astype(np.uint8), device),
        depth=None,
        rehearsal_mask=None,
        right_eye=None,
        labels=None,
        ranges=None,
    )


def _picture_of(one: Observation) -> _Picture:
    image, mask = HostCopy(one.image).numpy(), HostCopy(one.mask).numpy()
    return _Picture(image.astype(np.float32), (mask != 0).astype(np.float32))


def _interpolated(before: _Picture, after: _Picture, flows: bool) -> _Picture:
    """Return the picture half-way between two; its tissue is where both show tissue."""
    if flows and min(before.tissue.shape) >= SMALLEST_PX:
        before, after = _half_way(before, after), _half_way(after, before)
    return _Picture((before.image + after.image) * np.float32(0.5), before.tissue * after.tissue)


def _half_way(one: _Picture, other: _Picture) -> _Picture:
    """Return a picture moved half-way along the optical flow to the other."""
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    greys = [cv2.cvtColor(np.rint(each.image).astype(np.uint8), cv2.COLOR_RGB2GRAY) for each in (one, other)]
    flow = np.asarray(method.calc(*greys, None), np.float32)
    height, width = flow.shape[:2]
    x = np.arange(width, dtype=np.float32) - flow[..., 0] / 2
    y = np.arange(height, dtype=np.float32)[:, None] - flow[..., 1] / 2
    moved = lambda values: np.asarray(
        cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )
    return _Picture(moved(one.image), moved(one.tissue))
