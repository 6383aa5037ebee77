"""Robust reprojection error of camera poses and points, and the equations of its minimum, compiled, for the CPU in float64.

`gsplat_core.reference.bundle` computes them in plain torch. The equations are those of Triggs et al., "Bundle Adjustment: a
Modern Synthesis", 2000, sections 4.2 to 6.1, with Cauchy's weights. Results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.ops.arguments import require_shape


class Sights(NamedTuple):
    """Observations of C cameras and P points: observation m is the ray at which camera `camera[m]` sees point `point[m]`."""

    camera: Tensor
    """int32 [M]."""
    point: Tensor
    """int32 [M]."""
    rays: Tensor
    """float64 [M, 2], x / z and y / z in camera coordinates."""
    focal_px: float
    """Focal length in pixels, which converts differences of rays to residuals r in pixels."""


class BundleEquations(NamedTuple):
    """Normal equations of a bundle with the points eliminated. With the derivatives J and B of a residual by the camera's
    twist (translation, rotation vector) and by the point, and its weight w, sums over observations are H = Σ w JᵀJ,
    g = Σ w Jᵀr, V = Σ w BᵀB, h = Σ w Bᵀr. Damping d adds d (diagonal + 1e-9) to H and V.
    """

    S: Tensor
    """float64 [C, 6, C, 6], the cameras' matrix H - W V⁻¹ Wᵀ."""
    right: Tensor
    """float64 [C, 6], g - W V⁻¹ h. The twists are -S⁻¹ right."""
    inverse: Tensor
    """float64 [P, 3, 3], V⁻¹; NaN where V is not positive definite."""
    h: Tensor
    """float64 [P, 3]. The points move by -V⁻¹ (h + Wᵀ twists)."""
    coupling: Tensor
    """float64 [M, 6, 3], W = w JᵀB of each observation."""


def bundle_cost(poses: Tensor, points: Tensor, sights: Sights, *, spread_px: float, flat_px: float = 0.0) -> float:
    """Return Σ log(1 + |r / spread|²) over the observations, plus Σ (flat / spread (z / median z - 1))² over the points.

    Args:
        poses: float64 [C, 4, 4], world to camera.
        points: float64 [P, 3].
        sights: the observations. Depths below a thousandth of their median are replaced by it.
        spread_px: scale of Cauchy's weights, in pixels.
        flat_px: weight of the prior that all points have similar depths, in pixels.

    Raises:
        InvalidInput: for wrong shapes or dtypes, or tensors that are not on the CPU.
        RuntimeError: an index is out of range, or `spread_px` is not positive.
    """
    _check(poses, points, sights)
    return float(torch.ops.gsplat_core.bundle_cost(poses, points, *sights, spread_px, flat_px))


def bundle_equations(
    poses: Tensor, points: Tensor, sights: Sights, *, spread_px: float, damping: float, flat_px: float = 0.0
) -> BundleEquations:
    """Return the normal equations of `bundle_cost`. Arguments and errors as there.

    Args:
        damping: factor on the diagonals, which Levenberg-Marquardt adds.
    """
    _check(poses, points, sights)
    return BundleEquations(*torch.ops.gsplat_core.bundle_equations(poses, points, *sights, spread_px, flat_px, damping))


def place_camera(
    pose: Tensor, points: Tensor, rays: Tensor, focal_px: float, *, spread_px: float, rounds: int
) -> Tensor:
    """Return the pose of a camera with the lowest `bundle_cost` before fixed points, by Levenberg-Marquardt.

    Args:
        pose: float64 [4, 4], start value, world to camera.
        points: float64 [N, 3].
        rays: float64 [N, 2], observed ray of each point as x / z and y / z.
        focal_px: focal length in pixels.
        spread_px: scale of Cauchy's weights, in pixels.
        rounds: maximum number of steps.

    Raises:
        InvalidInput: for wrong shapes or dtypes, or tensors that are not on the CPU.
        RuntimeError: `spread_px` is not positive.
    """
    for name, values in (("pose", pose), ("points", points), ("rays", rays)):
        _check_doubles(name, values)
    count = points.shape[0] if points.ndim else -1
    require_shape("pose", pose, (4, 4), "[4, 4]")
    require_shape("points", points, (count, 3), "[N, 3]")
    require_shape("rays", rays, (count, 2), "[N, 2]")
    return torch.ops.gsplat_core.place_camera(pose, points, rays, focal_px, spread_px, rounds)


def _check_doubles(name: str, values: Tensor) -> None:
    if values.dtype != torch.float64 or values.device.type != "cpu":
        raise InvalidInput(f"{name} must be float64 on the CPU, got {values.dtype} on {values.device}")


def _check(poses: Tensor, points: Tensor, sights: Sights) -> None:
    for name, values in (("poses", poses), ("points", points), ("rays", sights.rays)):
        _check_doubles(name, values)
    count = sights.rays.shape[0] if sights.rays.ndim else -1
    for name, indices in (("camera", sights.camera), ("point", sights.point)):
        if indices.dtype != torch.int32:
            raise InvalidInput(f"{name} must be int32, got {indices.dtype}")
        require_shape(name, indices, (count,), "[M]")
    require_shape("poses", poses, (poses.shape[0] if poses.ndim else -1, 4, 4), "[C, 4, 4]")
    require_shape("points", points, (points.shape[0] if points.ndim else -1, 3), "[P, 3]")
    require_shape("rays", sights.rays, (count, 2), "[M, 2]")


@torch.library.register_fake("gsplat_core::bundle_cost")
def _cost_fake(poses: Tensor, *_: object) -> Tensor:
    return poses.new_empty(())


@torch.library.register_fake("gsplat_core::bundle_equations")
def _equations_fake(
    poses: Tensor, points: Tensor, camera: Tensor, *_: object
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    cameras, count = poses.shape[0], points.shape[0]
    sizes = ((cameras, 6, cameras, 6), (cameras, 6), (count, 3, 3), (count, 3), (camera.shape[0], 6, 3))
    S, right, inverse, h, coupling = (poses.new_empty(size) for size in sizes)
    return S, right, inverse, h, coupling


@torch.library.register_fake("gsplat_core::place_camera")
def _place_fake(pose: Tensor, *_: object) -> Tensor:
    return pose.new_empty(4, 4)
