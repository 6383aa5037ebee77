"""How true a finished model is in three dimensions, over a whole sequence; each measure is a module of its own, beside its trivial baseline.

* `depth_share` and `normals`, where the recording has depth: beside the best flat plane.
* `novel_view`, where it has further cameras or a right eye: beside the left picture.
* `tracking`, where it has points of the tissue that are followed: beside no motion.
* `trajectory`, where it has poses and the model was made with others: beside a scope that stands still.
* `parts`: how much of the pictures' change motion, colour, and size and opacity explain.

Everything is compared in the left camera's coordinates, frame by frame, so that it does not matter where a model has its origin. Where a
model has no scale of its own, the figures that are called `scaled` count: all of its lengths times one factor for the whole sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.evaluation.depth_share import DepthShare, DepthShareSums
from gsplat_core.evaluation.followed import FollowedPoints
from gsplat_core.evaluation.normals import NormalErrors, NormalSums
from gsplat_core.evaluation.novel_view import NovelView, NovelViewSums, moved_picture, seen_by_both
from gsplat_core.evaluation.parts import MOST_FRAMES as PART_FRAMES
from gsplat_core.evaluation.parts import PartShares, PartSums
from gsplat_core.evaluation.pictures import Picture
from gsplat_core.evaluation.scores import why_left_out
from gsplat_core.evaluation.tracking import Tracking
from gsplat_core.evaluation.trajectory import TrajectoryErrors, evaluate_trajectory
from gsplat_core.io.recordings.truth import GroundTruth
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model

MOST_FRAMES = 48
"""Frames that are compared, spread evenly over the recording."""
NO_SCALING = 0.005
"""A factor so near to 1 is taken for 1: the scaled pictures are the others."""

Pose = NDArray[np.float64]
Shown = Callable[[Camera, Frame], Picture]
"""What a model shows of a frame's time and exposure from a camera in its own world."""


@dataclass(frozen=True)
class Geometry:
    """What was measured; None or empty where the recording does not know the truth."""

    frames: int
    """How many were compared."""
    depth: DepthShare | None
    normals: NormalErrors | None
    views: tuple[NovelView, ...]
    """With the model's lengths as they are."""
    scaled_views: tuple[NovelView, ...]
    """After the one factor of the sequence's depth."""
    tracking: Tracking | None
    trajectory: TrajectoryErrors | None
    """None as well where the model has the recording's own poses."""
    parts: PartShares | None
    """None where the model does not deform."""


def evaluate_geometry(
    frames: Iterable[Frame],
    frame_count: int,
    camera: Camera,
    model: Model,
    shown: Shown,
    truth: GroundTruth,
    model_pose: Callable[[Frame], Pose | None] = lambda frame: frame.pose,
) -> Geometry:
    """Measure a model; reads the frames several times.

    Args:
        frames: of the recording, in order, each time they are iterated; `Frame.seq` counts from 0, as `truth` does.
        camera: of the frames; its pose counts for frames without one.
        model_pose: where the model has the left camera at a frame, world-to-camera; None: where `camera` is.
    """
    own = lambda frame: _posed(camera, model_pose(frame))
    depth, normals = DepthShareSums(), NormalSums()
    followed = None if truth.tracks is None else FollowedPoints(model, camera, truth.tracks)
    count = 0
    for frame in _chosen(frames, frame_count, MOST_FRAMES):
        picture = shown(own(frame), frame)
        count += 1
        true = truth.depth_of(frame)
        if true is not None:
            known = np.isfinite(true) & (true > 0) & _tissue(frame)
            depth.add(camera, true, picture.depth, known)
            normals.add(camera, true, picture.depth, known)
        if followed is not None:
            followed.add(frame, own(frame), picture.depth)
    errors = depth.errors
    scale = 1.0 if errors is None else errors.scale
    rescaled = abs(scale - 1) > NO_SCALING
    views = _views(frames, frame_count, camera, own, shown, truth, 1.0)
    return Geometry(
        frames=count,
        depth=errors,
        normals=normals.errors,
        views=views,
        scaled_views=_views(frames, frame_count, camera, own, shown, truth, scale) if rescaled else views,
        tracking=None if followed is None else followed.tracking(scale),
        trajectory=_trajectory(frames, model_pose),
        parts=None if model.field is None else _parts(frames, frame_count, own, model),
    )


def _trajectory(frames: Iterable[Frame], model_pose: Callable[[Frame], Pose | None]) -> TrajectoryErrors | None:
    """The model's poses against the recording's, over all frames that have both."""
    pairs = [(found, frame.pose) for frame in frames if frame.pose is not None for found in [model_pose(frame)]]
    both = [(found, true) for found, true in pairs if found is not None]
    if len(both) < 3 or all(found is true or np.array_equal(found, true) for found, true in both):
        return None
    return evaluate_trajectory(np.stack([found for found, _ in both]), np.stack([true for _, true in both]))


def _parts(
    frames: Iterable[Frame], frame_count: int, own: Callable[[Frame], Camera], model: Model
) -> PartShares | None:
    """Against the model as it is in the middle of its time."""
    sums = PartSums(model.at, sum(model.time_window_s) / 2)
    for frame in _chosen(frames, frame_count, PART_FRAMES):
        camera, exposure = own(frame), torch.tensor(frame.exposure, device=model.device)

        def picture_of(
            gaussians: Gaussians, camera: Camera = camera, exposure: torch.Tensor = exposure
        ) -> NDArray[np.float32]:
            with torch.inference_mode():
                image = render(gaussians, camera, depth=False).image * exposure
            return np.asarray(image.clamp(0, 1).cpu().numpy())

        sums.add(frame, picture_of)
    return sums.shares


def _views(
    frames: Iterable[Frame],
    frame_count: int,
    camera: Camera,
    own: Callable[[Frame], Camera],
    shown: Shown,
    truth: GroundTruth,
    scale: float,
) -> tuple[NovelView, ...]:
    """Every view's score; a model whose lengths are to be multiplied by `scale` is seen from positions divided by it."""
    sums: dict[str, NovelViewSums] = {}
    for frame in _chosen(frames, frame_count, MOST_FRAMES):
        for name, view_camera, view in _seen_from(frame, truth):
            left_depth = truth.depth_of(frame)
            seen = seen_by_both(camera, frame, left_depth, view_camera, view)
            pose = view_camera.world_to_camera.copy()
            pose[:3, 3] /= scale
            picture = shown(view_camera.with_pose(pose @ own(frame).world_to_camera), frame)
            known = None if left_depth is None else left_depth[(left_depth > 0) & _tissue(frame)]
            if known is None or not known.size:
                shows = shown(own(frame), frame).depth
                known = scale * shows[shows > 0]
            distance = float(np.median(known)) if known.size else np.inf
            shifted = moved_picture(camera, frame.image, view_camera, distance) if known.size else frame.image
            left = moved_picture(camera, frame.image, view_camera.with_pose(np.eye(4)), 1.0)
            sums.setdefault(name, NovelViewSums(name)).add(view, seen, picture.image, left, shifted)
    return tuple(found for each in sums.values() if (found := each.score) is not None)


def _seen_from(frame: Frame, truth: GroundTruth) -> Iterator[tuple[str, Camera, Frame]]:
    """The further cameras of a frame, and what they saw."""
    if frame.right_image is not None and frame.right_camera is not None:
        yield "right", frame.right_camera, Frame(frame.seq, frame.pts_ns, frame.right_image)
    for view in truth.views:
        yield view.name, view.camera, view.read(frame.seq)


def _chosen(frames: Iterable[Frame], frame_count: int, most: int) -> Iterator[Frame]:
    every = -(-frame_count // most)
    return (frame for frame in frames if frame.seq % every == 0 and why_left_out(frame) is None)


def _tissue(frame: Frame) -> NDArray[np.bool_]:
    return np.ones(frame.image.shape[:2], bool) if frame.mask is None else frame.mask != 0


def _posed(camera: Camera, pose: Pose | None) -> Camera:
    return camera if pose is None else camera.with_pose(pose)
