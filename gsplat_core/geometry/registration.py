"""Rigid registration of a reconstruction to a reference surface such as a CT, and signed distances
between them.

Point-to-plane ICP (Chen and Medioni 1991) with trimming (Chetverikov et al. 2002). Only the closest
pairs are used, because a reconstruction covers part of the reference and contains structures that
it lacks. The start is an initial guess or three or more corresponding point pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.closest import ClosestPoints

Array = NDArray[np.float64]

TRIM = 0.8
"""Share of the pairs used, closest first."""
MOST_ROUNDS = 60
SETTLED = 1e-6
"""Largest displacement of a point in one round, as a share of the surface's extent, below which the
iteration ends.
"""
MOST_POINTS = 5000
"""Largest number of points used; larger sets are subsampled."""


@dataclass(frozen=True)
class Registration:
    """Result of a registration."""

    transform: Array
    """Transform from the moved to the fixed surface's coordinates [4, 4]: rotation and translation,
    and `scale` if requested.
    """
    scale: float
    rounds: int
    rmse: float
    """Root mean square point-to-plane distance of the pairs used."""


@dataclass(frozen=True)
class Distances:
    """Statistics of signed point-to-surface distances, positive on the side of the surface's
    normals.
    """

    mean: float
    median: float
    absolute_p50: float
    absolute_p90: float
    absolute_p95: float
    rmse: float
    inlier_share: float
    """Share of the points closer than `inlier_distance`."""
    inlier_distance: float
    points: int


def from_pairs(moved: Array, fixed: Array, *, with_scale: bool = False) -> Array:
    """Return the least-squares transform [4, 4] between corresponding points (Umeyama 1991).

    Args:
        moved: points to move [K, 3].
        fixed: corresponding target points [K, 3].
        with_scale: estimate a scale as well.

    Raises:
        InvalidSetting: for fewer than three pairs, or for collinear points.
    """
    if moved.shape != fixed.shape or moved.ndim != 2 or moved.shape[1] != 3 or len(moved) < 3:
        raise InvalidSetting(
            f"three or more pairs of points are needed, got {list(moved.shape)} and {list(fixed.shape)}"
        )
    centre_moved, centre_fixed = moved.mean(0), fixed.mean(0)
    a, b = moved - centre_moved, fixed - centre_fixed
    for points in (a, b):
        sizes = np.linalg.svd(points, compute_uv=False)
        if not sizes[1] > 1e-6 * max(sizes[0], 1e-300):
            raise InvalidSetting("the points of the pairs are collinear; add pairs off their common line")
    u, sizes, v = np.linalg.svd(b.T @ a)
    proper = np.diag([1.0, 1.0, math.copysign(1.0, np.linalg.det(u @ v))])
    rotation = u @ proper @ v
    scale = float((sizes * np.diag(proper)).sum() / (a * a).sum()) if with_scale else 1.0
    transform = np.eye(4)
    transform[:3, :3] = scale * rotation
    transform[:3, 3] = centre_fixed - scale * rotation @ centre_moved
    return transform


def moved_by(transform: Array, points: Array) -> Array:
    """Apply a transform [4, 4] to points [N, 3]."""
    return np.asarray(points @ transform[:3, :3].T + transform[:3, 3])


def register(points: Array, surface: ClosestPoints, initial: Array | None = None, trim: float = TRIM) -> Registration:
    """Register points to a surface by ICP, which converges to the nearest local minimum.

    Args:
        points: points to move [N, 3].
        surface: target surface.
        initial: initial transform [4, 4], None for the identity. Its error must be below about a
            quarter of the size of the surface's detail.
        trim: share of the pairs used, 0.1 to 1.

    Raises:
        InvalidSetting: for a bad `trim`, too few points, or a surface without a unique solution,
            such as a plane or a sphere.
    """
    if not 0.1 <= trim <= 1:
        raise InvalidSetting(f"trim is {trim:g}; it must be from 0.1 to 1")
    if len(points) < 12:
        raise InvalidSetting(f"a registration needs at least 12 points, got {len(points)}")
    chosen = points[:: -(-len(points) // MOST_POINTS)]
    transform = np.eye(4) if initial is None else initial.copy()
    extent = float(np.linalg.norm(np.ptp(chosen, axis=0)))
    rmse, rounds, last = math.inf, 0, False
    while not last and rounds < MOST_ROUNDS:
        rounds += 1
        here = moved_by(transform, chosen)
        found = surface.closest(here)
        gaps = np.einsum("ij,ij->i", here - found.points, found.normals)
        keep = np.argsort(found.distances, kind="stable")[: max(12, int(trim * len(here)))]
        rmse = math.sqrt(float(np.mean(gaps[keep] ** 2)))
        step = _step(here[keep], found.normals[keep], gaps[keep])
        transform = step @ transform
        last = float(np.abs(moved_by(step, here) - here).max()) < SETTLED * extent
    scale = float(np.cbrt(np.linalg.det(transform[:3, :3])))
    return Registration(transform, scale, rounds, rmse)


def _step(here: Array, normals: Array, gaps: Array) -> Array:
    """Return the small rigid motion that minimises point-to-plane distances."""
    import cv2

    centre = here.mean(0)
    size = max(float(np.linalg.norm(here - centre, axis=1).mean()), 1e-12)
    rows = np.hstack([np.cross(here - centre, normals) / size, normals])
    matrix = rows.T @ rows
    least, *_, most = np.linalg.eigvalsh(matrix)
    if not least > 1e-6 * most:
        raise InvalidSetting(
            "the surfaces slide on each other: they are too flat or too round for a registration; give pairs of points"
        )
    solution = np.linalg.solve(matrix, -rows.T @ gaps)
    rotation, _ = cv2.Rodrigues(solution[:3] / size)
    step = np.eye(4)
    step[:3, :3] = rotation
    step[:3, 3] = centre + solution[3:] - rotation @ centre
    return step


def distances(points: Array, surface: ClosestPoints, inlier_distance: float) -> tuple[Array, Distances]:
    """Return signed distances [N] of points [N, 3] from a surface, and their statistics."""
    found = surface.closest(points)
    side = np.sign(np.einsum("ij,ij->i", points - found.points, found.normals))
    signed = found.distances * np.where(side == 0, 1, side)
    absolute = np.abs(signed)
    p50, p90, p95 = (float(value) for value in np.quantile(absolute, (0.5, 0.9, 0.95)))
    summary = Distances(
        mean=float(signed.mean()), median=float(np.median(signed)), absolute_p50=p50, absolute_p90=p90, absolute_p95=p95,
        rmse=math.sqrt(float(np.mean(signed**2))), inlier_share=float(np.mean(absolute < inlier_distance)),
        inlier_distance=inlier_distance, points=len(points),
    )  # fmt: skip
    return signed, summary
