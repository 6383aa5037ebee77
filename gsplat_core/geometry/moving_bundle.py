"""Bundle adjustment before tissue that repeats its motion: cameras, places at rest, and how far each part swings at some frequencies.

A point is at its place at rest and, for each wave w(t), w(t) times a vector that changes smoothly over the surface (`surface_field`). Cameras, places and
vectors follow together from where points were seen: Levenberg-Marquardt with Cauchy's weights, places eliminated (Schur complement). What tissue and
scope do alike cannot be told by any picture; the prior of the trajectory (`trajectory_prior`) decides that. The unit of length is the tissue's median distance.
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
"""Standard deviation of a ray (x / z): 0.6 pixels of a picture that is 320 wide, as neighbours in time err alike."""
RELIEF = 0.3
"""How far points may be expected from their median distance."""
NEAREST = 0.05
"""What is nearer is taken to be there."""
HELD = 1e3
"""Where no prior of the trajectory decides: how firmly the tissue's common rigid motion stays as it is."""


@dataclass(frozen=True)
class MovingBundle:
    """Cameras, tissue and what was seen of it; all float64."""

    poses: Tensor
    """World to camera [C, 4, 4]; the first one stays."""
    rest: Tensor
    """Places at rest [P, 3] in the world."""
    amplitudes: Tensor
    """Vectors at the nodes [M, 3, B], one for each wave."""
    camera: Tensor
    """int64 [K]: which camera saw ..."""
    point: Tensor
    """int64 [K]: ... which point ..."""
    rays: Tensor
    """[K, 2]: ... where, as x / z and y / z."""
    waves: Tensor
    """[C, B]: each wave when each camera looked."""
    influence: Tensor
    """[P, M]: how much each point has of each node's vector."""
    field: SurfaceField
    """The nodes."""

    def places(self) -> Tensor:
        """Where each point was when it was seen [K, 3]."""
        amplitudes_at = torch.einsum("pm,mjb->pjb", self.influence, self.amplitudes)
        return self.rest[self.point] + torch.einsum("kjb,kb->kj", amplitudes_at[self.point], self.waves[self.camera])

    def off(self) -> Tensor:
        """Rays from where points were seen to where they would be [K, 2]."""
        return _residuals(self)[0]


def with_waves(bundle: MovingBundle, waves: Tensor) -> MovingBundle:
    """The same with other waves [C, B]: what more there are than before is still to be found."""
    amplitudes = torch.zeros(len(bundle.field.nodes), 3, waves.shape[1], dtype=torch.float64)
    amplitudes[:, :, : bundle.amplitudes.shape[2]] = bundle.amplitudes
    return replace(bundle, waves=waves, amplitudes=amplitudes)


@one_thread()
def adjust(
    bundle: MovingBundle, spread: float, rounds: int, prior: TrajectoryPrior | None = None
) -> tuple[MovingBundle, float]:
    """The bundle after at most `rounds` steps, of which each lessens the cost, and the cost.

    spread: rays that are off by well more than this decide little (Cauchy's scale).
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
    """The same with the median depth of the places at rest as the unit."""
    unit = bundle.rest[:, 2].median().abs()
    poses = bundle.poses.clone()
    poses[:, :3, 3] /= unit
    return replace(bundle, poses=poses, rest=bundle.rest / unit, amplitudes=bundle.amplitudes / unit)


def _residuals(bundle: MovingBundle) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals [K, 2] of rays, the points in their cameras [K, 3], and the cameras' rotations [K, 3, 3]."""
    pose = bundle.poses[bundle.camera]
    rotation = pose[:, :3, :3]
    local = (rotation @ bundle.places()[:, :, None])[:, :, 0] + pose[:, :3, 3]
    local = torch.cat([local[:, :2], local[:, 2:].clamp(min=NEAREST)], 1)
    return local[:, :2] / local[:, 2:] - bundle.rays, local, rotation


@dataclass(frozen=True)
class _Places:
    """The equations of places at rest, as far as cameras and swings are concerned."""

    inverse: Tensor
    """[P, 3, 3]."""
    slope: Tensor
    """[P, 3]."""
    by_camera: Tensor
    """[C, P, 6, 3]."""
    by_amplitude: Tensor
    """[P, 3, 3 B]."""


def _step(bundle: MovingBundle, spread: float, damping: float, prior: TrajectoryPrior | None) -> MovingBundle:
    """One step. Unknowns: twists of all cameras but the first, then amplitudes in the order (axis, wave, node)."""
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
    """What swings have to do with cameras [6 C, n] and with one another [n, n], and their slopes [n], without the places."""
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
    """What holds the common rigid motion of the swings as it is [3 B, M, 3 B, M]."""
    at = bundle.field.nodes - bundle.field.middle
    x, y, z = at.unbind(1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows = [one, zero, zero, zero, z, -y, zero, one, zero, -z, zero, x, zero, zero, one, y, -x, zero]
    modes = torch.linalg.qr(torch.stack(rows, 1).reshape(-1, 6)).Q.view(-1, 3, 6)
    block = HELD / SIGMA * torch.einsum("mik,njk->imjn", modes, modes)
    each = torch.eye(wave_count, dtype=block.dtype)
    return torch.einsum("imjn,ab->iamjbn", block, each).reshape(3 * wave_count, len(at), 3 * wave_count, len(at))
