"""Tissue that breathes, seen by a scope that moves: where each point is, how it moves, and how well that is known.

A point's position at time t is its place at rest and, for each of a few frequencies f that all of the tissue shares, a cos(2 pi f t) + b sin(2 pi f t)
with vectors a and b of its own, which change smoothly over the surface. With known cameras the distance of each point and these vectors follow from
where the points were seen. Breathing and heart beat repeat themselves and the way of the scope does not; that is what tells them apart.

Gauss-Newton on the distances in the pictures, with Cauchy's weights; places at rest are eliminated (Schur complement), so that what is to be solved has
the vectors at the nodes of a coarse grid alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.grid_tracks import GridTracks
from gsplat_core.geometry.spline_grid import smoothness, splines

Array = NDArray[np.float64]

NODES = 9, 8
"""Of the grid of vectors, along the picture's width and height."""
OUTSIDE = 0.15
"""How far that grid goes beyond the picture, as a share of its side."""
AMPLITUDE = 0.04
"""How far tissue may be expected to move, relative to its distance (standard deviation)."""
BEND = 0.008
"""How far a vector may be expected to differ from what its neighbours on either side say, relative to the distance."""
RELIEF = 0.5
"""How far points may be expected from their median distance, relative to it."""
SPREAD_PX = 0.5
"""Errors well above this decide little (Cauchy's scale)."""
TRACK_PX = 0.35
"""Standard deviation of where a point is found ..."""
TOGETHER = 3.0
"""... and how many such errors are one and the same: neighbours in time err alike."""
ALIKE = 3.0
"""How many times larger errors of distances are than if all points erred by themselves: light that moves with the scope moves what it shines on alike."""
NEAREST, FARTHEST = 0.25, 4.0
"""Of the median distance: nothing is taken to be nearer or farther."""


@dataclass(frozen=True)
class PeriodicMotion:
    """What was found of `N` points."""

    frequencies_hz: tuple[float, ...]
    terms: Array
    """[N, 3, 1 + 2 F]: place at rest, then a and b of each frequency, in the world."""
    error: Array
    """[N]: standard deviation of the distance, relative to it."""
    cost: float
    """Mean of the robust errors; smaller is better."""

    def at(self, times_s: Array) -> Array:
        """Where the points are [T, N, 3]."""
        return np.einsum("njb,tb->tnj", self.terms, waves(times_s, self.frequencies_hz))


def waves(times_s: Array, frequencies_hz: tuple[float, ...]) -> Array:
    """[T, 1 + 2 F]: 1, then cosine and sine of each frequency."""
    angles = 2 * np.pi * np.outer(times_s, frequencies_hz)
    pairs = np.stack([np.cos(angles), np.sin(angles)], 2).reshape(len(times_s), -1)
    return np.concatenate([np.ones((len(times_s), 1)), pairs], 1)


def in_cameras(points: Array, poses: Array) -> Array:
    """Points [T, N, 3] in the coordinates of the cameras `poses` [T, 4, 4]."""
    return np.asarray(points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3])


def off_px(points: Array, tracks: GridTracks) -> Array:
    """How far points [T, N, 3] of the world are from where they were seen, in pixels [T, N, 2]."""
    local = in_cameras(points, tracks.poses)
    return np.asarray(tracks.focal_px * (local[..., :2] / local[..., 2:] - tracks.rays))


def fitted(
    tracks: GridTracks,
    frequencies_hz: tuple[float, ...],
    begin: Array | None = None,
    rounds: int = 8,
    nodes: tuple[int, int] = NODES,
) -> PeriodicMotion:
    """What explains the tracks best with these frequencies; with none of them nothing moves.

    begin: places at rest [N, 3]; None: on one sphere around the cameras, of the radius that fits best.
    """
    return _Fit(tracks, frequencies_hz, begin, nodes).run(rounds)


class _Fit:
    """One fit, while it is made."""

    def __init__(
        self, tracks: GridTracks, frequencies_hz: tuple[float, ...], begin: Array | None, nodes: tuple[int, int]
    ) -> None:
        self._tracks, self._frequencies, self._grid = tracks, frequencies_hz, nodes
        self._waves = waves(tracks.times_s, frequencies_hz)
        self._pairs = np.einsum("tb,tc->tbc", self._waves, self._waves).reshape(len(self._waves), -1)
        self._middle = len(tracks.times_s) // 2
        count, terms = tracks.rays.shape[1], self._waves.shape[1]
        self._terms = np.zeros((count, 3, terms))
        self._terms[:, :, 0] = _at_one_distance(tracks) if begin is None else begin
        self._distance = self._median_distance()
        self._cost = np.inf
        self._error = np.full(count, np.inf)

    def run(self, rounds: int) -> PeriodicMotion:
        for _ in range(rounds):
            self._step()
        self._weights(in_cameras(self._points(), self._tracks.poses))
        return PeriodicMotion(self._frequencies, self._terms, self._error, self._cost)

    def _points(self) -> Array:
        return np.einsum("njb,tb->tnj", self._terms, self._waves)

    def _median_distance(self) -> float:
        pose = self._tracks.poses[self._middle]
        return float(np.median(self._terms[:, :, 0] @ pose[2, :3] + pose[2, 3]))

    def _weights(self, local: Array) -> tuple[Array, Array]:
        """Errors [T, N, 2] in pixels and what each observation weighs [T, N]; notes the cost."""
        seen = self._tracks.seen
        off = self._tracks.focal_px * (local[..., :2] / local[..., 2:] - self._tracks.rays)
        squared = (off**2).sum(-1) / SPREAD_PX**2
        self._cost = float(np.log1p(squared)[seen].mean())
        return off, seen / (1 + squared)

    def _step(self) -> None:
        """One step of Gauss-Newton. Slopes are those of where points would be seen: taken from where they were seen, noise would be in them twice, and
        distances come out too short."""
        tracks, focal = self._tracks, self._tracks.focal_px
        local = in_cameras(self._points(), tracks.poses)
        local[..., 2] = np.maximum(local[..., 2], NEAREST * self._distance)
        off, weight = self._weights(local)
        rotation = tracks.poses[:, None, :3, :3]
        slope = (rotation[..., :2, :] - (local[..., :2] / local[..., 2:])[..., None] * rotation[..., 2:, :]) * (
            focal / local[..., 2]
        )[..., None, None]
        weighted = slope * (weight / (TRACK_PX**2 * TOGETHER))[..., None, None]
        count, terms = self._terms.shape[0], self._waves.shape[1]
        square = (weighted.swapaxes(-1, -2) @ slope).reshape(len(weight), -1)
        H = (square.T @ self._pairs).reshape(count, 3, 3, terms, terms).transpose(0, 1, 3, 2, 4)
        pull = np.einsum("tnij,tni->tnj", weighted, off).reshape(len(weight), -1)
        g = (pull.T @ self._waves).reshape(count, 3, terms)
        g = np.einsum("njbkc,nkc->njb", H, self._terms) - g
        self._solve(H, g)

    def _solve(self, H: Array, g: Array) -> None:
        """The terms with the smallest sum of squares H and g and of what is expected beforehand."""
        pose = self._tracks.poses[self._middle]
        axis, count = pose[2, :3], len(H)
        known = 1 / (RELIEF * self._distance) ** 2
        V = H[:, :, 0, :, 0] + known * (np.outer(axis, axis) + 1e-3 * np.eye(3))
        # Beforehand a point is as far along the axis as the median, and where it is across it.
        rest = self._terms[:, :, 0]
        expected = rest + np.outer(self._distance - (rest @ axis + pose[2, 3]), axis)
        v = g[:, :, 0] + known * expected @ (np.outer(axis, axis) + 1e-3 * np.eye(3))
        inverse = np.linalg.inv(V)
        moving = H.shape[2] - 1
        if not moving:
            self._terms[:, :, 0] = self._limited(np.einsum("nij,nj->ni", inverse, v))
            self._error = ALIKE * np.sqrt(np.einsum("i,nij,j->n", axis, inverse, axis)) / self._distance
            return
        U = H[:, :, 0, :, 1:].reshape(count, 3, 3 * moving)
        W = H[:, :, 1:, :, 1:].reshape(count, 3 * moving, 3 * moving)
        told = inverse @ U
        S = W - U.transpose(0, 2, 1) @ told
        s = g[:, :, 1:].reshape(count, -1) - np.einsum("nij,ni->nj", told, v)
        nodes = self._nodes()
        field, spread = self._field(S, s, nodes)
        vectors = nodes @ field
        self._terms[:, :, 1:] = vectors.reshape(count, 3, moving)
        self._terms[:, :, 0] = self._limited(
            np.einsum("nij,nj->ni", inverse, v) - np.einsum("nij,nj->ni", told, vectors)
        )
        along = np.einsum("i,nij->nj", axis, told)
        lever = np.einsum("np,nc->npc", along, nodes).reshape(count, -1)
        variance = np.einsum("i,nij,j->n", axis, inverse, axis) + ((lever @ spread) * lever).sum(1)
        self._error = ALIKE * np.sqrt(variance) / self._distance

    def _field(self, S: Array, s: Array, nodes: Array) -> tuple[Array, Array]:
        """Vectors at the nodes [nodes, 3 * 2 F], and the covariance of all of them, in the order (vector, node)."""
        size, count = S.shape[1], nodes.shape[1]
        whole = np.zeros((size, count, size, count))
        for row in range(size):
            for column in range(row, size):
                whole[row, :, column] = (nodes * S[:, row, column, None]).T @ nodes
                whole[column, :, row] = whole[row, :, column].T
        known = (
            smoothness(self._grid) / (BEND * self._distance) ** 2 + np.eye(count) / (AMPLITUDE * self._distance) ** 2
        )
        for row in range(size):
            whole[row, :, row] += known
        covariance = np.linalg.inv(whole.reshape(size * count, -1))
        field = covariance @ (s.T @ nodes).reshape(-1)
        return np.asarray(field.reshape(size, count).T), np.asarray(covariance)

    def _nodes(self) -> Array:
        """How much each point has of each node's vector [N, nodes]: cubic B-splines over the picture in the middle of the time."""
        pose = self._tracks.poses[self._middle]
        local = self._terms[:, :, 0] @ pose[:3, :3].T + pose[:3, 3]
        share = (local[:, :2] / local[:, 2:]) / self._tracks.extent / 2 + 0.5
        across, down = (
            splines((share[:, axis] + OUTSIDE) / (1 + 2 * OUTSIDE), count) for axis, count in enumerate(self._grid)
        )
        return np.asarray((across[:, :, None] * down[:, None, :]).reshape(len(local), -1))

    def _limited(self, rest: Array) -> Array:
        """No place at rest nearer or farther than anything is taken to be."""
        pose = self._tracks.poses[self._middle]
        local = rest @ pose[:3, :3].T + pose[:3, 3]
        depth = np.clip(local[:, 2], NEAREST * self._distance, FARTHEST * self._distance)
        ratio = np.where(local[:, 2] > 0, depth / np.maximum(local[:, 2], 1e-9), 1.0)
        local = np.column_stack([local[:, :2] * ratio[:, None], depth])
        return np.asarray((local - pose[:3, 3]) @ pose[:3, :3])


def _at_one_distance(tracks: GridTracks) -> Array:
    """Places [N, 3] at one distance from where each was first seen: the one that explains best where it was seen later."""
    first = tracks.seen.argmax(0)
    number = np.arange(len(first))
    pose = tracks.poses[first]
    ray = np.concatenate([tracks.rays[first, number], np.ones((len(first), 1))], 1)
    along = np.einsum("nji,nj->ni", pose[:, :3, :3], ray)
    centre = -np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3])
    rotation = tracks.poses[:, :3, :3]
    turned = np.einsum("tij,nj->tni", rotation, along)
    moved = np.einsum("tij,nj->tni", rotation, centre) + tracks.poses[:, None, :3, 3]
    # In the picture, inverse depth w: c w = d.
    c = moved[..., :2] - tracks.rays * moved[..., 2:]
    d = tracks.rays * turned[..., 2:] - turned[..., :2]
    c, d = c[tracks.seen], d[tracks.seen]
    inverse = float((c * d).sum() / max((c * c).sum(), 1e-300))
    radius = 1 / max(inverse, 1e-9 * float(np.sqrt((d * d).sum() / max((c * c).sum(), 1e-300))) + 1e-300)
    return np.asarray(centre + along * radius)
