"""Fit of periodic tissue motion and depth to point tracks of a moving scope with known poses.

The position of a point at time t is its rest position plus a cos(2 pi f t) + b sin(2 pi f t) for each of a few
frequencies f common to all tissue. The vectors a and b vary smoothly over the surface. Breathing and heart beat are
periodic and the scope's trajectory is not, which separates the two. The frequencies are searched for first.

The fit is Gauss-Newton on reprojection errors with Cauchy weights. Rest positions are eliminated (Schur complement),
so only the vectors at the nodes of a coarse grid remain as unknowns.

Tissue pulled by a tool biases the fit even with robust weights, because small deviations keep nearly full weight. A
pull towards the camera then corrupts the motion along the line of sight. Disturbed points deviate together, unlike
points with independent errors. Observations whose neighbours deviate on average are therefore excluded and the motion
is fitted again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.grid_tracks import GridTracks


def splines(share: Array, count: int) -> Array:
    """Return cubic B-spline weights [N, count] at positions 0 to 1; positions outside are clamped."""
    place = np.clip(share, 0, 1) * (count - 3)
    first = np.minimum(np.floor(place).astype(int), count - 4)
    t = place - first
    parts = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3
    weights = np.zeros((len(share), count))
    for offset, part in enumerate(parts):
        weights[np.arange(len(share)), first + offset] = part / 6
    return weights


def smoothness(grid: tuple[int, int]) -> Array:
    """Return the matrix [nodes, nodes] whose quadratic form is the sum of squared second
    differences along both sides of the grid.
    """
    second = [np.diff(np.eye(count), 2, axis=0) for count in grid]
    across, down = (each.T @ each for each in second)
    return np.asarray(np.kron(across, np.eye(grid[1])) + np.kron(np.eye(grid[0]), down))


Array = NDArray[np.float64]
NODES = 9, 8
"""Number of nodes of the grid of motion vectors along the picture's width and height."""
OUTSIDE = 0.15
"""Extension of the grid of motion vectors beyond each edge of the picture, as a share of the picture's side."""
AMPLITUDE = 0.04
"""Prior standard deviation of the motion's amplitudes, relative to the tissue's distance."""
BEND = 0.008
"""Prior standard deviation of a node's vector from the mean of its neighbours, relative to the distance."""
RELIEF = 0.5
"""Prior standard deviation of the difference of the points' depth from the median depth, relative to the median."""
SPREAD_PX = 0.5
"""Cauchy scale of reprojection errors, in pixels."""
TRACK_PX = 0.35
"""Standard deviation of a tracked position in pixels."""
TOGETHER = 3.0
"""Number of consecutive observations of a point that count as one, because tracking errors of neighbouring times are correlated."""
ALIKE = 3.0
"""Factor by which depth errors exceed those of independent points. Light that moves with the scope
shifts neighbouring points alike.
"""
NEAREST, FARTHEST = 0.25, 4.0
"""Bounds of a point's depth relative to the median depth."""


@dataclass(frozen=True)
class PeriodicMotion:
    """Fitted periodic motion of N tissue points: rest positions and a Fourier series of displacements."""

    frequencies_hz: tuple[float, ...]
    terms: Array
    """Rest position, then cosine and sine coefficients of each frequency, in the world [N, 3, 1 + 2 F]."""
    error: Array
    """Standard deviation of each point's distance, relative to the distance, [N]."""
    cost: float
    """Mean robust (Cauchy) cost of the reprojection errors; smaller is better."""

    def at(self, times_s: Array) -> Array:
        """Return the positions at times [T] in seconds, [T, N, 3]."""
        return np.einsum("njb,tb->tnj", self.terms, waves(times_s, self.frequencies_hz))


def waves(times_s: Array, frequencies_hz: tuple[float, ...]) -> Array:
    """Return 1, then cosine and sine of each frequency, at each time [T, 1 + 2 F]."""
    angles = 2 * np.pi * np.outer(times_s, frequencies_hz)
    pairs = np.stack([np.cos(angles), np.sin(angles)], 2).reshape(len(times_s), -1)
    return np.concatenate([np.ones((len(times_s), 1)), pairs], 1)


def in_cameras(points: Array, poses: Array) -> Array:
    """Transform points [T, N, 3] to the coordinates of the cameras `poses` [T, 4, 4]."""
    return np.asarray(points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3])


def off_px(points: Array, tracks: GridTracks) -> Array:
    """Return residuals predicted minus observed in pixels [T, N, 2] of world points [T, N, 3]."""
    local = in_cameras(points, tracks.poses)
    return np.asarray(tracks.focal_px * (local[..., :2] / local[..., 2:] - tracks.rays))


def fitted(
    tracks: GridTracks,
    frequencies_hz: tuple[float, ...],
    begin: Array | None = None,
    rounds: int = 8,
    nodes: tuple[int, int] = NODES,
) -> PeriodicMotion:
    """Fit the motion to tracks.

    Args:
        tracks: observations of N points.
        frequencies_hz: frequencies of the motion; empty for static tissue.
        begin: rest positions [N, 3] to start from; None for a sphere around the cameras with the best-fitting radius.
        rounds: number of Gauss-Newton steps.
        nodes: size of the vector grid.
    """
    return _Fit(tracks, frequencies_hz, begin, nodes).run(rounds)


class _Fit:
    """Current estimate and precomputed terms of one Gauss-Newton fit of periodic motion."""

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
        for left in reversed(range(rounds)):
            self._step(errors=left == 0)
        self._weights(in_cameras(self._points(), self._tracks.poses))
        return PeriodicMotion(self._frequencies, self._terms, self._error, self._cost)

    def _points(self) -> Array:
        return np.einsum("njb,tb->tnj", self._terms, self._waves)

    def _median_distance(self) -> float:
        pose = self._tracks.poses[self._middle]
        return float(np.median(self._terms[:, :, 0] @ pose[2, :3] + pose[2, 3]))

    def _weights(self, local: Array) -> tuple[Array, Array]:
        """Return residuals in pixels [T, N, 2] and weights [T, N], and store the cost."""
        seen = self._tracks.seen
        off = self._tracks.focal_px * (local[..., :2] / local[..., 2:] - self._tracks.rays)
        squared = (off**2).sum(-1) / SPREAD_PX**2
        self._cost = float(np.log1p(squared)[seen].mean())
        return off, seen / (1 + squared)

    def _step(self, errors: bool) -> None:
        """Do one Gauss-Newton step; with `errors`, also estimate the errors of the distances.

        Derivatives are taken at predicted positions. At observed positions their noise would correlate with the residual
        and bias distances to be too short.
        """
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
        self._solve(H, g, errors)

    def _solve(self, H: Array, g: Array, errors: bool) -> None:
        """Update the estimate to the minimum of the quadratic form with Hessian `H` and right side `g`, plus the priors."""
        pose = self._tracks.poses[self._middle]
        axis, count = pose[2, :3], len(H)
        known = 1 / (RELIEF * self._distance) ** 2
        V = H[:, :, 0, :, 0] + known * (np.outer(axis, axis) + 1e-3 * np.eye(3))
        # Prior mean of the rest position: the median depth along the optical axis, and the current position across it.
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
        gain = inverse @ U
        S = W - U.transpose(0, 2, 1) @ gain
        s = g[:, :, 1:].reshape(count, -1) - np.einsum("nij,ni->nj", gain, v)
        nodes = self._nodes()
        whole = self._system(S, nodes)
        field = np.linalg.solve(whole, (s.T @ nodes).reshape(-1)).reshape(s.shape[1], nodes.shape[1]).T
        vectors = nodes @ field
        self._terms[:, :, 1:] = vectors.reshape(count, 3, moving)
        self._terms[:, :, 0] = self._limited(
            np.einsum("nij,nj->ni", inverse, v) - np.einsum("nij,nj->ni", gain, vectors)
        )
        if not errors:
            return
        spread = np.linalg.inv(whole)
        along = np.einsum("i,nij->nj", axis, gain)
        lever = np.einsum("np,nc->npc", along, nodes).reshape(count, -1)
        variance = np.einsum("i,nij,j->n", axis, inverse, axis) + ((lever @ spread) * lever).sum(1)
        self._error = ALIKE * np.sqrt(variance) / self._distance

    def _system(self, S: Array, nodes: Array) -> Array:
        """Return the normal matrix of the motion vectors at the grid's nodes, in the order (vector, node), with their priors."""
        size, count = S.shape[1], nodes.shape[1]
        whole = np.zeros((size, count, size, count))
        for row in range(size):
            for column in range(row, size):
                block = (nodes * S[:, row, column, None]).T @ nodes
                whole[row, :, column], whole[column, :, row] = block, block.T
        known = (
            smoothness(self._grid) / (BEND * self._distance) ** 2 + np.eye(count) / (AMPLITUDE * self._distance) ** 2
        )
        for row in range(size):
            whole[row, :, row] += known
        return whole.reshape(size * count, -1)

    def _nodes(self) -> Array:
        """Return the weight of each node at each point [N, nodes], by cubic B-splines over the
        picture at the middle time.
        """
        pose = self._tracks.poses[self._middle]
        local = self._terms[:, :, 0] @ pose[:3, :3].T + pose[:3, 3]
        share = (local[:, :2] / local[:, 2:]) / self._tracks.extent / 2 + 0.5
        across, down = (
            splines((share[:, axis] + OUTSIDE) / (1 + 2 * OUTSIDE), count) for axis, count in enumerate(self._grid)
        )
        return np.asarray((across[:, :, None] * down[:, None, :]).reshape(len(local), -1))

    def _limited(self, rest: Array) -> Array:
        """Clamp depths of rest positions in the middle frame to `NEAREST` to `FARTHEST` times the median depth. Positions move
        along their rays.
        """
        pose = self._tracks.poses[self._middle]
        local = rest @ pose[:3, :3].T + pose[:3, 3]
        depth = np.clip(local[:, 2], NEAREST * self._distance, FARTHEST * self._distance)
        ratio = np.where(local[:, 2] > 0, depth / np.maximum(local[:, 2], 1e-9), 1.0)
        local = np.column_stack([local[:, :2] * ratio[:, None], depth])
        return np.asarray((local - pose[:3, 3]) @ pose[:3, :3])


def _at_one_distance(tracks: GridTracks) -> Array:
    """Return world positions [N, 3] on the rays of first observation, all at the same depth (z in that camera), the one
    that best explains the later observations.
    """
    first = tracks.seen.argmax(0)
    number = np.arange(len(first))
    pose = tracks.poses[first]
    ray = np.concatenate([tracks.rays[first, number], np.ones((len(first), 1))], 1)
    along = np.einsum("nji,nj->ni", pose[:, :3, :3], ray)
    centre = -np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3])
    rotation = tracks.poses[:, :3, :3]
    turned = np.einsum("tij,nj->tni", rotation, along)
    moved = np.einsum("tij,nj->tni", rotation, centre) + tracks.poses[:, None, :3, 3]
    # A point with the inverse depth w on its first observed ray projects to a later observed pixel if c w = d.
    c = moved[..., :2] - tracks.rays * moved[..., 2:]
    d = tracks.rays * turned[..., 2:] - turned[..., :2]
    c, d = c[tracks.seen], d[tracks.seen]
    inverse = float((c * d).sum() / max((c * c).sum(), 1e-300))
    radius = 1 / max(inverse, 1e-9 * float(np.sqrt((d * d).sum() / max((c * c).sum(), 1e-300))) + 1e-300)
    return np.asarray(centre + along * radius)


AROUND_PX = 24.0
"""Standard deviation in pixels of a point's neighbourhood, over which errors are averaged."""
CELL_PX = 4
"""Side in pixels of the cells in which points' deviations are summed before they are averaged over neighbourhoods."""
FAR_OFF_PX = 8.0
"""Cauchy scale in pixels; points with larger errors are mistracked or on the tool and have little
weight for their neighbours.
"""
LEAST_LEFT = 0.3
"""Smallest share of a point's observations that must remain after disturbed ones are excluded; otherwise all of them
are used.
"""
ROBUST_ROUNDS = 2
"""Number of refits that exclude disturbed observations."""


def fitted_undisturbed(tracks: GridTracks, motion: PeriodicMotion) -> PeriodicMotion:
    """Refit a motion without observations whose neighbours deviate on average, such as those of tissue pulled by a tool."""
    for _ in range(ROBUST_ROUNDS):
        disturbed = together_px(off_px(motion.at(tracks.times_s), tracks), tracks) > SPREAD_PX
        left = tracks.seen & ~disturbed
        left = np.where(left.sum(0) >= LEAST_LEFT * tracks.seen.sum(0), left, tracks.seen)
        motion = fitted(replace(tracks, seen=left), motion.frequencies_hz, motion.terms[:, :, 0])
    return motion


def together_px(off: Array, tracks: GridTracks) -> Array:
    """Return the length of the locally averaged error around each observation.

    Args:
        off: errors in pixels [T, N, 2].
        tracks: observations.

    Returns:
        Lengths in pixels [T, N].
    """
    half = np.array(tracks.extent) * tracks.focal_px
    columns, rows = np.ceil(2 * half / CELL_PX).astype(int)
    cells = np.clip(((tracks.rays * tracks.focal_px + half) / CELL_PX).astype(int), 0, [columns - 1, rows - 1])
    index = cells[..., 1] * columns + cells[..., 0]
    weight = tracks.seen / (1 + (off**2).sum(2) / FAR_OFF_PX**2)
    found = np.zeros(index.shape)
    for picture, where in enumerate(index):
        sums = [_gathered(weight[picture] * each, where, (rows, columns)) for each in (1.0, *off[picture].T)]
        mean = np.stack(sums[1:]) / np.maximum(sums[0], 1e-9)
        found[picture] = np.hypot(*mean.reshape(2, -1)[:, where])
    return found


def _gathered(values: Array, where: NDArray[np.integer], size: tuple[int, int]) -> Array:
    """Return sums of `values` [N] in the cells of a grid, blurred with a Gaussian, [rows, columns].

    `where` [N] is the flat cell index of each value; `size` is (rows, columns).
    """
    sums = np.bincount(where, values, size[0] * size[1]).reshape(size)
    return np.asarray(cv2.GaussianBlur(sums, (0, 0), AROUND_PX / CELL_PX, borderType=cv2.BORDER_CONSTANT))


BREATHING_HZ = 0.1, 0.8
HEART_HZ = 0.8, 3.0
LEAST_CYCLES = 0.6
"""Fewest cycles over the recording of the slowest frequency tried; slower motion cannot be distinguished from drift."""
STEP_CYCLES = 0.25
"""Spacing of the tried frequencies in cycles over the recording; closer frequencies are indistinguishable."""
COARSE, FINE = (5, 5), (8, 7)
"""Grid sizes (nodes along width and height) of the motion fits that compare frequencies: in the coarse search and near the optimum."""
POINTS, TIMES = 400, 48
"""Largest numbers of points and of times that the search for frequencies uses."""
ROUNDS = 4
BREATHES, BEATS = 0.9, 0.96
"""Largest ratio of the robust cost with a frequency to the cost without, from which breathing and
heart beat are accepted.
"""
AS_GOOD = 1.06
"""Ratio to the lowest robust cost up to which another frequency counts as equally plausible."""


@dataclass(frozen=True)
class Frequencies:
    """Frequencies of the tissue's motion, with the uncertainty of the depth."""

    hz: tuple[float, ...]
    """Empty for static tissue, otherwise the breathing frequency, or the breathing and heart frequencies."""
    error: float
    """Relative change of the tissue's depth between equally plausible frequencies."""


def found_in(tracks: GridTracks) -> Frequencies:
    """Find the frequencies that best explain the tracks.

    None are found if static tissue explains the tracks nearly as well, or the tracks are too short.
    """
    few = _few(tracks)
    still = fitted(few, (), rounds=2 * ROUNDS, nodes=COARSE)
    rest = still.terms[:, :, 0]
    length_s = float(few.times_s[-1] - few.times_s[0])
    step = STEP_CYCLES / length_s
    slowest = max(BREATHING_HZ[0], LEAST_CYCLES / length_s)
    tried = [_tried(few, (hz,), rest) for hz in _between((slowest, BREATHING_HZ[1]), step)]
    if not tried or (best := _best(tried)).cost > BREATHES * still.cost:
        return Frequencies((), 0.0)
    fastest = min(HEART_HZ[1], 0.4 / float(np.median(np.diff(few.times_s))))
    beats = [
        _tried(few, (*best.frequencies_hz, hz), best.terms[:, :, 0]) for hz in _between((HEART_HZ[0], fastest), step)
    ]
    if beats and _best(beats).cost < BEATS * best.cost:
        best = _best(beats)
    best = _tried(few, best.frequencies_hz, best.terms[:, :, 0], FINE)
    around = [best]
    for part in (step / 2, step / 4, step / 8, step / 16):
        for which in range(len(best.frequencies_hz)):
            for change in (-part, part):
                around.append(_tried(few, _changed(best, which, change), best.terms[:, :, 0], FINE))
            best = _best(around)
    return Frequencies(best.frequencies_hz, _spread([*around, best], best, few))


def _few(tracks: GridTracks) -> GridTracks:
    times, points = tracks.seen.shape
    some = np.linspace(0, points - 1, min(POINTS, points)).round().astype(int)
    return tracks.of(some, np.linspace(0, times - 1, min(TIMES, times)).round().astype(int))


def _tried(tracks: GridTracks, hz: tuple[float, ...], rest: Array, nodes: tuple[int, int] = COARSE) -> PeriodicMotion:
    return fitted(tracks, hz, begin=rest, rounds=ROUNDS, nodes=nodes)


def _best(tried: Iterable[PeriodicMotion]) -> PeriodicMotion:
    return min(tried, key=lambda each: each.cost)


def _between(band: tuple[float, float], step: float) -> list[float]:
    return np.arange(band[0], band[1], step).tolist()


def _changed(best: PeriodicMotion, which: int, change: float) -> tuple[float, ...]:
    hz = list(best.frequencies_hz)
    hz[which] = float(np.clip(hz[which] + change, *(BREATHING_HZ, HEART_HZ)[which]))
    return tuple(hz)


def _spread(tried: Iterable[PeriodicMotion], best: PeriodicMotion, tracks: GridTracks) -> float:
    """Return the largest median relative depth difference between the best fit and all equally plausible fits."""
    pose = tracks.poses[len(tracks.poses) // 2]
    depths = [each.terms[:, :, 0] @ pose[2, :3] + pose[2, 3] for each in tried if each.cost <= AS_GOOD * best.cost]
    return float(max(np.median(np.abs(depth / depths[-1] - 1)) for depth in depths))
