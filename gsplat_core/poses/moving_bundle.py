"""Bundle adjustment of cameras in front of periodically moving tissue.

The position of a point is its rest position plus the sum over waves w(t) of w(t) times a vector. Waves are the cosines
and sines of phases. Breathing pauses, has unequal halves and a changing rate, so the phase of each frame is estimated
too (`Rhythm`). Cameras, phases, rest positions and vectors are estimated together by Levenberg-Marquardt, with rest
positions eliminated (Schur complement). The unit of length is the tissue's median distance.

A tool moves tissue over a large part of the picture in the same direction. The loss of Geman and McClure limits the cost
of such observations, so they have less influence on the cameras than with Cauchy's loss.

The vectors vary smoothly over the surface and are given at nodes among its points (`SurfaceField`). Their prior is a
Gaussian random field with a linear part, which includes rigid motion, and a local part with a correlation length
(kriging with a linear trend).

Pictures show the scope relative to the tissue, so rigid motion common to both at a breathing frequency is ambiguous.
The prior of the trajectory resolves it (`TrajectoryPrior`). The trajectory is a Gaussian process with a Matérn kernel
of order 7/2. The kernel's length and noise are learned from the trajectory by restricted maximum likelihood, excluding
the component at the given frequencies. A trajectory without that component is then more likely. The remaining
uncertainty decreases with the length of the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.machine import one_thread
from gsplat_core.poses.bundle import FIRST_DAMPING, descend, diagonal_of, ray_derivatives, summed
from gsplat_core.poses.se3 import exp, hat, log

LENGTHS_S = (0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6, 6.0, 8.0, 12.0)
"""Candidates for the correlation length in seconds of the Gaussian process of the trajectory (Matérn kernel)."""
NOISES = (0.003, 0.01, 0.03, 0.1)
"""Candidates for the noise of the trajectory's Gaussian process, relative to its amplitude."""
PLACES, TURNS = slice(0, 3), slice(3, 6)
"""Slices of the six camera coordinates, positions and rotations; each group has one kernel of the trajectory's Gaussian process."""


@dataclass(frozen=True)
class TrajectoryPrior:
    """Prior of a camera trajectory, a normal distribution of the cameras' coordinates (`coordinates`)."""

    precision: Tensor
    """Precision (inverse covariance) matrix over the cameras for each of the six camera coordinates, [6, C, C]."""
    uncertain: float
    """Root mean square uncertainty of the camera positions' motion at the given frequencies, in units of the tissue's
    distance.
    """

    @one_thread()
    def cost(self, poses: Tensor) -> float:
        """Return the negative log prior of poses [C, 4, 4], up to a constant."""
        y, _ = coordinates(poses)
        return 0.5 * float(torch.einsum("tj,jts,sj->", y, self.precision, y))

    @one_thread()
    def terms(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Return the Gauss-Newton matrix [6 C, 6 C] and gradient [6 C] of the cost by twists of the cameras."""
        y, by_twist = coordinates(poses)
        pushed = torch.einsum("jts,sj->tj", self.precision, y)
        matrix = torch.einsum("jts,tja,sjb->tasb", self.precision, by_twist, by_twist)
        slope = torch.einsum("tj,tja->ta", pushed, by_twist)
        return matrix.reshape(6 * len(poses), -1), slope.reshape(-1)


def coordinates(poses: Tensor) -> tuple[Tensor, Tensor]:
    """Return camera coordinates [C, 6] and their derivatives by twists of the cameras [C, 6, 6].

    The first three coordinates are the camera's position in the world, in units of the tissue's distance. The other
    three are the rotation vector of its orientation relative to that of the middle camera, in radians.
    """
    turned = poses[:, :3, :3].transpose(1, 2)
    place = -(turned @ poses[:, :3, 3:])[:, :, 0]
    relative = torch.eye(4, dtype=poses.dtype).repeat(len(poses), 1, 1)
    relative[:, :3, :3] = turned[len(poses) // 2].T @ turned
    vector = log(relative)[:, 3:]
    cross = hat(vector)
    by_twist = torch.zeros(len(poses), 6, 6, dtype=poses.dtype)
    by_twist[:, :3, :3] = -turned
    by_twist[:, 3:, 3:] = -(torch.eye(3, dtype=poses.dtype) + 0.5 * cross + cross @ cross / 12)
    return torch.cat([place, vector], 1), by_twist


@one_thread()
def learned_from(poses: Tensor, times_s: Tensor, waves: Tensor) -> TrajectoryPrior:
    """Learn the prior from a trajectory.

    Args:
        poses: world-to-camera poses [C, 4, 4].
        times_s: times in seconds [C].
        waves: cosines and sines [C, B] whose component is excluded.
    """
    y, _ = coordinates(poses)
    one = torch.ones(len(y), 1, dtype=y.dtype)
    apart = (times_s[:, None] - times_s).abs()
    best: list[_Smoothness | None] = [None, None]
    for length_s in LENGTHS_S:
        smooth = _matern(apart / length_s)
        for noise in NOISES:
            factor = torch.linalg.cholesky(smooth + noise**2 * torch.eye(len(y), dtype=y.dtype))
            lines, both = (
                torch.linalg.solve_triangular(factor, part, upper=False) for part in (torch.cat([one, waves], 1), y)
            )
            basis, triangle = torch.linalg.qr(lines)
            left = both - basis @ (basis.T @ both)
            free = len(y) - lines.shape[1]
            scale = (left.square().sum(0) / free).clamp(min=1e-16)
            shared = factor.diagonal().log().sum() + triangle.diagonal().abs().log().sum()
            likelihood = -0.5 * free * scale.log() - shared
            for kind, which in enumerate((PLACES, TURNS)):
                likely = float(likelihood[which].sum())
                before = best[kind]
                if before is None or likely > before.likelihood:
                    best[kind] = _Smoothness(likely, factor, triangle, scale)
    places, turns = best
    assert places is not None and turns is not None
    along = torch.cat([0 * one, waves], 1)
    return TrajectoryPrior(
        torch.cat([places.precision(one)[PLACES], turns.precision(one)[TURNS]]),
        float(places.variance(along)[PLACES].sum().sqrt()),
    )


@dataclass(frozen=True)
class _Smoothness:
    """Candidate kernel of the trajectory's Gaussian process, and the restricted likelihood of the trajectory with it."""

    likelihood: float
    factor: Tensor
    """Cholesky factor of the kernel matrix [C, C]."""
    triangle: Tensor
    """Triangular QR factor of the columns [1, waves], whitened by `factor`, [1 + B, 1 + B]."""
    scale: Tensor
    """Variance of each camera coordinate in the trajectory prior, by which the kernel matrix is multiplied, [6]."""

    def precision(self, one: Tensor) -> Tensor:
        """Return the precision matrices [6, C, C] of the camera coordinates, for which a constant offset costs nothing.

        `one` is a column of ones [C, 1].
        """
        inverse = torch.cholesky_inverse(self.factor)
        inverse = inverse - (inverse @ one) @ (one.T @ inverse) / inverse.sum()
        return inverse / self.scale[:, None, None]

    def variance(self, along: Tensor) -> Tensor:
        """Return the variance of each coordinate's component along the waves, averaged over time, [6]."""
        projected = torch.linalg.solve_triangular(self.triangle.T, along.T, upper=False)
        return self.scale * projected.square().sum(0).mean()


def _matern(apart: Tensor) -> Tensor:
    r = 7**0.5 * apart
    return (1 + r + 0.4 * r**2 + r**3 / 15) * torch.exp(-r)


LINEAR = 0.2
"""Prior standard deviation of the linear part of the tissue's motion field, in units of the median depth."""
LOCAL = 0.03
"""Prior standard deviation of the local part of the motion field, in units of the median depth."""
LENGTH = 0.3
"""Correlation length of the local part of the motion field, in units of the median depth."""
APART = 0.13
"""Smallest distance between nodes of the motion field, in units of the median depth. Larger if there would be more than
`MOST_NODES` nodes.
"""
MOST_NODES = 32
JITTER = 1e-6
"""Share of the mean variance that is added to the diagonal of the nodes' covariance, so that it can be inverted."""


@dataclass(frozen=True)
class SurfaceField:
    """Nodes on the tissue surface at which a smooth field of motion vectors is given, and the prior of the field."""

    nodes: Tensor
    """Positions of the field's nodes, [M, 3]."""
    middle: Tensor
    """Median of the point positions from which the nodes were selected, [3]."""
    stiffness: Tensor
    """Inverse covariance [M, M]; v' stiffness v / 2 is the negative log prior of values v at the nodes."""

    @classmethod
    @one_thread()
    def over(cls, points: Tensor, most: int = MOST_NODES) -> SurfaceField:
        """Create a field with at most `most` nodes spread over points [P, 3]."""
        middle = points.median(0).values
        nodes = _spread(points, middle, most)
        return cls(nodes, middle, torch.linalg.inv(_settled(_covariance(nodes, nodes, middle))))

    @one_thread()
    def influence(self, points: Tensor) -> Tensor:
        """Return interpolation weights [P, M] of the nodes' vectors at points [P, 3]."""
        return _covariance(points, self.nodes, self.middle) @ self.stiffness


def _covariance(first: Tensor, second: Tensor, middle: Tensor) -> Tensor:
    first, second = first - middle, second - middle
    linear = LINEAR**2 * (1 + first @ second.T)
    return linear + LOCAL**2 * torch.exp(-0.5 * (torch.cdist(first, second) / LENGTH).square())


def _settled(covariance: Tensor) -> Tensor:
    return covariance + JITTER * covariance.diagonal().mean() * torch.eye(len(covariance), dtype=covariance.dtype)


def _spread(points: Tensor, middle: Tensor, most: int) -> Tensor:
    """Return at most `most` points selected by farthest-point sampling, starting with the one nearest to `middle`."""
    chosen = [int((points - middle).norm(dim=1).argmin())]
    away = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < most and float(away.max()) > APART:
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[chosen[-1]]).norm(dim=1))
    return points[chosen]


SIGMA = 0.002
"""Standard deviation of the tracking error of an observed ray (x / z). It corresponds to 0.6 pixels at a picture width of 320 and includes
the correlation of errors over time.
"""
RELIEF = 0.3
"""Prior standard deviation of the points' depth from their median, in units of the median depth."""
NEAREST = 0.05
"""Smallest depth used in projections, in units of the median depth."""
HELD = 1e3
"""Stiffness, in units of 1 / `SIGMA`, that keeps steps from changing the rigid part of the tissue's motion. It is used
if there is no trajectory prior.
"""


RATE, RATE_PERIODS = (0.5, 0.03), (1 / 6, 2.0)
"""Prior of the changing breathing rate and heart rate (in this order): standard deviation relative to the mean rate, and correlation
time in mean periods.
"""
PHASE = 1.0
"""Prior standard deviation of the phases from those of a constant rate, in radians."""
OFFSET = 0.05
"""Prior standard deviation of the mean difference from the phases of a constant rate, in radians. It is small because
the motion vectors can represent a constant phase offset.
"""


@dataclass(frozen=True)
class Rhythm:
    """Phases of the waves, and their Gaussian prior: a random walk around the phase of a constant rate."""

    phases: Tensor
    """Estimated phase of each frequency at each camera's time, in radians, [C, F]."""
    expected: Tensor
    """Phases that constant rates would have at the cameras' times, in radians, [C, F]."""
    precision: Tensor
    """Prior precision matrices of `phases` - `expected`, one per wave frequency, [F, C, C]."""

    @classmethod
    def steady(cls, times_s: Tensor, frequencies_hz: Sequence[float]) -> Rhythm:
        """Start at constant rates: breathing, and the heart if there are two frequencies.

        Args:
            times_s: float64 [C], time of each camera in seconds.
            frequencies_hz: mean frequencies in Hz.
        """
        count, hz = len(times_s), torch.tensor(frequencies_hz, dtype=torch.float64)
        expected = 2 * torch.pi * times_s[:, None] * hz
        step = torch.eye(count, dtype=torch.float64).diff(dim=0)
        level = torch.eye(count, dtype=torch.float64) / (count * PHASE**2) + 1 / (count * OFFSET) ** 2
        precision = []
        for rate, deviation, periods in zip(hz.tolist(), RATE, RATE_PERIODS, strict=False):
            variance = (2 * torch.pi * rate * deviation) ** 2 * times_s.diff() * periods / rate
            precision.append(level + step.T @ (step / variance[:, None]))
        return cls(expected, expected, torch.stack(precision))

    @property
    def waves(self) -> Tensor:
        """Cosine and sine of each phase, [C, 2 F]."""
        return waves_of(self.phases)

    @property
    def slopes(self) -> Tensor:
        """Derivatives of the waves (cosine and sine of a phase) by the phase, [C, F, 2]."""
        return torch.stack([-self.phases.sin(), self.phases.cos()], 2)

    def pull(self) -> Tensor:
        """Return the gradient of the negative log prior by the phases, [C, F]."""
        return torch.einsum("fcd,df->cf", self.precision, self.phases - self.expected)

    def cost(self) -> float:
        """Return the negative log prior, up to a constant."""
        return 0.5 * float(((self.phases - self.expected) * self.pull()).sum())

    def moved(self, change: Tensor) -> Rhythm:
        """Return the rhythm with its phases changed by `change` [C, F], limited to `MOST_TURN` radians."""
        return replace(self, phases=self.phases + change.clamp(-MOST_TURN, MOST_TURN))


def waves_of(phases: Tensor) -> Tensor:
    """Return cosine and sine of each phase [C, F] as [C, 2 F]."""
    return torch.stack([phases.cos(), phases.sin()], 2).flatten(1)


WEAK_DAMPING = 1e-6
"""Damping of the first step with a prior of the trajectory. Scope motion that could be tissue motion changes only the
cost of the prior, so a larger damping nearly stops it.
"""
MOST_TURN = 0.7
"""Largest change of a phase in one step, in radians."""


@dataclass(frozen=True)
class MovingBundle:
    """Bundle adjustment problem: camera poses, periodically moving points and their observations; all float64."""

    poses: Tensor
    """World-to-camera poses [C, 4, 4]; the first one is fixed."""
    rest: Tensor
    """Rest positions [P, 3] in the world."""
    amplitudes: Tensor
    """Motion vectors at the field's nodes, one for each wave, [M, 3, B]."""
    camera: Tensor
    """Camera index of each observation, int64 [K]."""
    point: Tensor
    """Point index of each observation, int64 [K]."""
    rays: Tensor
    """Observed rays as x / z and y / z, [K, 2]."""
    waves: Tensor
    """Value of each wave at each camera's time, [C, B]."""
    influence: Tensor
    """Weight of each node's vector at each point, [P, M]."""
    field: SurfaceField
    """Nodes of the field of motion vectors, and the field's prior."""
    rhythm: Rhythm | None = None
    """Phases of the waves, which the adjustment estimates; None if the waves are given and fixed."""

    def places(self) -> Tensor:
        """Return the world position of the point at each observation, [K, 3]."""
        amplitudes_at = torch.einsum("pm,mjb->pjb", self.influence, self.amplitudes)
        return self.rest[self.point] + torch.einsum("kjb,kb->kj", amplitudes_at[self.point], self.waves[self.camera])

    def off(self) -> Tensor:
        """Return the ray residuals predicted minus observed, [K, 2]."""
        return _residuals(self)[0]


def with_waves(bundle: MovingBundle, waves: Tensor) -> MovingBundle:
    """Replace the waves [C, B]. Vectors of additional waves start at zero."""
    amplitudes = torch.zeros(len(bundle.field.nodes), 3, waves.shape[1], dtype=torch.float64)
    amplitudes[:, :, : bundle.amplitudes.shape[2]] = bundle.amplitudes
    return replace(bundle, waves=waves, amplitudes=amplitudes, rhythm=None)


def with_rhythm(bundle: MovingBundle, rhythm: Rhythm) -> MovingBundle:
    """Replace the waves by those of phases that are estimated."""
    return replace(with_waves(bundle, rhythm.waves), rhythm=rhythm)


@one_thread()
def adjust(
    bundle: MovingBundle, spread: float, rounds: int, prior: TrajectoryPrior | None = None
) -> tuple[MovingBundle, float]:
    """Adjust cameras, phases, rest positions and motion vectors to minimise the robust cost.

    Args:
        bundle: start values.
        spread: scale of the robust loss of ray errors (Geman and McClure); errors well above it have almost no influence.
        rounds: maximum number of Levenberg-Marquardt steps.
        prior: prior of the scope's trajectory, or None.

    Returns:
        The adjusted bundle and its cost, which is at most that of the start.
    """
    step = lambda bundle, damping: _in_unit(_step(bundle, spread, damping, prior))
    damping = FIRST_DAMPING if prior is None else WEAK_DAMPING
    return descend(bundle, step, lambda bundle: _cost(bundle, spread, prior), rounds, damping)


def _cost(bundle: MovingBundle, spread: float, prior: TrajectoryPrior | None) -> float:
    residual, _, _ = _residuals(bundle)
    squares = (residual / spread).square().sum(1)
    seen = 0.5 * (spread / SIGMA) ** 2 * (squares / (1 + squares)).sum()
    depth = bundle.rest[:, 2]
    relief = 0.5 * ((depth - depth.median()) / RELIEF).square().sum()
    motion = 0.5 * torch.einsum("mjb,mn,njb->", bundle.amplitudes, bundle.field.stiffness, bundle.amplitudes)
    rhythm = bundle.rhythm.cost() if bundle.rhythm is not None else 0.0
    return float(seen + relief + motion) + rhythm + (prior.cost(bundle.poses) if prior is not None else 0.0)


def _in_unit(bundle: MovingBundle) -> MovingBundle:
    """Return the bundle with lengths divided by the median depth of the rest positions, which becomes the unit."""
    unit = bundle.rest[:, 2].median().abs()
    poses = bundle.poses.clone()
    poses[:, :3, 3] /= unit
    return replace(bundle, poses=poses, rest=bundle.rest / unit, amplitudes=bundle.amplitudes / unit)


def _residuals(bundle: MovingBundle) -> tuple[Tensor, Tensor, Tensor]:
    """Return ray residuals [K, 2], points in camera coordinates [K, 3] and camera rotations [K, 3, 3]."""
    pose = bundle.poses[bundle.camera]
    rotation = pose[:, :3, :3]
    local = (rotation @ bundle.places()[:, :, None])[:, :, 0] + pose[:, :3, 3]
    local = torch.cat([local[:, :2], local[:, 2:].clamp(min=NEAREST)], 1)
    return local[:, :2] / local[:, 2:] - bundle.rays, local, rotation


@dataclass(frozen=True)
class _Places:
    """Blocks of the normal equations with which the points' rest positions are eliminated (Schur complement)."""

    inverse: Tensor
    """Inverses of the diagonal blocks of the rest positions, [P, 3, 3]."""
    slope: Tensor
    """Gradients of the least-squares cost by the rest positions of the P tracked points, [P, 3]."""
    by_camera: Tensor
    """Hessian blocks of the unknowns of a frame (twist and phases) and rest positions, [C, P, D, 3]."""
    by_amplitude: Tensor
    """Hessian blocks of rest positions and motion amplitudes, [P, 3, 3 B]."""


def _step(bundle: MovingBundle, spread: float, damping: float, prior: TrajectoryPrior | None) -> MovingBundle:
    """Compute one damped step. Unknowns are the twists and phases of all cameras without the first twist, then
    amplitudes in the order (axis, wave, node).
    """
    residual, local, rotation = _residuals(bundle)
    weight = 1 / (SIGMA * (1 + (residual / spread).square().sum(1))) ** 2
    by_local, by_rotation = ray_derivatives(local)
    by_place = by_local @ rotation
    by_frame = torch.cat([by_local, by_local @ by_rotation], 2)
    rhythm = bundle.rhythm
    if rhythm is not None:
        at_points = torch.einsum("pm,mjb->pjb", bundle.influence, bundle.amplitudes).unflatten(2, (-1, 2))
        by_phase = torch.einsum("kjfw,kfw->kjf", at_points[bundle.point], rhythm.slopes[bundle.camera])
        by_frame = torch.cat([by_frame, by_place @ by_phase], 2)
    weighted = (by_frame * weight[:, None, None]).transpose(1, 2)
    cameras, count, size = len(bundle.poses), len(bundle.rest), by_frame.shape[2]
    H = summed(weighted @ by_frame, bundle.camera, cameras)
    g = summed((weighted @ residual[:, :, None])[:, :, 0], bundle.camera, cameras)
    H = H + damping * diagonal_of(H)
    index = bundle.camera * count + bundle.point
    by_camera = summed(weighted @ by_place, index, cameras * count).view(cameras, count, size, 3)
    weighted = (by_place * weight[:, None, None]).transpose(1, 2)
    square, pull = weighted @ by_place, (weighted @ residual[:, :, None])[:, :, 0]
    places = _eliminated(bundle, square, pull, by_camera, damping)
    eliminated = torch.einsum("cpij,pjk->cpik", by_camera, places.inverse)
    flat = lambda blocks: blocks.permute(0, 2, 1, 3).reshape(size * cameras, 3 * count)
    S = (torch.block_diag(*H) - flat(eliminated) @ flat(by_camera).T).view(cameras, size, cameras, size)
    right = g - torch.einsum("cpij,pj->ci", eliminated, places.slope)
    if prior is not None:
        more, slope = prior.terms(bundle.poses)
        S[:, :6, :, :6] += more.view(cameras, 6, cameras, 6)
        right[:, :6] += slope.view(cameras, 6)
    if rhythm is not None:
        for which, precision in enumerate(rhythm.precision, start=6):
            S[:, which, :, which] += precision
        right[:, 6:] += rhythm.pull()
    cross_terms, own_terms, slopes = _amplitude_terms(bundle, square, pull, places, eliminated, held=prior is None)
    S = S.reshape(size * cameras, size * cameras)
    whole = torch.cat([torch.cat([S, cross_terms], 1), torch.cat([cross_terms.T, own_terms], 1)])[6:, 6:]
    found = -torch.linalg.solve(whole, torch.cat([right.reshape(-1), slopes])[6:])
    found = torch.cat([torch.zeros(6, dtype=found.dtype), found])
    by_frames = found[: size * cameras].view(cameras, size)
    change = found[size * cameras :].view(3, bundle.waves.shape[1], bundle.influence.shape[1]).permute(2, 0, 1)
    at_points = torch.einsum("pm,mjb->pjb", bundle.influence, change).flatten(1)
    moved = places.slope + torch.einsum("cpij,ci->pj", by_camera, by_frames)
    moved = moved + torch.einsum("pia,pa->pi", places.by_amplitude, at_points)
    rest = bundle.rest - (places.inverse @ moved[:, :, None])[:, :, 0]
    found_bundle = replace(
        bundle, poses=exp(by_frames[:, :6]) @ bundle.poses, rest=rest, amplitudes=bundle.amplitudes + change
    )
    return found_bundle if rhythm is None else with_rhythm(found_bundle, rhythm.moved(by_frames[:, 6:]))


def _eliminated(bundle: MovingBundle, square: Tensor, pull: Tensor, by_camera: Tensor, damping: float) -> _Places:
    count, waves = len(bundle.rest), bundle.waves[bundle.camera]
    V, slope = summed(square, bundle.point, count), summed(pull, bundle.point, count)
    depth = bundle.rest[:, 2]
    V[:, 2, 2] += 1 / RELIEF**2
    slope[:, 2] += (depth - depth.median()) / RELIEF**2
    V = V + damping * diagonal_of(V)
    by_amplitude = summed((square[:, :, :, None] * waves[:, None, None, :]).flatten(2), bundle.point, count)
    return _Places(torch.linalg.inv(V), slope, by_camera, by_amplitude)


def _amplitude_terms(
    bundle: MovingBundle, square: Tensor, pull: Tensor, places: _Places, eliminated: Tensor, *, held: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Hessian blocks of amplitudes and frames [D C, n] and of the amplitudes [n, n], and the amplitudes'
    gradient [n], after eliminating the rest positions.
    """
    count, waves = len(bundle.rest), bundle.waves[bundle.camera]
    frame_terms, wave_count, nodes = len(bundle.poses) * eliminated.shape[2], waves.shape[1], bundle.influence.shape[1]
    size = 3 * wave_count
    pairs = square[:, :, None, :, None] * (waves[:, :, None] * waves[:, None, :])[:, None, :, None, :]
    own = summed(pairs.reshape(len(pairs), size, size), bundle.point, count)
    slope = summed((pull[:, :, None] * waves[:, None, :]).flatten(1), bundle.point, count)
    back = places.by_amplitude.transpose(1, 2) @ places.inverse
    own = own - back @ places.by_amplitude
    slope = slope - (back @ places.slope[:, :, None])[:, :, 0]
    influence = bundle.influence
    by_camera = (places.by_camera.permute(0, 2, 3, 1) @ influence)[:, :, :, None, :] * bundle.waves[
        :, None, None, :, None
    ]
    cross = by_camera.reshape(frame_terms, size, nodes)
    for term in range(size):
        through = torch.einsum("cpij,pj->cip", eliminated, places.by_amplitude[:, :, term])
        cross[:, term] -= through.reshape(frame_terms, count) @ influence
    whole = torch.zeros(size, nodes, size, nodes, dtype=own.dtype)
    for row in range(size):
        for column in range(row, size):
            block = (influence * own[:, row, column, None]).T @ influence
            whole[row, :, column], whole[column, :, row] = block, block.T
        whole[row, :, row] += bundle.field.stiffness
    slopes = torch.einsum("pa,pm->am", slope, influence)
    slopes = slopes + torch.einsum("mn,njb->jbm", bundle.field.stiffness, bundle.amplitudes).reshape(size, nodes)
    if held and wave_count:
        whole = whole + _rigid(bundle, wave_count)
    return cross.reshape(frame_terms, size * nodes), whole.reshape(size * nodes, size * nodes), slopes.reshape(-1)


def _rigid(bundle: MovingBundle, wave_count: int) -> Tensor:
    """Return the term of the amplitudes' Hessian, [3 B, M, 3 B, M] for B waves and M nodes, that keeps a step from
    changing the rigid part of the motion.
    """
    at = bundle.field.nodes - bundle.field.middle
    x, y, z = at.unbind(1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows = [one, zero, zero, zero, z, -y, zero, one, zero, -z, zero, x, zero, zero, one, y, -x, zero]
    modes = torch.linalg.qr(torch.stack(rows, 1).reshape(-1, 6)).Q.view(len(at), 3, -1)
    block = HELD / SIGMA * torch.einsum("mik,njk->imjn", modes, modes)
    each = torch.eye(wave_count, dtype=block.dtype)
    return torch.einsum("imjn,ab->iamjbn", block, each).reshape(3 * wave_count, len(at), 3 * wave_count, len(at))
