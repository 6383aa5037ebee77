"""Rigid registration of a reconstruction to a reference surface such as a CT, and signed distances between them.

Point-to-plane ICP (Chen and Medioni 1991) with trimming (Chetverikov et al. 2002) uses only the closest pairs, because
a reconstruction covers part of the reference and contains structures that the reference lacks. The start is an initial
guess or three or more corresponding point pairs. Nearest neighbours come from k-d trees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.transfers import HostCopy, tensor_of

Array = NDArray[np.float64]
SAMPLES = 100_000
"""Approximate number of sample points spread over the mesh, among which the nearest neighbours of a point are searched."""
CANDIDATES = 6
"""Number of nearest samples whose triangles are tested exactly. Where triangles of very different sizes meet, the
closest point may be on a triangle without such a sample. The error is then less than the distance between samples.
"""
MOST_TRIANGLES = 5_000_000
LEAST_EXTENT, MOST_EXTENT = 1e-6, 1e9
"""Accepted range of a mesh's bounding-box diagonal, in its unit."""
EXACT_KD_TREE = 4
"""Number of FLANN's index type `KDTREE_SINGLE`, a single k-d tree with exact search."""


class Closest(NamedTuple):
    """Closest points on a mesh for N query points."""

    points: Array
    """Points on the mesh [N, 3]."""
    normals: Array
    """Unit normals [N, 3] of the triangles that contain the points."""
    distances: Array
    """Distances of the points to the mesh, not negative, [N]."""


class ClosestPoints:
    """Index for closest-point queries on a mesh.

    Raises:
        InvalidSetting: for a mesh without triangles of non-zero area, with too many triangles, or
            of an implausible size.
    """

    def __init__(self, vertices: Array, triangles: NDArray[np.integer]) -> None:
        if len(triangles) > MOST_TRIANGLES:
            raise InvalidSetting(f"the mesh has {len(triangles)} triangles; at most {MOST_TRIANGLES} are supported")
        corners = vertices[triangles].astype(np.float64).reshape(-1, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = 0.5 * np.linalg.norm(normals, axis=1)
        usable = areas > 1e-12 * max(float(areas.max(initial=0.0)), 1e-300)
        if not usable.any():
            raise InvalidSetting("the mesh has no triangles with an area; distances can only be measured to a surface")
        self._corners, areas = corners[usable], areas[usable]
        self._normals = normals[usable] / (2 * areas[:, None])
        self.extent = float(np.linalg.norm(np.ptp(self._corners.reshape(-1, 3), axis=0)))
        if not LEAST_EXTENT <= self.extent <= MOST_EXTENT:
            raise InvalidSetting(
                f"the mesh is {self.extent:.3g} across; the supported range is {LEAST_EXTENT:g} to {MOST_EXTENT:g}, export it again in millimetres"
            )
        samples, self._triangle = _sampled(self._corners, areas)
        self._centre = samples.mean(0)
        # float32 is precise enough to select candidates once the mesh is centred and scaled to unit size.
        import cv2

        self._samples = np.ascontiguousarray(((samples - self._centre) / self.extent).astype(np.float32))
        self._tree = cv2.flann_Index(  # type: ignore[attr-defined]
            self._samples, {"algorithm": EXACT_KD_TREE, "leaf_max_size": 10}
        )

    def closest(self, points: Array) -> Closest:
        """Return the closest points of the mesh to query points [N, 3]."""
        count = min(CANDIDATES, len(self._samples))
        asked = np.ascontiguousarray(((points - self._centre) / self.extent).astype(np.float32))
        found, _ = self._tree.knnSearch(asked, count, params={"checks": -1, "eps": 0.0, "sorted": True})
        best = Closest(np.zeros_like(points), np.zeros_like(points), np.full(len(points), np.inf))
        for candidate in range(count):
            triangle = self._triangle[found[:, candidate]]
            on = closest_on_triangles(points, self._corners[triangle])
            away = np.linalg.norm(points - on, axis=1)
            nearer = away < best.distances
            best.points[nearer], best.normals[nearer] = on[nearer], self._normals[triangle[nearer]]
            best.distances[nearer] = away[nearer]
        return best


def closest_on_triangles(points: Array, corners: Array) -> Array:
    """Return the closest point of each triangle [N, 3, 3] to the query point [N, 3] of the same row
    (Ericson 2005, "Real-Time Collision Detection", section 5.1.5).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = np.stack([_on_segment(points, a, b), _on_segment(points, b, c), _on_segment(points, c, a)], 1)
    nearest = np.linalg.norm(edges - points[:, None], axis=2).argmin(1)
    on_edge = edges[np.arange(len(points)), nearest]
    ab, ac, ap = b - a, c - a, points - a
    dot = lambda u, v: np.einsum("ij,ij->i", u, v)
    aa, ab_ac, cc, ap_ab, ap_ac = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    determinant = aa * cc - ab_ac**2
    has_area = determinant > 0  # degenerate triangles have no area; their closest point is on an edge
    determinant = np.where(has_area, determinant, 1.0)
    v, w = (cc * ap_ab - ab_ac * ap_ac) / determinant, (aa * ap_ac - ab_ac * ap_ab) / determinant
    inside = has_area & (v >= 0) & (w >= 0) & (v + w <= 1)
    return np.where(inside[:, None], a + v[:, None] * ab + w[:, None] * ac, on_edge)


def _on_segment(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.einsum("ij,ij->i", points - start, along) / np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
    return np.asarray(start + np.clip(share, 0, 1)[:, None] * along)


def _sampled(corners: Array, areas: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return points spread evenly over the triangles, at least one each, and their triangle indices."""
    # Each triangle is cut into n² equal parts; the centroid of each part is a sample.
    cuts = np.clip(np.ceil(np.sqrt(areas * SAMPLES / areas.sum())), 1, 400).astype(int)
    samples, owners = [], []
    for n in np.unique(cuts):
        chosen = np.flatnonzero(cuts == n)
        weights = _middles(int(n))
        samples.append(np.einsum("kc,tcd->tkd", weights, corners[chosen]).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(weights)))
    return np.concatenate(samples), np.concatenate(owners)


def _middles(n: int) -> Array:
    """Return barycentric coordinates [n², 3] of the centroids of a triangle's n² equal parts."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    two = np.array(upright + turned) / n
    return np.column_stack([two, 1 - two.sum(1)])


TRIM = 0.8
"""Default share of the pairs of closest points that the registration uses; the most distant pairs are left out."""
MOST_ROUNDS = 60
SETTLED = 1e-6
"""Displacement of the most displaced point in one ICP round, as a share of the surface's extent, below which the iteration ends."""
MOST_POINTS = 5000
"""Largest number of points that the registration uses; larger sets are subsampled."""


@dataclass(frozen=True)
class Registration:
    """Transform found by a registration, with its residual error."""

    transform: Array
    """Transform from the moved to the fixed surface's coordinates [4, 4]: rotation and translation,
    and `scale` if requested.
    """
    scale: float
    rounds: int
    rmse: float
    """Root mean square point-to-plane distance of the pairs of closest points that the registration used."""


@dataclass(frozen=True)
class Distances:
    """Statistics of signed point-to-surface distances, positive on the side of the surface's normals."""

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
    """Return the small rigid motion [4, 4] of points `here` that minimises their distances `gaps` along `normals`, to first order."""
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


NEIGHBOURS = 8
"""Default number of neighbours per point; fewer if there are fewer points."""


def nearest_others(points: Tensor, most: int = NEIGHBOURS) -> Tensor:
    """Return the indices of the nearest other points of `points` [N, 3], int64 [N, K], K at most `most`.

    Synchronises with the device. Ties are broken arbitrarily. A non-finite point has only itself as neighbour and is no
    neighbour of others.
    """
    host = HostCopy(points.detach().float()).numpy()
    finite = np.flatnonzero(np.isfinite(host).all(axis=1))
    count = min(most, max(len(finite) - 1, 0))
    others = np.repeat(np.arange(len(host))[:, None], count, axis=1)
    if count:
        there = np.ascontiguousarray(host[finite] - host[finite].mean(axis=0))
        tree = cv2.flann_Index(there, {"algorithm": EXACT_KD_TREE, "leaf_max_size": 10})  # type: ignore[attr-defined]
        found, _ = tree.knnSearch(there, count + 1, params={"checks": -1, "eps": 0.0, "sorted": True})
        # The search finds each point itself first, unless other points coincide with it. In that case drop the
        # last result instead.
        itself = found == np.arange(len(there))[:, None]
        itself[~itself.any(axis=1), -1] = True
        others[finite] = finite[found[~itself].reshape(len(there), count)]
    return tensor_of(np.ascontiguousarray(others.astype(np.int64)), points.device)
