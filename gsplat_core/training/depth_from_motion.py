"""Depth of the scene from known camera motion and optical flow, for a moving scope without measured
depth.

Without depth a scene starts on a plane at an arbitrary distance. With known poses that plane moves
wrongly, and the field would have to learn the error of every frame. The position of a point in a
second frame is linear in its inverse depth w (Hartley and Zisserman 2004, section 12.2), so every
Gaussian has a least-squares w.

A correction moves a Gaussian along its ray of the first camera, which sees the same picture as
before.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.layout import POSITION
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import SurfaceMotion, beside

FLOW_ERROR_PX = 1.0
"""Standard deviation in pixels of motion that the camera does not explain: tissue motion and errors
of flow and pose.
"""
RELATIVE_ERROR = 0.15
"""Prior standard deviation of a Gaussian's inverse depth, relative to it."""
LARGEST_STEP = 1.4
"""Largest change of a Gaussian's depth by one frame, as a factor, once the scene's distance is
known.
"""
LEAST_PARALLAX_PX = 1.5
"""Median parallax in pixels from which the scene's distance is estimated."""
LEAST_EXPLAINED = 0.5
"""Share of the motion remaining after camera rotation that a single distance must explain."""
SMALLEST_SHIFT = 1e-9
"""Smallest displacement of a camera along an axis in scene units; less is rounding."""
ROUNDS = 4
"""Rounds of reweighting, which reduce the influence of independently moving points on the distance.
"""


class DepthFromMotion:
    """Estimates the distance of a scene once from camera motion, and refines the depth of each
    Gaussian with every frame.
    """

    def __init__(self) -> None:
        self._distance_is_known = False

    def apply(self, step: TrainingStep, motion: SurfaceMotion, before_s: float) -> None:
        """Correct the scene by the image motion since the frame at `before_s`, which it fits.

        Nothing changes if the camera only rotated or was static. On a GPU the host synchronises
        until the distance is known.
        """
        if not np.any(translation_between(motion.before, motion.after)):
            return
        with torch.no_grad():
            deltas = step.field.deltas(before_s)[:, POSITION]
            points = step.gaussians.means + deltas
            seen = motion.seen_before(points)
            target = seen.pixels + motion.at(seen.pixels)
            measured, information = inverse_depths(seen.pixels, target, motion.before, motion.after)
            information = torch.where(seen.inside[:, 0] & (measured > 0), information / FLOW_ERROR_PX**2, 0.0)
            known = 1 / seen.depth[:, 0]
            whole = torch.ones_like(known)
            found = not self._distance_is_known
            if found:
                distance = self._distance(seen.pixels, target, motion, known, information)
                if distance is None:
                    return
                self._distance_is_known = True
                whole = whole * float(known.median()) * distance
                known = known / whole
            gain = information / (information + 1 / (RELATIVE_ERROR * known) ** 2)
            refined = known + gain * (measured - known)
            factor = whole * (known / refined).clamp(1 / LARGEST_STEP, LARGEST_STEP)
            factor = torch.where(seen.inside[:, 0] & factor.isfinite() & (factor > 0), factor, whole)
            step.scale_about(motion.before, factor)
            if found:
                step.take_distance(motion.after)

    def _distance(
        self, pixels: Tensor, target: Tensor, motion: SurfaceMotion, known: Tensor, information: Tensor
    ) -> float | None:
        """Return the distance of a plane that explains most of the motion, or None with too little
        parallax or no such plane.
        """
        c, d = parallax_terms(pixels, target, motion.before, motion.after)
        focal = float(motion.after.K[0, 0])
        weight = (information > 0).to(c.dtype)
        inverse = known.median()
        for _ in range(ROUNDS):
            inverse = (weight * (c * d).sum(1)).sum() / (weight * (c * c).sum(1)).sum().clamp(min=1e-20)
            error_px = focal * (d - inverse * c).norm(dim=1)
            weight = (information > 0) / (1 + (error_px / FLOW_ERROR_PX) ** 2)
        counted = information > 0
        parallax_px = focal * inverse * c.norm(dim=1)
        explained = 1 - (d - inverse * c)[counted].square().sum() / d[counted].square().sum().clamp(min=1e-20)
        enough = counted.any() and bool(parallax_px[counted].median() >= LEAST_PARALLAX_PX)
        return float(1 / inverse) if enough and bool(explained >= LEAST_EXPLAINED) and float(inverse) > 0 else None


def parallax_terms(pixels: Tensor, target: Tensor, before: Camera, after: Camera) -> tuple[Tensor, Tensor]:
    """Return c and d [N, 2] of the equation w c = d for inverse depths w, in units of the focal
    length.

    Args:
        pixels: positions before [N, 2].
        target: positions after [N, 2].
        before, after: cameras of both frames. c is 0 if only the rotation differs.
    """
    between = after.world_to_camera @ np.linalg.inv(before.world_to_camera)
    rotation = beside(pixels, between[:3, :3])
    tx, ty, tz = (float(value) for value in between[:3, 3])
    first, second = _normalised(pixels, before), _normalised(target, after)
    ray = torch.cat([first, torch.ones_like(first[:, :1])], dim=1) @ rotation.T
    c = second * tz - beside(second, [tx, ty])
    return c, ray[:, :2] - second * ray[:, 2:]


def inverse_depths(pixels: Tensor, target: Tensor, before: Camera, after: Camera) -> tuple[Tensor, Tensor]:
    """Return least-squares inverse depths [N] in the first camera, and their information [N]
    (inverse variance for an error of one pixel).
    """
    c, d = parallax_terms(pixels, target, before, after)
    squared = (c * c).sum(dim=1)
    return (c * d).sum(dim=1) / squared.clamp(min=1e-20), squared * float(after.K[0, 0]) ** 2


def translation_between(before: Camera, after: Camera) -> NDArray[np.float64]:
    """Return the first camera's centre in coordinates of the second [3]; exactly 0 without
    translation.
    """
    moved = before.position - after.position
    return np.asarray(after.world_to_camera[:3, :3] @ np.where(np.abs(moved) < SMALLEST_SHIFT, 0.0, moved))


def _normalised(pixels: Tensor, camera: Camera) -> Tensor:
    focal = beside(pixels, [camera.K[0, 0], camera.K[1, 1]])
    return (pixels - beside(pixels, [camera.K[0, 2], camera.K[1, 2]])) / focal
