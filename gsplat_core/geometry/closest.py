"""The point of a triangle mesh that is closest to another point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting

Array = NDArray[np.float64]

SAMPLES = 100_000
"""Points spread over the mesh, about so many, among which the nearest are searched first."""
CANDIDATES = 6
"""So many of the nearest samples are looked at; the closest point is taken from their triangles. Where triangles of very different sizes meet it may be on
another one; the error is less than the distance between samples."""
MOST_TRIANGLES = 5_000_000
LEAST_EXTENT, MOST_EXTENT = 1e-6, 1e9
"""Diagonal of a mesh, in its unit."""
EXACT_KD_TREE = 4
"""FLANN's single k-d tree: an exact search; its other indices are approximate."""


class Closest(NamedTuple):
    """For each of N points."""

    points: Array
    """[N, 3] on the mesh."""
    normals: Array
    """[N, 3]: of the triangle."""
    distances: Array
    """[N], at least 0."""


class ClosestPoints:
    """A mesh that is asked for its closest points. Raises InvalidSetting for one without triangles of any area."""

    def __init__(self, vertices: Array, triangles: NDArray[np.integer]) -> None:
        if len(triangles) > MOST_TRIANGLES:
            raise InvalidSetting(f"the mesh has {len(triangles)} triangles; at most {MOST_TRIANGLES} are taken")
        corners = vertices[triangles].astype(np.float64).reshape(-1, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = 0.5 * np.linalg.norm(normals, axis=1)
        usable = areas > 1e-12 * max(float(areas.max(initial=0.0)), 1e-300)
        if not usable.any():
            raise InvalidSetting(
                "the mesh has no triangles with an area; a surface is needed to measure distances from"
            )
        self._corners, areas = corners[usable], areas[usable]
        self._normals = normals[usable] / (2 * areas[:, None])
        self.extent = float(np.linalg.norm(np.ptp(self._corners.reshape(-1, 3), axis=0)))
        if not LEAST_EXTENT <= self.extent <= MOST_EXTENT:
            raise InvalidSetting(
                f"the mesh is {self.extent:.3g} across; from {LEAST_EXTENT:g} to {MOST_EXTENT:g} is taken, export it again in millimetres"
            )
        samples, self._triangle = _sampled(self._corners, areas)
        self._centre = samples.mean(0)
        # float32 is enough to find candidates once the middle is taken off, and the size divided out.
        import cv2

        self._samples = np.ascontiguousarray(((samples - self._centre) / self.extent).astype(np.float32))
        self._tree = cv2.flann_Index(  # type: ignore[attr-defined]
            self._samples, {"algorithm": EXACT_KD_TREE, "leaf_max_size": 10}
        )

    def closest(self, points: Array) -> Closest:
        """The closest points of the mesh to points [N, 3]."""
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
    """The point of each triangle [N, 3, 3] that is closest to its point [N, 3] (Ericson 2005, section 5.1.5)."""
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
    """Points spread evenly over the triangles, at least one each, and the triangle of each."""
    # A triangle is cut into n² equal ones; the centroid of each is a sample.
    cuts = np.clip(np.ceil(np.sqrt(areas * SAMPLES / areas.sum())), 1, 400).astype(int)
    samples, owners = [], []
    for n in np.unique(cuts):
        chosen = np.flatnonzero(cuts == n)
        weights = _middles(int(n))
        samples.append(np.einsum("kc,tcd->tkd", weights, corners[chosen]).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(weights)))
    return np.concatenate(samples), np.concatenate(owners)


def _middles(n: int) -> Array:
    """Barycentric coordinates [n², 3] of the middles of the n² equal triangles that a triangle is cut into."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    two = np.array(upright + turned) / n
    return np.column_stack([two, 1 - two.sum(1)])
