"""Depth for the frames of a recording before training on all of them, most of all where its camera moves.

Without depth a scene starts on a plane. Where the camera moves, a plane at the wrong distance makes the camera's motion look like motion of
the tissue, which has to be learned anew for every time and says nothing about times between.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsplat_core.geometry.depth_agreement import UNCONFIRMED, Look, agree
from gsplat_core.geometry.depth_map import DepthMap
from gsplat_core.geometry.light_of_recording import frames_with_light
from gsplat_core.geometry.matched_surface import with_matched_surface
from gsplat_core.geometry.moving_tissue import MovingTissue
from gsplat_core.geometry.multiview import DEFORMS, depth_of_view, view_of
from gsplat_core.geometry.pose_check import CONTRADICTED
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.training.initialisation import possible_depth
from gsplat_core.training.observations import Observation
from gsplat_core.training.offline import observed

MOST_KEY_FRAMES = 32
"""Frames that get depth, spread evenly over the recording."""
WINDOW_S = 3.0
"""A frame is compared with others that are at most so long before or after it: tissue does not stay as it is."""
MOVES = 0.5
"""Share of the key frames whose pictures contradict tissue that stands still, from which on it is looked for how it moves."""
MOST_PIXELS = 64_000_000
"""Of all frames with depth together: 12 bytes each of them here, and in what is learned from."""


class WithParallax(NamedTuple):
    """Frames of a moving camera, and what was found out about them."""

    frames: list[Frame]
    """Key frames among them have depth in the unit of the cameras' positions."""
    doubts: Mapping[str, int]
    """Why others of these have none, in sentences."""
    at_rest: bool = False
    """Whether depth is that of tissue that stands still: frames then differ by what is uncertain, not by motion."""


def frames_with_parallax(frames: Sequence[Frame], cameras: Sequence[Camera]) -> WithParallax:
    """Depth for frames that the `cameras` saw. Nothing is done where frames have depth already, or no camera moves."""
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
    # Where no motion is found, a rough depth on which frames agree is better to start from than none.
    if uncertain.total() == count:
        return _confirmed(given, cameras, doubts)
    return WithParallax(breathing, uncertain)


def _confirmed(frames: list[Frame], cameras: Sequence[Camera], doubts: Counter[str]) -> WithParallax:
    """Return the frames with their depth where most looks are confirmed by a neighbour, and without any depth elsewhere.

    The decision is one for the recording: frames that keep depth next to frames that lose it start at different distances. `depth_agreement`
    says when two looks confirm each other. `doubts` are added to.
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
    """The frames, key frames among them with depth by comparing pictures as if tissue stood still, and doubts."""
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
    """What a recording is trained on."""

    frames: list[Frame]
    """Those that a scene starts and grows from."""
    seen: list[Observation]
    """What is learned from them."""
    doubts: Mapping[str, int]
    """Of `frames_with_parallax`, as `at_rest`."""
    at_rest: bool = False
    light_shows_motion: bool = False
    """Of `frames_with_light`."""


def to_fit(frames: list[Frame], observation_of: Callable[[Frame], Observation], finds_depth: bool) -> ToFit:
    """What to train on; `frames` are changed. Matched depth becomes a surface; by light it is found anew from all frames; by parallax, if `finds_depth`, where
    there is no other.

    Raises InvalidInput where there are no frames, or they are not in order.
    """
    seen = observed(frames, observation_of)
    cameras = [each.camera for each in seen]
    for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True)):
        surface = with_matched_surface(frame, camera, possible_depth(frame) > 0)
        if surface is not frame:
            frames[number], seen[number] = surface, observation_of(surface)
    frames, light_shows_motion = frames_with_light(frames, cameras)
    if not finds_depth:
        return ToFit(frames, seen, {}, light_shows_motion=light_shows_motion)
    found = frames_with_parallax(frames, cameras)
    # What is not sure continues what is: that is something to start from, and nothing to learn.
    start = [
        frame.with_fields(depth_confidence=None) if frame.depth_origin is DepthOrigin.PARALLAX else frame
        for frame in found.frames
    ]
    return ToFit(start, observed(found.frames, observation_of), found.doubts, found.at_rest, light_shows_motion)
