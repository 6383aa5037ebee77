"""How far a model moves what each pixel shows until the next frame, beside where it goes: end-point errors of optical flow and of scene flow.

What a pixel shows is at the model's depth, and moves by the mean motion of the Gaussians on its ray, weighted as their colours are blended.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.evaluation.projection import inverse, moved, pixel_rays, pixels_of, points_of
from gsplat_core.io.recordings.true_motion import MotionFiles, TrueMotion
from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model

MOST_PIXELS = 8192
"""Pixels of a frame that are compared, spread evenly: what is kept does not grow with the pictures."""
Values = NDArray[np.float64]


@dataclass(frozen=True)
class EndPointErrors:
    """Distances between where the pixels' tissue is said to go and where it goes, until the next frame, over all compared pixels."""

    median_px: float
    mean_px: float
    median_mm: float | None
    """None where the recording knows no scene flow, as `mean_mm`. In the recording's unit."""
    mean_mm: float | None


@dataclass(frozen=True)
class FlowErrors:
    """Motion from frame to frame, at the pixels of tissue whose true motion is known."""

    model: EndPointErrors
    scaled: EndPointErrors
    """After all of the model's lengths were multiplied by the one factor of the sequence's depth."""
    still: EndPointErrors
    """No motion: how far the tissue goes."""
    frames: int


@dataclass(frozen=True)
class _Started:
    """Some pixels of a frame whose next one has not come yet."""

    seq: int
    time_s: float
    points: Values
    """Where the model has them in the world [P, 3]."""
    pixels: Values
    here: NDArray[np.bool_]
    """[H, W]: which pixels they are."""
    own: Camera
    true: TrueMotion
    true_pose: Values


class FlowSums:
    """Takes frames in order, all of them: `arrive` ends what `begin` began with the frame before."""

    def __init__(self, model: Model, camera: Camera, files: MotionFiles) -> None:
        self._model, self._camera, self._files = model, camera, files
        self._started: _Started | None = None
        self._px: list[Values] = []
        """Of each compared frame [2, P]: errors of the model and of no motion."""
        self._mm: list[tuple[Values, Values]] = []
        """The model's motion and the true one [P, 3], in the axes of the left camera."""

    def begin(self, frame: Frame, own: Camera, shown: NDArray[Any], tissue: NDArray[np.bool_]) -> None:
        """A frame to be compared with the next one. own: the model's camera; shown: the model's depth z [H, W]."""
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
        """The next frame, whether it is itself compared or not; own: where the model has its camera."""
        started, self._started = self._started, None
        if started is None or frame.seq != started.seq + 1:
            return
        motion = self._motion(started, frame.time_s)[started.here]
        there = pixels_of(own, moved(own.world_to_camera, started.points + motion))
        true = started.true.flow[started.here]
        off = np.linalg.norm(there - started.pixels - true, axis=1)
        seen = np.isfinite(off)  # not what is said to go behind the camera, which is no place in the picture
        self._px.append(np.stack([off[seen], np.linalg.norm(true, axis=1)[seen]]))
        if started.true.scene_flow is not None:
            found = motion @ started.own.world_to_camera[:3, :3].T
            self._mm.append((found, started.true.scene_flow[started.here] @ started.true_pose[:3, :3].T))

    def _motion(self, started: _Started, next_s: float) -> Values:
        """The motion of what each pixel shows [H, W, 3], in the model's world."""
        now, then = self._model.at(started.time_s), self._model.at(next_s)
        viewmat, intrinsics = started.own.matrices(now.device, now.dtype)
        with torch.inference_mode():
            blended, alpha, _ = rasterization(
                now.means, now.quats, now.scales, now.opacities, then.means - now.means, viewmat[None],
                intrinsics[None], started.own.width_px, started.own.height_px, camera_model=started.own.model,
            )  # fmt: skip
        return np.asarray((blended / alpha.clamp(min=1e-6))[0].double().cpu().numpy())

    def errors(self, scale: float) -> FlowErrors | None:
        """What they come to; `scale`: the factor that a model's lengths lack. None where nothing was compared."""
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
