"""Errors of a model's motion: tracked points, and frame-to-frame optical and scene flow.

A point is defined by its pixel in the first frame that shows it. The model unprojects the pixel by its own depth and
moves the point with the nearest Gaussians. Errors are Euclidean, over every later frame that shows the point, in pixels
and in the recording's unit in left-camera coordinates. Metrics: Schmidt et al., "STIR: Surgical Tattoos in Infrared"
(2023), and the STIR challenge of 2024.

Flow compares each pixel with its position in the next frame. A pixel moves by the mean motion of the Gaussians on its
ray, weighted by their blending weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.io.recordings.truth import MotionFiles, Tracks, TrueMotion
from gsplat_core.models import Model
from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.scene.cameras import Camera, Points, at_pixels, inverse, moved, pixel_rays, pixels_of, points_of
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians

WITHIN_PX = (4, 8, 16, 32, 64)
WITHIN_MM = (2, 4, 8, 16, 32)
"""Distance thresholds of the STIR challenge in mm. The score is the mean, over the thresholds, of the share of closer positions."""
NEIGHBOURS = 8
LEAST_OPACITY = 0.1
"""Smallest opacity of the Gaussians whose motion moves the tracked points."""


class CarriedPoints:
    """World points that a model moves over time by the mean motion of their nearest Gaussians."""

    def __init__(self, model: Model, points: Points, time_s: float) -> None:
        self._model, self._points = model, points
        start = model.at(time_s)
        self._index, self._weights = _neighbours(start, torch.as_tensor(points, dtype=torch.float32).to(model.device))
        self._start = start.means[self._index].double()

    def at(self, time_s: float) -> Points:
        """Return the positions [P, 3] of the points at `time_s` seconds."""
        now = self._model.at(time_s).means[self._index].double()
        motion = ((now - self._start) * self._weights[..., None]).sum(dim=1)
        return np.asarray(self._points + motion.cpu().numpy())


def _neighbours(gaussians: Gaussians, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the nearest Gaussians of each point and their interpolation weights.

    Args:
        gaussians: model at the start time.
        points: [P, 3].

    Returns:
        Indices [P, K] and weights [P, K] that sum to 1. A weight is the opacity times a Gaussian of the distance.
    """
    shows = gaussians.opacities.detach()
    candidates = torch.nonzero(shows > LEAST_OPACITY).flatten()
    if not len(candidates):
        candidates = torch.arange(gaussians.count, device=points.device)
    means = gaussians.means.detach()[candidates]
    distances, nearest = [], []
    for chunk in points.split(64):
        distance, index = torch.cdist(chunk, means).topk(min(NEIGHBOURS, len(candidates)), largest=False)
        distances.append(distance)
        nearest.append(index)
    distance, index = torch.cat(distances).double(), candidates[torch.cat(nearest)]
    width = distance.median(dim=1, keepdim=True).values.clamp_min(1e-9)
    weights = shows[index].double() * torch.exp(-0.5 * (distance / width).square())
    return index, weights / weights.sum(dim=1, keepdim=True).clamp_min(1e-12)


@dataclass(frozen=True)
class TrackErrors:
    """Errors over all tracked points and all later frames in which a point is visible."""

    median_mm: float
    mean_mm: float
    median_px: float
    mean_px: float
    within_mm: float
    """Share of positions nearer than 2 mm to the true one; mean of this and of the shares within 4, 8, 16 and 32 mm."""
    within_px: float
    """Mean share of positions within 4, 8, 16, 32 and 64 pixels of the true one."""


@dataclass(frozen=True)
class Tracking:
    """Accuracy of tracked tissue points."""

    model: TrackErrors
    scaled: TrackErrors
    """Errors after scaling the model by the sequence's depth factor."""
    still: TrackErrors
    """Baseline without motion: each point keeps its pixel and true depth in the frame in which its tracking starts."""
    points: int
    compared: int
    """Number of point positions that were compared with the true ones."""


class TrackSums:
    """Accumulator of tracking errors: of positions in left-camera coordinates [P, 3] and of pixels [P, 2]."""

    def __init__(self) -> None:
        self._mm: list[Points] = []
        self._px: list[Points] = []

    def add(self, found: Points, true: Points, found_px: Points, true_px: Points) -> None:
        """Add the errors of estimated positions [P, 3] and pixels [P, 2] against the true ones."""
        self._mm.append(np.linalg.norm(found - true, axis=1))
        # A point behind the camera has no pixel. Count it as an error beyond the last threshold.
        self._px.append(np.nan_to_num(np.linalg.norm(found_px - true_px, axis=1), nan=2.0 * WITHIN_PX[-1]))

    @property
    def count(self) -> int:
        """Number of point positions that were compared with the true ones."""
        return sum(len(each) for each in self._mm)

    @property
    def errors(self) -> TrackErrors | None:
        """Statistics of all tracking errors added so far; None if no position was compared."""
        if not self.count:
            return None
        mm, px = np.concatenate(self._mm), np.concatenate(self._px)
        share = lambda errors, limits: float(np.mean([np.mean(errors < limit) for limit in limits]))
        return TrackErrors(
            median_mm=float(np.median(mm)),
            mean_mm=float(mm.mean()),
            median_px=float(np.median(px)),
            mean_px=float(px.mean()),
            within_mm=share(mm, WITHIN_MM),
            within_px=share(px, WITHIN_PX),
        )


class FollowedPoints:
    """Tracking errors of points followed through frames in order.

    Each point starts in the first frame that sees it and in which the model has depth at its pixel.
    """

    def __init__(self, model: Model, camera: Camera, tracks: Tracks) -> None:
        self._model, self._camera, self._tracks = model, camera, tracks
        count = tracks.points.shape[1]
        self._started = np.zeros(count, bool)
        self._start_px, self._start_true = np.zeros((count, 2)), np.zeros((count, 3))
        self._groups: list[tuple[NDArray[np.int64], CarriedPoints]] = []
        self._found: list[tuple[Points, Points]] = []
        """Estimated and true positions of each compared frame, in the left camera's coordinates."""
        self._pixels, self._still = TrackSums(), TrackSums()

    def add(self, frame: Frame, own: Camera, shown: NDArray[Any]) -> None:
        """Follow the points to the next frame, and record their errors.

        Args:
            frame: frame of the recording.
            own: camera of the frame in model space.
            shown: depth z [H, W] rendered by the model.
        """
        pose = np.eye(4) if frame.pose is None else frame.pose
        true = moved(pose, self._tracks.points[frame.seq])
        true_px = pixels_of(self._camera, true)
        seen = self._tracks.seen[frame.seq]
        for index, carried in self._groups:
            now = seen[index]
            if not now.any():
                continue
            found = moved(own.world_to_camera, carried.at(frame.time_s))[now]
            there = index[now]
            self._found.append((found, true[there]))
            self._pixels.add(found, true[there], pixels_of(self._camera, found), true_px[there])
            self._still.add(self._start_true[there], true[there], self._start_px[there], true_px[there])
        self._begin(frame, own, shown, seen, true, true_px)

    def _begin(
        self,
        frame: Frame,
        own: Camera,
        shown: NDArray[Any],
        seen: NDArray[np.bool_],
        true: Points,
        true_px: Points,
    ) -> None:
        """Start tracking newly visible points at their pixels, unprojected with the model's depth."""
        z = at_pixels(shown, true_px)
        new = np.flatnonzero(seen & ~self._started & (z > 0))
        if not len(new):
            return
        K = self._camera.K
        slopes = (true_px[new] - K[:2, 2]) / K[[0, 1], [0, 1]]
        local = np.concatenate([slopes, np.ones((len(new), 1))], axis=1) * z[new, None]
        world = moved(inverse(own.world_to_camera), local)
        self._groups.append((new, CarriedPoints(self._model, world, frame.time_s)))
        self._started[new] = True
        self._start_px[new], self._start_true[new] = true_px[new], true[new]

    def tracking(self, scale: float) -> Tracking | None:
        """Return the tracking errors, or None if nothing was compared.

        Args:
            scale: factor that converts model lengths to the recording's unit.
        """
        scaled = TrackSums()
        for found, true in self._found:
            scaled.add(scale * found, true, pixels_of(self._camera, found), pixels_of(self._camera, true))
        model, one_scale, still = self._pixels.errors, scaled.errors, self._still.errors
        if model is None or one_scale is None or still is None:
            return None
        return Tracking(model, one_scale, still, int(self._started.sum()), self._pixels.count)


MOST_PIXELS = 8192
"""Maximum number of evenly spaced pixels compared per frame, to bound memory."""
Values = NDArray[np.float64]


@dataclass(frozen=True)
class EndPointErrors:
    """End-point errors of the motion to the next frame, over all compared pixels."""

    median_px: float
    mean_px: float
    median_mm: float | None
    """Errors of the scene flow in the recording's unit; None (as `mean_mm`) without true scene flow."""
    mean_mm: float | None


@dataclass(frozen=True)
class FlowErrors:
    """Errors of frame-to-frame motion at tissue pixels with known true motion."""

    model: EndPointErrors
    scaled: EndPointErrors
    """Errors after scaling the model by the sequence's depth factor."""
    still: EndPointErrors
    """Baseline without motion; equals the magnitude of the true motion."""
    frames: int


@dataclass(frozen=True)
class _Started:
    """Pixels of a frame whose motion will be compared when the next frame arrives, with their positions in the model."""

    seq: int
    time_s: float
    points: Values
    """Positions of the pixels' surface points in the model's world, [P, 3]."""
    pixels: Values
    here: NDArray[np.bool_]
    """Mask [H, W] of the pixels whose motion is compared."""
    own: Camera
    true: TrueMotion
    true_pose: Values


class FlowSums:
    """Flow errors accumulated over all frames in order.

    `begin` samples the pixels of a frame. `arrive` compares their motion when the next frame arrives.
    """

    def __init__(self, model: Model, camera: Camera, files: MotionFiles) -> None:
        self._model, self._camera, self._files = model, camera, files
        self._started: _Started | None = None
        self._px: list[Values] = []
        """End-point errors in pixels for each compared frame: of the model (row 0) and of no motion (row 1), [2, P]."""
        self._mm: list[tuple[Values, Values]] = []
        """For each compared frame, the 3D motion of its pixels' surface points in the model and the true one, [P, 3], in left-camera axes."""

    def begin(self, frame: Frame, own: Camera, shown: NDArray[Any], tissue: NDArray[np.bool_]) -> None:
        """Sample a frame for comparison with the next one, if its true motion is known at any pixel of `tissue`.

        Args:
            frame: frame of the recording.
            own: camera of the frame in model space.
            shown: depth z [H, W] rendered by the model.
            tissue: bool [H, W], pixels that may be compared.
        """
        true = self._files.of(frame)
        if true is None:
            return
        known = tissue & np.isfinite(true.flow).all(axis=2) & np.isfinite(shown) & (shown > 0)
        if true.scene_flow is not None:
            known &= np.isfinite(true.scene_flow).all(axis=2)
        here = np.zeros(known.shape, bool)
        chosen = np.flatnonzero(known)
        here.flat[chosen[:: -(-len(chosen) // MOST_PIXELS)] if len(chosen) else chosen] = True
        if not here.any():
            return
        points = moved(inverse(own.world_to_camera), points_of(own, shown)[here])
        pixels = pixel_rays(own)[here][:, :2] * own.K[[0, 1], [0, 1]] + own.K[:2, 2]
        pose = np.eye(4) if frame.pose is None else frame.pose
        self._started = _Started(frame.seq, frame.time_s, points, pixels, here, own, true, pose)

    def arrive(self, frame: Frame, own: Camera) -> None:
        """Add the motion errors of the pixels that `begin` sampled, if `frame` is the one directly after theirs.

        Args:
            frame: next frame that arrived; it need not have been sampled by `begin`.
            own: camera of the next frame in model space.
        """
        started, self._started = self._started, None
        if started is None or frame.seq != started.seq + 1:
            return
        motion = self._motion(started, frame.time_s)[started.here]
        there = pixels_of(own, moved(own.world_to_camera, started.points + motion))
        true = started.true.flow[started.here]
        off = np.linalg.norm(there - started.pixels - true, axis=1)
        seen = np.isfinite(off)  # NaN for points that the model moves behind the camera
        self._px.append(np.stack([off[seen], np.linalg.norm(true, axis=1)[seen]]))
        if started.true.scene_flow is not None:
            found = motion @ started.own.world_to_camera[:3, :3].T
            self._mm.append((found, started.true.scene_flow[started.here] @ started.true_pose[:3, :3].T))

    def _motion(self, started: _Started, next_s: float) -> Values:
        """Return the motion [H, W, 3] of each pixel's surface point, in the model's world."""
        now, then = self._model.at(started.time_s), self._model.at(next_s)
        viewmat, intrinsics = started.own.matrices(now.device, now.dtype)
        with torch.inference_mode():
            blended, alpha, _ = rasterization(
                now.means, now.quats, now.scales, now.opacities, then.means - now.means, viewmat[None],
                intrinsics[None], started.own.width_px, started.own.height_px, camera_model=started.own.model,
            )  # fmt: skip
        return np.asarray((blended / alpha.clamp(min=1e-6))[0].double().cpu().numpy())

    def errors(self, scale: float) -> FlowErrors | None:
        """Return the flow errors, or None if nothing was compared.

        Args:
            scale: factor that converts model lengths to the recording's unit.
        """
        if not self._px:
            return None
        px, still_px = np.concatenate(self._px, axis=1)
        if not len(px):
            return None
        found, true = (np.concatenate(each) for each in zip(*self._mm, strict=True)) if self._mm else (None, None)
        off = lambda factor: None if found is None else np.linalg.norm(factor * found - true, axis=1)
        return FlowErrors(
            _errors(px, off(1.0)), _errors(px, off(scale)), _errors(still_px, off(0.0)), frames=len(self._px)
        )


def _errors(px: Values, mm: Values | None) -> EndPointErrors:
    lengths = (None, None) if mm is None else (float(np.median(mm)), float(mm.mean()))
    return EndPointErrors(float(np.median(px)), float(px.mean()), *lengths)
