"""Distance of the rendered surface from points triangulated from several pictures (TriaGS).

The matches come from the pictures alone. Projecting the rendered point into other views and triangulating it there
would return the same point for any surface.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.flow import render_depth, sampled
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.motion.image_motion import consistent_flow
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy, tensor_of

LEAST_ANGLE_DEG = 1.5
"""Least angle between the rays of two views at a point."""
LARGEST_ANGLE_DEG = 15.0
"""Largest angle of views that are chosen; beyond it optical flow finds few matches."""
MOST_VIEWS, LEAST_VIEWS = 8, 2
"""Largest and smallest number of other views in which a point is matched."""
SIGMA = 0.01
"""Scale of the robust loss relative to a point's depth."""
FAR = 0.25
"""Weight of the term that also attracts a distant surface."""
MOST_REPROJECTION_PX = 1.0
"""Largest root mean square distance of a triangulated point from its matches."""
KEPT_FRAMES = 512
"""Number of frames whose points are kept."""
STRIDE_PX = 4
"""Distance of the compared pixels."""


class Triangulated(NamedTuple):
    """Points seen by one frame, in its camera's axes."""

    pixels: Tensor
    """Pixel coordinates [P, 2] in the frame."""
    points: Tensor
    """Positions of triangulated points, [P, 3]."""


class TriangulationLoss:
    """Robust mean distance of the rendered surface from points triangulated in 2 to 8 other frames.

    For a camera that moves around tissue at rest: the points of a frame come from pictures of other times. Optical flow
    between the frames gives the matches, checked forward and backward. The points do not depend on the scene, so they
    are computed once for each frame. The gradient moves the scene's depth.
    """

    name: ClassVar[str] = "triangulation"
    default_weight: ClassVar[float] = 1.0

    def __init__(self) -> None:
        self._points: OrderedDict[tuple[int, bool], Triangulated] = OrderedDict()
        """Points by the number and eye of their frame."""
        self._missed: dict[tuple[int, bool], int] = {}
        """Number of other frames with which triangulation gave no points for a frame. It is tried again once there are
        more.
        """
        self._has_parallax = False

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean distance of the rendered surface from the observation's points; None without points. Raises
        InvalidSetting for a single camera at rest, and for other cameras than pinholes.
        """
        if observation.camera.model != "pinhole":
            raise InvalidSetting(
                f"the loss 'triangulation' is for pinhole cameras, this one is {observation.camera.model}; remove it from"
                " the losses"
            )
        target = self._target(scene, observation, context)
        if target is None:
            return None
        return consensus_loss(render_depth(scene, observation.camera), target, observation.camera)

    def _target(self, scene: Gaussians, observation: Observation, context: LossContext) -> Triangulated | None:
        """Return the points of a frame, triangulated on first use; None if there are too few views or points."""
        key = observation.seq, observation.of_right
        if key in self._points:
            return self._points[key]
        others = [one for one in context.frames if (one.seq, one.of_right) != key]
        if not self._has_parallax:
            check_parallax(observation, others)
            self._has_parallax = len(others) >= LEAST_VIEWS
        if len(others) < LEAST_VIEWS or self._missed.get(key) == len(others):
            return None
        depth = render_depth(scene.detach(), observation.camera).detach()
        seen = depth[depth > 0]
        found = triangulated(observation, chosen_views(observation, others, float(seen.median()) if len(seen) else 0.0))
        if found is None:
            self._missed[key] = len(others)
            return None
        self._points[key] = found
        if len(self._points) > KEPT_FRAMES:
            self._points.popitem(last=False)
        return found


def check_parallax(observation: Observation, others: Sequence[Observation]) -> None:
    """Raise InvalidSetting if all of several frames were taken from one place."""
    position = observation.camera.position
    if len(others) >= LEAST_VIEWS and all(np.allclose(one.camera.position, position, atol=1e-9) for one in others):
        raise InvalidSetting(
            "the loss 'triangulation' needs pictures from several places, but the camera does not move; use the loss 'flow'"
            " or depth"
        )


def consensus_loss(depth: Tensor, target: Triangulated, camera: Camera) -> Tensor:
    """Return the mean of r + `FAR` log(1 + |X - X*|² / σ²) over the triangulated points X* with rendered depth.

    r = |X - X*|² / (|X - X*|² + σ²) with σ 1 % of a point's depth. The second term gives a surface far from all points a
    gradient, which r alone does not.
    """
    _, K = camera.matrices(depth.device, depth.dtype)
    z = sampled(depth[..., None], target.pixels[None])[0, :, 0]
    rays = torch.cat([(target.pixels - K[:2, 2]) / K[[0, 1], [0, 1]], torch.ones_like(z)[:, None]], 1)
    known = z > 0
    squared = (rays * z[:, None] - target.points).square().sum(1) / target.points[:, 2].square()
    scaled = squared / SIGMA**2
    robust = scaled / (scaled + 1) + FAR * torch.log1p(scaled)
    return torch.where(known, robust, 0).sum() / known.sum().clamp(min=1)


def chosen_views(observation: Observation, others: Sequence[Observation], distance: float) -> list[Observation]:
    """Return up to 8 frames that see tissue at `distance` from directions 1.5 to 15° away, evenly spaced in angle.

    Pictures of another size are left out.
    """
    angles = []
    for one in others:
        baseline = float(np.linalg.norm(one.camera.position - observation.camera.position))
        angle = math.degrees(2 * math.atan2(baseline / 2, distance)) if distance > 0 else 0.0
        if LEAST_ANGLE_DEG <= angle <= LARGEST_ANGLE_DEG and one.image.shape == observation.image.shape:
            angles.append((angle, one.seq, one.of_right, one))
    angles.sort(key=lambda each: each[:3])
    if len(angles) > MOST_VIEWS:
        angles = [angles[round(k)] for k in np.linspace(0, len(angles) - 1, MOST_VIEWS)]
    return [one for *_, one in angles]


def triangulated(observation: Observation, others: Sequence[Observation]) -> Triangulated | None:
    """Triangulate pixels of a frame from their matches in other frames; None without any point."""
    if len(others) < LEAST_VIEWS:
        return None
    image, mask = (HostCopy(each).numpy() for each in (observation.image, observation.mask))
    rows, columns = (np.arange(STRIDE_PX // 2, n, STRIDE_PX) for n in image.shape[:2])
    grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    pixels = grid + 0.5
    matches = [pixels]
    for one in others:
        flow = consistent_flow(image, HostCopy(one.image).numpy(), mask, HostCopy(one.mask).numpy())
        matches.append(pixels + flow[grid[:, 1], grid[:, 0]])
    seen = np.stack(matches, 1)
    cameras = [observation.camera, *(one.camera for one in others)]
    world, reliable = triangulate(seen.astype(np.float64), cameras)
    if not reliable.any():
        return None
    pose = observation.camera.world_to_camera
    local = world[reliable] @ pose[:3, :3].T + pose[:3, 3]
    device = observation.image.device
    return Triangulated(*(tensor_of(each.astype(np.float32), device) for each in (pixels[reliable], local)))


def triangulate(
    matches: NDArray[np.float64], cameras: Sequence[Camera]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Triangulate points linearly from their pixels (Hartley and Zisserman 2004, section 12.2).

    The projection matrices are divided by their Frobenius norms, so that no view dominates.

    Args:
        matches: pixels [P, V, 2], the first view's always known; NaN where a view has no match.
        cameras: pinhole cameras of the V views.

    Returns:
        World points [P, 3], and which of them are reliable, bool [P]: at least two other views at 1.5° or more, in
        front of all views, and within 1 px (root mean square) of the matches.
    """
    P = np.stack([camera.K @ camera.world_to_camera[:3] for camera in cameras])
    scaled = P / np.linalg.norm(P, axis=(1, 2), keepdims=True)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(matches).all(-1))
    pixels = np.where(known[..., None], matches, 0)
    rows = pixels[..., None] * scaled[None, :, 2:3] - scaled[None, :, :2]
    rows = np.where(known[..., None, None], rows, 0).reshape(len(matches), -1, 4)
    _, _, v = np.linalg.svd(rows, full_matrices=rows.shape[1] < 4)
    homogeneous = v[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        points = homogeneous[:, :3] / homogeneous[:, 3:]
        image = np.einsum("vij,pj->pvi", P, np.concatenate([points, np.ones((len(points), 1))], 1))
        squared = ((image[..., :2] / image[..., 2:] - pixels) ** 2).sum(-1)
        towards = points[:, None] - np.stack([camera.position for camera in cameras])
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        angles = np.degrees(np.arccos(np.clip((towards * towards[:, :1]).sum(-1), -1, 1)))
    wide = known & (angles >= LEAST_ANGLE_DEG)
    error = np.where(known, squared, 0).sum(1) / known.sum(1).clip(1)
    reliable = (wide[:, 1:].sum(1) >= LEAST_VIEWS) & (error <= MOST_REPROJECTION_PX**2)
    reliable &= np.isfinite(points).all(1) & np.where(known, image[..., 2] > 0, True).all(1)
    return points, reliable
