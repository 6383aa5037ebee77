"""Geometric accuracy of a finished model over a whole sequence, with trivial baselines.

* depth and normals, if the recording has depth; baseline: the best flat plane
* novel views, if it has further cameras or a right eye; baseline: the left picture
* tracked points and flow, if it has them; baseline: no motion
* trajectory, if it has poses and the model uses others; baseline: a static scope
* parts of the deformation: shares of the pictures' change explained by motion, by colour, and by
  size and opacity

Lengths are compared in the left camera's coordinates frame by frame, so the origin of a model does not matter. For a
model of unknown scale, the `scaled` figures multiply all lengths by one factor for the whole sequence.

A model that repaints tissue instead of moving it shows correct pictures with wrong motion. `PartSums` therefore renders
frames with parts of the deformation frozen at a reference time. The share of a part is its Shapley value: the mean
reduction of the squared difference over all orders of unfreezing.

Absolute trajectory error (ATE) of an estimated scope trajectory.

The error of a static scope serves as baseline. ATE: Sturm et al., "A Benchmark for the Evaluation
of RGB-D SLAM Systems" (2012). Alignment: Umeyama, "Least-squares estimation of transformation
parameters between two point patterns" (1991).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.depth.maps import measured_confidence
from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.depth import DepthShare, DepthShareSums, NormalErrors, NormalSums
from gsplat_core.evaluation.motion import FlowErrors, FlowSums, FollowedPoints, Tracking
from gsplat_core.evaluation.scores import why_left_out
from gsplat_core.evaluation.views import NovelView, Pose, Shown, ViewSums
from gsplat_core.io.recordings.truth import GroundTruth
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import picture_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame
from gsplat_core.scene.gaussians import Gaussians

LEAST_PATH_SHARE = 1e-6
"""Relative path length below which the scope counts as static.

The length is compared with this share of the distance from the origin, and with this value.
"""

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of an estimated scope trajectory (ATE), with the error of a static scope as baseline."""

    rigid_share: float
    """RMS position error divided by the length of the true path, after a rigid alignment; for estimates with metric scale."""
    similarity_share: float
    """RMS position error divided by the length of the true path, after a similarity alignment; for the shape of the path alone."""
    still_share: float
    """Baseline: `rigid_share` of a static scope at the mean of the true positions."""
    rigid_rmse: float
    """Root mean square position error after the rigid alignment, in the unit of the true path."""
    rotation_deg: float
    """Mean angle in degrees between true and estimated orientations, after the rotation of the alignment."""
    scale: float
    """Scale factor by which the similarity alignment multiplies the estimated positions."""
    path: float
    """Length of the true path, in its unit."""
    frames: int


def evaluate_trajectory(estimated: Poses, true: Poses) -> TrajectoryErrors | None:
    """Compare world-to-camera poses [N, 4, 4] of the same frames; None for a static true scope.

    Raises:
        InvalidInput: for fewer than three poses or different numbers of poses.
    """
    if estimated.shape != true.shape or len(true) < 3:
        raise InvalidInput(
            f"there are {list(estimated.shape)} estimated and {list(true.shape)} true poses; give three or more of both"
        )
    found, right = _centres(estimated), _centres(true)
    path = float(np.linalg.norm(np.diff(right, axis=0), axis=1).sum())
    if path <= LEAST_PATH_SHARE * max(1.0, float(np.abs(right).max())):
        return None
    rotation, scale = _alignment(found, right)
    rmse = lambda factor: _rmse(factor * (found - found.mean(axis=0)) @ rotation.T, right - right.mean(axis=0))
    turned = estimated[:, :3, :3] @ rotation.T
    cosine = (np.einsum("nij,nij->n", turned, true[:, :3, :3]) - 1) / 2
    return TrajectoryErrors(
        rigid_share=rmse(1.0) / path,
        similarity_share=rmse(scale) / path,
        still_share=rmse(0.0) / path,
        rigid_rmse=rmse(1.0),
        rotation_deg=float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()),
        scale=scale,
        path=path,
        frames=len(true),
    )


def _centres(poses: Poses) -> Poses:
    """Return the camera centres [N, 3] of world-to-camera poses [N, 4, 4]."""
    return np.asarray(-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]))


def _alignment(found: Poses, right: Poses) -> tuple[Poses, float]:
    """Return the rotation [3, 3] and the scale that align the positions `found` with the true ones `right` about their means.

    The scale of coincident positions is 0.
    """
    a, b = found - found.mean(axis=0), right - right.mean(axis=0)
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    spread = float(np.square(a).sum())
    return (u * signs) @ vt, float((singular * signs).sum() / spread) if spread > 0 else 0.0


def _rmse(a: Poses, b: Poses) -> float:
    return float(np.sqrt(np.square(a - b).sum(axis=1).mean()))


MOTION, COLOUR, SIZE = "motion", "colour", "size"
PARTS: dict[str, tuple[str, ...]] = {
    MOTION: ("means", "quats"),
    COLOUR: ("sh",),
    SIZE: ("log_scales", "logit_opacities"),
}
"""Parts into which the deformation is divided: the tensors of `Gaussians` that each part changes over time, by the part's name."""
PART_FRAMES = 8
"""Number of frames from which the shares of motion, colour and size are computed; each is rendered eight times."""


@dataclass(frozen=True)
class PartShares:
    """Shares of the squared error of the model frozen at `reference_s` that the change of motion, size and colour of
    the Gaussians over time removes (Shapley values).
    """

    motion: float
    """Share of the frozen model's squared error that changes of positions and orientations over time remove."""
    colour: float
    size: float
    """Share of the frozen model's squared error that changes of sizes and opacities over time remove."""
    explained: float
    """Sum of the shares of motion, colour and size. The rest of the squared error remains in the complete model."""
    reference_s: float
    frames: int


class PartSums:
    """Streaming accumulator of squared errors, one for each subset of the parts motion, size and colour that may change
    over time.
    """

    def __init__(self, gaussians_at: Callable[[float], Gaussians], reference_s: float) -> None:
        """Create an empty accumulator.

        Args:
            gaussians_at: callback that returns the deformed Gaussians at a time.
            reference_s: time in seconds at which frozen parts are evaluated.
        """
        self._at, self._reference_s = gaussians_at, reference_s
        self._errors: dict[frozenset[str], float] = {thawed: 0.0 for thawed in _subsets(tuple(PARTS))}
        self._frames = 0

    def add(self, frame: Frame, picture_of: Callable[[Gaussians], NDArray[Any]]) -> None:
        """Render a frame once for each subset of parts, with all other parts frozen at the reference time.

        Args:
            frame: reference frame.
            picture_of: callback that renders Gaussians from the frame's pose, [H, W, 3] in 0..1.
        """
        moved, frozen = self._at(frame.time_s).tensors(), self._at(self._reference_s).tensors()
        tissue = np.ones(frame.image.shape[:2], bool) if frame.tissue is None else frame.tissue != 0
        wanted = frame.image[tissue].astype(np.float64) / 255
        for thawed in self._errors:
            names = {name for part in thawed for name in PARTS[part]}
            mixed: dict[str, Tensor] = {name: (moved if name in names else frozen)[name] for name in moved}
            shown = picture_of(Gaussians.from_tensors(mixed))[tissue].astype(np.float64)
            self._errors[thawed] += float(np.square(shown - wanted).sum())
        self._frames += 1

    @property
    def shares(self) -> PartShares | None:
        """Shares of motion, colour and size over all added frames; None without frames, or if the frozen model has no error."""
        whole = self._errors[frozenset()]
        if not self._frames or whole <= 0:
            return None
        shares = {part: self._shapley(part) / whole for part in PARTS}
        return PartShares(
            shares[MOTION], shares[COLOUR], shares[SIZE], sum(shares.values()), self._reference_s, self._frames
        )

    def _shapley(self, part: str) -> float:
        others = tuple(name for name in PARTS if name != part)
        count = len(PARTS)
        return sum(
            factorial(len(before))
            * factorial(count - len(before) - 1)
            / factorial(count)
            * (self._errors[before] - self._errors[before | {part}])
            for before in _subsets(others)
        )


def _subsets(names: tuple[str, ...]) -> list[frozenset[str]]:
    return [frozenset(chosen) for size in range(len(names) + 1) for chosen in combinations(names, size)]


MOST_FRAMES = 48
"""Maximum number of frames whose geometry is compared with the truth, spread evenly over the recording."""
NO_SCALING = 0.005
"""Tolerance around a scale factor of 1. Within it, the scores of the scaled model are copied from the unscaled one
instead of being rendered.
"""


@dataclass(frozen=True)
class Geometry:
    """Results of a geometry evaluation; None or empty where the recording has no ground truth."""

    frames: int
    """Number of compared frames."""
    depth: DepthShare | None
    """Errors of the model's default depth: the blended depth of the Gaussians' centres."""
    normals: NormalErrors | None
    """Errors of the normals computed from the model's depth."""
    views: tuple[NovelView, ...]
    """Scores rendered at the model's own scale, without scale alignment."""
    scaled_views: tuple[NovelView, ...]
    """Scores after multiplying the model's lengths by one factor for the sequence, the median of true over
    rendered depth.
    """
    tracking: Tracking | None
    flow: FlowErrors | None
    trajectory: TrajectoryErrors | None
    """Errors of the model's poses; None without true poses, or if the model uses those of the recording."""
    parts: PartShares | None
    """Shares of the picture error that motion, colour and size over time remove; None if the model is static."""
    ray_depth: DepthShare | None = None
    """Errors of the depth along the rays; None if the renderer does not have it."""
    ray_normals: NormalErrors | None = None


def evaluate_geometry(
    frames: Iterable[Frame],
    frame_count: int,
    camera: Camera,
    model: Model,
    shown: Shown,
    truth: GroundTruth,
    model_pose: Callable[[Frame], Pose | None] = lambda frame: frame.pose,
) -> Geometry:
    """Measure the geometry of a model.

    Reads the frames once, and again for the scaled views of a model whose scale differs from the true depth.

    Args:
        frames: frames of the recording, in order on each iteration; `Frame.seq` counts from 0 as in `truth`.
        camera: camera of the frames; its pose is used for frames without one.
        model_pose: callback that returns the left camera's world-to-camera pose in model space at a frame; None selects
            that of `camera`.
    """
    own = lambda frame: _posed(camera, model_pose(frame))
    depth, normals, views = DepthShareSums(), NormalSums(), ViewSums(camera, shown, truth)
    ray_depth, ray_normals = DepthShareSums(), NormalSums()
    followed = None if truth.tracks is None else FollowedPoints(model, camera, truth.tracks)
    flow = None if truth.motion is None else FlowSums(model, camera, truth.motion)
    parts = None if model.field is None else PartSums(model.at, sum(model.time_window_s) / 2)
    ways: list[tuple[Pose, Pose]] = []
    count = 0
    for frame in frames:
        pose = model_pose(frame)
        if pose is not None and frame.pose is not None:
            ways.append((pose, frame.pose))
        if flow is not None:
            flow.arrive(frame, own(frame))
        if _is_chosen(frame, frame_count, MOST_FRAMES):
            count += 1
            picture, true = shown(own(frame), frame), truth.depth_of(frame)
            if true is not None:
                known = _known(frame, true)
                for each in (depth, normals):
                    each.add(camera, true, picture.depth, known)
                if picture.ray_depth is not None:
                    for each in (ray_depth, ray_normals):
                        each.add(camera, true, picture.ray_depth, known)
            if followed is not None:
                followed.add(frame, own(frame), picture.depth)
            if flow is not None:
                flow.begin(frame, own(frame), picture.depth, _tissue(frame))
            views.add(frame, own(frame), picture.depth)
        if parts is not None and _is_chosen(frame, frame_count, PART_FRAMES):
            parts.add(frame, _picture_from(model, own(frame)))
    errors = depth.errors
    scale = 1.0 if errors is None else errors.scale
    scaled = views
    if abs(scale - 1) > NO_SCALING and views.scores:
        scaled = ViewSums(camera, shown, truth, scale)
        for frame in (each for each in frames if _is_chosen(each, frame_count, MOST_FRAMES)):
            scaled.add(frame, own(frame), None)
    return Geometry(
        frames=count,
        depth=errors,
        normals=normals.errors,
        views=views.scores,
        scaled_views=scaled.scores,
        tracking=None if followed is None else followed.tracking(scale),
        flow=None if flow is None else flow.errors(scale),
        trajectory=_trajectory(ways),
        parts=None if parts is None else parts.shares,
        ray_depth=ray_depth.errors,
        ray_normals=ray_normals.errors,
    )


def _known(frame: Frame, true: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask [H, W] of tissue pixels with a true depth to compare with.

    Depth measured by the recording is excluded where its confidence is low, such as at depth edges.
    """
    known = np.isfinite(true) & (true > 0) & _tissue(frame)
    if true is frame.depth:
        confidence = frame.depth_confidence
        known &= (measured_confidence(true) if confidence is None else confidence) >= BELIEVED
    return np.asarray(known)


def _trajectory(ways: list[tuple[Pose, Pose]]) -> TrajectoryErrors | None:
    """Compare pairs of the model's and the recording's pose of each frame; None if they are equal, or for fewer than three frames."""
    if len(ways) < 3 or all(found is true or np.array_equal(found, true) for found, true in ways):
        return None
    return evaluate_trajectory(np.stack([found for found, _ in ways]), np.stack([true for _, true in ways]))


def _picture_from(model: Model, camera: Camera) -> Callable[[Gaussians], NDArray[np.float32]]:
    """Return a function that renders Gaussians from a camera."""

    def shown(gaussians: Gaussians) -> NDArray[np.float32]:
        with torch.inference_mode():
            image = picture_of(model, gaussians, camera, depth=False).image
        return np.asarray(image.clamp(0, 1).cpu().numpy())

    return shown


def _is_chosen(frame: Frame, frame_count: int, most: int) -> bool:
    """Return True if a frame is fit for scoring and is one of at most `most` evenly spaced frames of the recording."""
    return frame.seq % -(-frame_count // most) == 0 and why_left_out(frame) is None


def _tissue(frame: Frame) -> NDArray[np.bool_]:
    return np.ones(frame.image.shape[:2], bool) if frame.tissue is None else frame.tissue != 0


def _posed(camera: Camera, pose: Pose | None) -> Camera:
    return camera if pose is None else camera.with_pose(pose)
