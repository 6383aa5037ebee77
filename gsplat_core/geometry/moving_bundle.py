"""Bundle adjustment of cameras in front of periodically moving tissue.

The position of a point is its rest position plus the sum over waves w(t) of w(t) times a vector.
The vectors vary smoothly over the surface (`surface_field`). Cameras, rest positions and vectors
are estimated together by Levenberg-Marquardt with Cauchy weights, with rest positions eliminated
(Schur complement). Rigid motion common to tissue and scope is unobservable from pictures; the
trajectory prior (`trajectory_prior`) decides it. The unit of length is the tissue's median
distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.geometry.levenberg_marquardt import descend, diagonal_of, ray_derivatives, summed
from gsplat_core.geometry.pose import exp
from gsplat_core.geometry.surface_field import SurfaceField
from gsplat_core.geometry.trajectory_prior import TrajectoryPrior
from gsplat_core.threads import one_thread

SIGMA = 0.002
"""Standard deviation of a ray (x / z). It corresponds to 0.6 pixels at a width of 320 and includes
the correlation of errors over time.
"""
RELIEF = 0.3
"""Prior standard deviation of the points' depth from their median, in units of the median depth."""
NEAREST = 0.05
"""Smallest depth used in projections, in units of the median depth."""
HELD = 1e3
"""Stiffness that holds the tissue's common rigid motion constant when there is no trajectory prior.
"""


@dataclass(frozen=True)
class MovingBundle:
    """Cameras, moving points and observations; all float64."""

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
    """Nodes and prior of the motion field."""

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
    return replace(bundle, waves=waves, amplitudes=amplitudes)


@one_thread()
def adjust(
    bundle: MovingBundle, spread: float, rounds: int, prior: TrajectoryPrior | None = None
) -> tuple[MovingBundle, float]:
    """Minimise the robust cost.

    Args:
        bundle: start values.
        spread: Cauchy scale of ray errors; errors well above it have little influence.
        rounds: maximum number of Levenberg-Marquardt steps.
        prior: prior of the scope's trajectory, or None.

    Returns:
        The adjusted bundle and its cost, which is at most that of the start.
    """
    step = lambda bundle, damping: _in_unit(_step(bundle, spread, damping, prior))
    return descend(bundle, step, lambda bundle: _cost(bundle, spread, prior), rounds)


def _cost(bundle: MovingBundle, spread: float, prior: TrajectoryPrior | None) -> float:
    residual, _, _ = _residuals(bundle)
    seen = 0.5 * (spread / SIGMA) ** 2 * torch.log1p((residual / spread).square().sum(1)).sum()
    depth = bundle.rest[:, 2]
    relief = 0.5 * ((depth - depth.median()) / RELIEF).square().sum()
    motion = 0.5 * torch.einsum("mjb,mn,njb->", bundle.amplitudes, bundle.field.stiffness, bundle.amplitudes)
    return float(seen + relief + motion) + (prior.cost(bundle.poses) if prior is not None else 0.0)


def _in_unit(bundle: MovingBundle) -> MovingBundle:
    """Rescale to the median depth of the rest positions as the unit of length."""
    unit = bundle.rest[:, 2].median().abs()
    poses = bundle.poses.clone()
    poses[:, :3, 3] /= unit
    return replace(bundle, poses=poses, rest=bundle.rest / unit, amplitudes=bundle.amplitudes / unit)


def _residuals(bundle: MovingBundle) -> tuple[Tensor, Tensor, Tensor]:
    """Return ray residuals [K, 2], points in camera coordinates [K, 3] and camera rotations [K, 3,
    3].
    """
    pose = bundle.poses[bundle.camera]
    rotation = pose[:, :3, :3]
    local = (rotation @ bundle.places()[:, :, None])[:, :, 0] + pose[:, :3, 3]
    local = torch.cat([local[:, :2], local[:, 2:].clamp(min=NEAREST)], 1)
    return local[:, :2] / local[:, 2:] - bundle.rays, local, rotation


@dataclass(frozen=True)
class _Places:
    """Blocks of the normal equations needed to eliminate the rest positions."""

    inverse: Tensor
    """Inverse blocks of the rest positions, [P, 3, 3]."""
    slope: Tensor
    """Gradients of the rest positions, [P, 3]."""
    by_camera: Tensor
    """Coupling to cameras, [C, P, 6, 3]."""
    by_amplitude: Tensor
    """Coupling to motion vectors, [P, 3, 3 B]."""


def _step(bundle: MovingBundle, spread: float, damping: float, prior: TrajectoryPrior | None) -> MovingBundle:
    """Compute one damped step. Unknowns are the twists of all cameras but the first, then
    amplitudes in the order (axis, wave, node).
    """
    residual, local, rotation = _residuals(bundle)
    weight = 1 / (SIGMA**2 * (1 + (residual / spread).square().sum(1)))
    by_local, by_rotation = ray_derivatives(local)
    by_pose, by_place = torch.cat([by_local, by_local @ by_rotation], 2), by_local @ rotation
    weighted = (by_pose * weight[:, None, None]).transpose(1, 2)
    cameras, count = len(bundle.poses), len(bundle.rest)
    H = summed(weighted @ by_pose, bundle.camera, cameras)
    g = summed((weighted @ residual[:, :, None])[:, :, 0], bundle.camera, cameras)
    H = H + damping * diagonal_of(H)
    index = bundle.camera * count + bundle.point
    by_camera = summed(weighted @ by_place, index, cameras * count).view(cameras, count, 6, 3)
    weighted = (by_place * weight[:, None, None]).transpose(1, 2)
    square, pull = weighted @ by_place, (weighted @ residual[:, :, None])[:, :, 0]
    places = _eliminated(bundle, square, pull, by_camera, damping)
    eliminated = torch.einsum("cpij,pjk->cpik", by_camera, places.inverse)
    flat = lambda blocks: blocks.permute(0, 2, 1, 3).reshape(6 * cameras, 3 * count)
    S = torch.block_diag(*H) - flat(eliminated) @ flat(by_camera).T
    right = (g - torch.einsum("cpij,pj->ci", eliminated, places.slope)).reshape(-1)
    if prior is not None:
        more, slope = prior.terms(bundle.poses)
        S, right = S + more, right + slope
    cross_terms, own_terms, slopes = _amplitude_terms(bundle, square, pull, places, eliminated, held=prior is None)
    whole = torch.cat([torch.cat([S, cross_terms], 1), torch.cat([cross_terms.T, own_terms], 1)])[6:, 6:]
    found = -torch.linalg.solve(whole, torch.cat([right, slopes])[6:])
    twist = torch.cat([torch.zeros(6, dtype=found.dtype), found[: 6 * cameras - 6]]).view(cameras, 6)
    change = found[6 * cameras - 6 :].view(3, bundle.waves.shape[1], bundle.influence.shape[1]).permute(2, 0, 1)
    at_points = torch.einsum("pm,mjb->pjb", bundle.influence, change).flatten(1)
    moved = places.slope + torch.einsum("cpij,ci->pj", by_camera, twist)
    moved = moved + torch.einsum("pia,pa->pi", places.by_amplitude, at_points)
    rest = bundle.rest - (places.inverse @ moved[:, :, None])[:, :, 0]
    return replace(bundle, poses=exp(twist) @ bundle.poses, rest=rest, amplitudes=bundle.amplitudes + change)


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
    """Return coupling of amplitudes to cameras [6 C, n], their own matrix [n, n] and gradient [n],
    after eliminating the rest positions.
    """
    count, waves = len(bundle.rest), bundle.waves[bundle.camera]
    cameras, wave_count, nodes = len(bundle.poses), waves.shape[1], bundle.influence.shape[1]
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
    cross = by_camera.reshape(6 * cameras, size, nodes)
    for term in range(size):
        through = torch.einsum("cpij,pj->cip", eliminated, places.by_amplitude[:, :, term])
        cross[:, term] -= through.reshape(6 * cameras, count) @ influence
    whole = torch.zeros(size, nodes, size, nodes, dtype=own.dtype)
    for row in range(size):
        for column in range(row, size):
            whole[row, :, column] = (influence * own[:, row, column, None]).T @ influence
            whole[column, :, row] = whole[row, :, column].T
        whole[row, :, row] += bundle.field.stiffness
    slopes = torch.einsum("pa,pm->am", slope, influence)
    slopes = slopes + torch.einsum("mn,njb->jbm", bundle.field.stiffness, bundle.amplitudes).reshape(size, nodes)
    if held and wave_count:
        whole = whole + _rigid(bundle, wave_count)
    return cross.reshape(6 * cameras, size * nodes), whole.reshape(size * nodes, size * nodes), slopes.reshape(-1)


def _rigid(bundle: MovingBundle, wave_count: int) -> Tensor:
    """Return the penalty matrix [3 B, M, 3 B, M] that holds the rigid motion of the amplitudes."""
    at = bundle.field.nodes - bundle.field.middle
    x, y, z = at.unbind(1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows = [one, zero, zero, zero, z, -y, zero, one, zero, -z, zero, x, zero, zero, one, y, -x, zero]
    modes = torch.linalg.qr(torch.stack(rows, 1).reshape(-1, 6)).Q.view(-1, 3, 6)
    block = HELD / SIGMA * torch.einsum("mik,njk->imjn", modes, modes)
    each = torch.eye(wave_count, dtype=block.dtype)
    return torch.einsum("imjn,ab->iamjbn", block, each).reshape(3 * wave_count, len(at), 3 * wave_count, len(at))
