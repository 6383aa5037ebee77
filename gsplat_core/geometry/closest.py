"""Closest points on a triangle mesh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting

Array = NDArray[np.float64]

SAMPLES = 100_000
"""Approximate number of samples spread over the mesh for the nearest-neighbour search."""
CANDIDATES = 6
"""Nearest samples whose triangles are tested exactly. The closest point may be on another triangle
where triangles of very different sizes meet. The error is then less than the distance between
samples.
"""
MOST_TRIANGLES = 5_000_000
LEAST_EXTENT, MOST_EXTENT = 1e-6, 1e9
"""Accepted range of a mesh's bounding-box diagonal, in its unit."""
EXACT_KD_TREE = 4
"""FLANN's exact single k-d tree; its other indices are approximate."""


class Closest(NamedTuple):
    """Closest points on a mesh for N query points."""

    points: Array
    """Points on the mesh [N, 3]."""
    normals: Array
    """Unit normals [N, 3] of the triangles that contain the points."""
    distances: Array
    """Non-negative distances [N]."""


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
        # float32 is precise enough for candidates once the mesh is centred and scaled to unit size.
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
    determinant = np.maximum(aa * cc - ab_ac**2, 1e-300)
    v, w = (cc * ap_ab - ab_ac * ap_ac) / determinant, (aa * ap_ac - ab_ac * ap_ab) / determinant
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    return np.where(inside[:, None], a + v[:, None] * ab + w[:, None] * ac, on_edge)


def _on_segment(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.einsum("ij,ij->i", points - start, along) / np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
    return np.asarray(start + np.clip(share, 0, 1)[:, None] * along)


def _sampled(corners: Array, areas: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return points spread evenly over the triangles, at least one each, and their triangle
    indices.
    """
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
