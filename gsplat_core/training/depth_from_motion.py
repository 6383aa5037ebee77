"""Depth of the scene from known camera motion and optical flow, for a moving scope without measured depth.

Without depth a scene starts on a plane at an arbitrary distance. Seen from a camera whose pose is known that plane moves wrongly, and the
field would have to learn the error of every frame. Two frames say more: where a point of inverse depth w appears in the second one is linear in
w (Hartley and Zisserman 2004, section 12.2), so that every Gaussian has a least-squares w.

A correction moves a Gaussian along its ray of the first camera, which sees the same picture as before.
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
"""Standard deviation of the motion that the camera's does not explain: the tissue's own, and errors of flow and pose."""
RELATIVE_ERROR = 0.15
"""Standard deviation of a Gaussian's inverse depth before a frame, relative to it."""
LARGEST_STEP = 1.4
"""Factor by which one frame changes the depth of one Gaussian at most, once the scene's distance is known."""
LEAST_PARALLAX_PX = 1.5
"""Motion by parallax, as a median, from which the scene's distance is taken as a whole."""
LEAST_EXPLAINED = 0.5
"""Share of the motion left by the camera's turning that one distance for the whole scene has to explain."""
SMALLEST_SHIFT = 1e-9
"""Of a camera's centre along an axis, in the scene's units: less is rounding."""
ROUNDS = 4
"""Of reweighting, so that points that move otherwise do not decide the distance."""


class DepthFromMotion:
    """Places one scene at the distance that the camera's motion shows, once, and refines the depth of each Gaussian with every frame."""

    def __init__(self) -> None:
        self._distance_is_known = False

    def apply(self, step: TrainingStep, motion: SurfaceMotion, before_s: float) -> None:
        """Correct the scene, which fits the frame at `before_s`, by how the picture moved since.

        Nothing changes where the camera only turned or stood still. On a GPU the host waits until the scene's distance is known.
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
        """The distance of a plane that explains most of the motion; None where there is too little parallax or none explains it."""
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
    """[N, 2] each: c and d with w c = d for the inverse depth w of a point seen at `pixels` before and at `target` after, both [N, 2].

    In units of the focal length. c is 0 where the camera only turned.
    """
    between = after.world_to_camera @ np.linalg.inv(before.world_to_camera)
    rotation = beside(pixels, between[:3, :3])
    tx, ty, tz = (float(value) for value in between[:3, 3])
    first, second = _normalised(pixels, before), _normalised(target, after)
    ray = torch.cat([first, torch.ones_like(first[:, :1])], dim=1) @ rotation.T
    c = second * tz - beside(second, [tx, ty])
    return c, ray[:, :2] - second * ray[:, 2:]


def inverse_depths(pixels: Tensor, target: Tensor, before: Camera, after: Camera) -> tuple[Tensor, Tensor]:
    """Least-squares inverse depth [N] in the first camera, and its information [N]: the inverse of its variance for an error of one pixel."""
    c, d = parallax_terms(pixels, target, before, after)
    squared = (c * c).sum(dim=1)
    return (c * d).sum(dim=1) / squared.clamp(min=1e-20), squared * float(after.K[0, 0]) ** 2


def translation_between(before: Camera, after: Camera) -> NDArray[np.float64]:
    """Where the second camera sees the first one's centre [3]; exactly 0 where it only turned or stood still."""
    moved = before.position - after.position
    return np.asarray(after.world_to_camera[:3, :3] @ np.where(np.abs(moved) < SMALLEST_SHIFT, 0.0, moved))


def _normalised(pixels: Tensor, camera: Camera) -> Tensor:
    focal = beside(pixels, [camera.K[0, 0], camera.K[1, 1]])
    return (pixels - beside(pixels, [camera.K[0, 2], camera.K[1, 2]])) / focal
