"""Preparation of depth for offline training, mainly for recordings with a moving camera.

Without depth a scene starts on a plane. A plane at the wrong distance turns camera motion into
apparent tissue motion, which must be learned separately for every time and does not interpolate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsplat_core.depth.maps import UNCONFIRMED, DepthMap, Look, agree
from gsplat_core.depth.moving_tissue import MovingTissue
from gsplat_core.depth.multiview import CONTRADICTED, DEFORMS, depth_of_view, view_of
from gsplat_core.depth.registry import with_surface
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.offline import observed

MOST_KEY_FRAMES = 32
"""Number of frames that get depth, spread evenly over the recording."""
WINDOW_S = 3.0
"""Largest time difference in seconds of compared frames, limited because tissue deforms."""
MOVES = 0.5
"""Share of key frames that contradict static tissue from which a moving-tissue model is tried."""
MOST_PIXELS = 64_000_000
"""Largest total number of pixels of frames with depth. Each takes 12 bytes here and again in the
observations.
"""


class WithParallax(NamedTuple):
    """Frames of a moving camera with estimated depth."""

    frames: list[Frame]
    """Frames; key frames have depth in the unit of the camera positions."""
    doubts: Mapping[str, int]
    """Reasons why other key frames have none, as sentences with numbers of frames."""
    at_rest: bool = False
    """True if depth was estimated for static tissue; differences between frames are then errors,
    not motion.
    """


def frames_with_parallax(frames: Sequence[Frame], cameras: Sequence[Camera]) -> WithParallax:
    """Estimate depth by parallax for key frames of a recording. Frames are unchanged if they have
    depth already or no camera moves.
    """
    moves = any(not np.array_equal(camera.world_to_camera, cameras[0].world_to_camera) for camera in cameras)
    if not moves or cameras[0].model != "pinhole" or any(frame.depth is not None for frame in frames):
        return WithParallax(list(frames), {})
    given, doubts = _compared(frames, cameras)
    contradicted = sum(doubts[each] for each in (DEFORMS, CONTRADICTED))
    if contradicted < MOVES * min(MOST_KEY_FRAMES, len(frames)):
        return _confirmed(given, cameras, doubts)
    tissue = MovingTissue(frames, cameras)
    count = min(len(frames), max(1, MOST_PIXELS // frames[0].image[..., 0].size))
    breathing, uncertain = list(frames), Counter[str]()
    for number in np.linspace(0, len(frames) - 1, count).round().astype(int).tolist():
        found = tissue.depth_of(number)
        if found.doubt is not None:
            uncertain[found.doubt] += 1
        else:
            breathing[number] = _with(frames[number], found)
    # If no motion is found, a rough depth on which frames agree is a better start than none.
    if uncertain.total() == count:
        return _confirmed(given, cameras, doubts)
    return WithParallax(breathing, uncertain)


def _confirmed(frames: list[Frame], cameras: Sequence[Camera], doubts: Counter[str]) -> WithParallax:
    """Keep the depth of all frames if most are confirmed by a neighbour, else of none.

    One decision is made for the whole recording, because frames with and without depth would start
    at different distances. `depth_agreement` compares two depth maps. Reasons are added to
    `doubts`.
    """
    numbers = [number for number, frame in enumerate(frames) if frame.depth is not None]
    looks = [
        Look.of(depth, frames[number].depth_confidence, cameras[number])
        for number in numbers
        if (depth := frames[number].depth) is not None
    ]
    confirmed: set[int] = set()
    for (one, first), (other, second) in pairwise(zip(numbers, looks, strict=True)):
        if agree(first, second):
            confirmed |= {one, other}
    if 2 * len(confirmed) < len(numbers):
        for number in numbers:
            frames[number] = frames[number].with_fields(depth=None, depth_confidence=None, depth_origin=None)
            doubts[UNCONFIRMED] += 1
    return WithParallax(frames, doubts, at_rest=True)


def _compared(frames: Sequence[Frame], cameras: Sequence[Camera]) -> tuple[list[Frame], Counter[str]]:
    """Estimate depth for key frames assuming static tissue. Returns all frames and the reasons for
    rejected depth.
    """
    given, doubts = list(frames), Counter[str]()
    views = [view_of(frame, camera) for frame, camera in zip(frames, cameras, strict=True)]
    count = min(MOST_KEY_FRAMES, len(frames))
    for number in np.linspace(0, len(frames) - 1, count).round().astype(int).tolist():
        frame = frames[number]
        near = [
            view for view, other in zip(views, frames, strict=True)
            if other is not frame and abs(other.time_s - frame.time_s) <= WINDOW_S
        ]  # fmt: skip
        found = depth_of_view(views[number], near, frame.image.shape[:2])
        if found.doubt is not None:
            doubts[found.doubt] += 1
            continue
        if not np.any(found.believed):
            doubts[DEFORMS] += 1
        given[number] = _with(frame, found)
    return given, doubts


def _with(frame: Frame, found: DepthMap) -> Frame:
    return frame.with_fields(depth=found.depth, depth_confidence=found.confidence, depth_origin=found.origin)


class ToFit(NamedTuple):
    """Input of offline training."""

    frames: list[Frame]
    """Frames from which the scene is created and grown."""
    seen: list[Observation]
    """Observations to train on."""
    doubts: Mapping[str, int]
    """Results of `frames_with_parallax`: reasons for rejected depth, and `at_rest`."""
    at_rest: bool = False


def to_fit(frames: list[Frame], observation_of: Callable[[Frame], Observation], finds_depth: bool) -> ToFit:
    """Prepare frames for offline training; `frames` is modified.

    Stereo depth is replaced by a reconstructed surface. With `finds_depth`, parallax depth is
    estimated if there is no other.

    Raises:
        InvalidInput: if there are no frames, or if they are out of temporal order.
    """
    seen = observed(frames, observation_of)
    cameras = [each.camera for each in seen]
    for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True)):
        surface = with_surface(frame, camera)
        if surface is not frame:
            frames[number], seen[number] = surface, observation_of(surface)
    if not finds_depth:
        return ToFit(frames, seen, {})
    found = frames_with_parallax(frames, cameras)
    # Unconfident depth is an extrapolation: it initialises the scene but is not trained on.
    start = [
        frame if frame is given else frame.with_fields(depth_confidence=None)
        for given, frame in zip(frames, found.frames, strict=True)
    ]
    return ToFit(start, observed(found.frames, observation_of), found.doubts, found.at_rest)
