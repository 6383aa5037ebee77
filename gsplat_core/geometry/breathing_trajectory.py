"""The scope's trajectory before tissue that breathes: cameras refined against points that repeat their motion.

Poses that take tissue to be at rest have its breathing in them. Here the frequencies of breathing and heart beat are looked for that explain better where
points were seen (`breathing_frequencies`), and cameras, points and their motion are found together (`moving_bundle`), with what may be expected of a
scope's trajectory (`trajectory_prior`), learned anew as the trajectory gets better. Nothing is said where no frequency explains clearly more, less than one and a half
breaths are seen, or the scope itself swings nearly as fast (`trajectory_lines`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.geometry.breathing_frequencies import BREATHING_HZ, LEAST_CYCLES, frequencies_of, sharpened, waves
from gsplat_core.geometry.bundle import Bundle
from gsplat_core.geometry.bundle import adjust as adjust_still
from gsplat_core.geometry.moving_bundle import MovingBundle, adjust, with_waves
from gsplat_core.geometry.pose import exp, inverse, log
from gsplat_core.geometry.surface_field import MOST_NODES, SurfaceField
from gsplat_core.geometry.trajectory_lines import is_told
from gsplat_core.geometry.trajectory_prior import TrajectoryPrior, learned_from
from gsplat_core.threads import one_thread

EVERY_S = 0.4
"""Between the frames that are looked at, on average."""
FEWEST_FRAMES, MOST_FRAMES = 40, 150
LONGEST_S = MOST_FRAMES * EVERY_S
POINTS, LEAST_SEEN = 600, 5
"""How many points are looked at, those most often seen, and how often at least."""
FEWEST_POINTS = 60
NEAREST, FARTHEST = 0.5, 2.0
"""Of the median depth: points that are nearer or farther at first start there."""
FINEST = 0.0017
STAGES = (
    (0.014, 3, 0.0),
    (0.007, 3, 0.06),
    (0.0035, 3, 0.04),
    (FINEST, 3, 0.03),
    (FINEST, 3, 0.02),
    (FINEST, 3, 0.015),
    *((FINEST, 4, 0.0),) * 9,
)
"""Rays (x / z) that are off by well more than the first number decide little; after so many steps frequencies are sharpened to so many cycles over the
recording, and the trajectory's prior is learned anew."""
FEW_POINTS, FEW_FRAMES, FEW_NODES = 200, 40, 16
"""With which frequencies are looked for."""
SAMPLED = 0.4
"""Of the frame rate: what swings faster is not looked for."""
LEAST_SHARED, PLACE_ROUNDS = 24, 10
"""Points that a frame between those looked at has to share with them, to be placed by them."""
GOLDEN = 0.5 * (5**0.5 - 1)


@dataclass(frozen=True)
class Sightings:
    """Where points were seen, and what follows when they are taken to be at rest; the unit of length is about their distance."""

    frame: Tensor
    """int64 [K], ascending: in which frame ..."""
    point: Tensor
    """int64 [K]: ... which point was seen ..."""
    rays: Tensor
    """[K, 2]: ... where, as x / z and y / z."""
    times_s: Tensor
    """[N]: of all frames."""
    poses: Tensor
    """[N, 4, 4]: world to camera."""
    points: Tensor
    """[P, 3]."""


@dataclass(frozen=True)
class BreathingTrajectory:
    """What was found."""

    poses: Tensor
    """[N, 4, 4]: of all frames; the first one is the identity and the unit the median depth of the points."""
    points: Tensor
    """[P, 3]: places at rest of the points that were looked at."""
    frequencies_hz: tuple[float, ...]
    """Of breathing, or of breathing and the heart."""
    uncertain: float
    """How much of the trajectory, root mean square, may be the tissue's own."""
    error: float
    """Median of how far rays are off."""


@one_thread()
def breathing_trajectory(sightings: Sightings, placed: Tensor) -> BreathingTrajectory | None:
    """The trajectory before breathing tissue, or None where there is none to be told.

    placed: bool [N]: frames whose pose is known.
    """
    length_s = float(sightings.times_s[-1] - sightings.times_s[0])
    known = torch.nonzero(placed)[:, 0]
    if not LEAST_CYCLES / BREATHING_HZ[1] <= length_s <= LONGEST_S or len(known) < FEWEST_FRAMES:
        return None
    frames = _some(known, max(FEWEST_FRAMES, min(MOST_FRAMES, round(length_s / EVERY_S) + 1)))
    few = _some(frames, FEW_FRAMES)
    fewer = _bundle(sightings, few, FEW_POINTS, FEW_NODES)
    if fewer is None:
        return None
    fastest_hz = SAMPLED * (len(sightings.times_s) - 1) / length_s
    frequencies_hz = frequencies_of(fewer[0], sightings.times_s[few], fastest_hz)
    start = _bundle(sightings, frames, POINTS, MOST_NODES)
    if not frequencies_hz or start is None:
        return None
    found, frequencies_hz, prior = refined(start[0], sightings.times_s[frames], frequencies_hz)
    told, mistaken = is_told(start[0].poses, found.poses, sightings.times_s[frames], frequencies_hz)
    if not told:
        return None
    poses = _all_placed(sightings, frames, found, start[1], frequencies_hz)
    error = float(found.off().norm(dim=1).median())
    return BreathingTrajectory(poses, found.rest, frequencies_hz, max(prior.uncertain, mistaken), error)


@one_thread()
def refined(
    start: MovingBundle, times_s: Tensor, frequencies_hz: tuple[float, ...]
) -> tuple[MovingBundle, tuple[float, ...], TrajectoryPrior]:
    """Cameras, tissue and its motion with about these frequencies, from cameras and tissue that know no motion; the frequencies, and the prior of trajectories
    like the one that was found."""
    bundle, hz = with_waves(start, waves(times_s, frequencies_hz)), frequencies_hz
    for spread, rounds, cycles in STAGES:
        prior = learned_from(bundle.poses, times_s, bundle.waves)
        bundle, _ = adjust(bundle, spread, rounds, prior)
        if cycles:
            bundle, hz = sharpened(bundle, times_s, hz, cycles, spread, prior)
        bundle = _with_new_nodes(bundle)
    return bundle, hz, learned_from(bundle.poses, times_s, bundle.waves)


def _some(frames: Tensor, most: int) -> Tensor:
    """At most so many of the frames, the first and the last among them, spread over all but not evenly: evenly spread ones show a fast motion as a slow
    one."""
    if len(frames) <= most:
        return frames
    shift = (torch.arange(most, dtype=torch.float64) * GOLDEN) % 1 - 0.5
    shift[0] = shift[-1] = 0
    at = torch.linspace(0, len(frames) - 1, most, dtype=torch.float64) + 0.8 * shift * (len(frames) / most)
    return frames[torch.unique(at.round().long().clamp(0, len(frames) - 1))]


def _bundle(sightings: Sightings, frames: Tensor, most: int, nodes: int) -> tuple[MovingBundle, Tensor] | None:
    """What the given frames show of the points that they show most often, at rest, and the points' numbers; None where these are too few."""
    chosen = torch.isin(sightings.frame, frames)
    times = torch.bincount(sightings.point[chosen], minlength=len(sightings.points))
    often = torch.argsort(times, descending=True, stable=True)[:most]
    often = often[times[often] >= LEAST_SEEN]
    if len(often) < FEWEST_POINTS:
        return None
    chosen &= torch.isin(sightings.point, often)
    numbers, point = torch.unique(sightings.point[chosen], return_inverse=True)
    camera, rays = torch.searchsorted(frames, sightings.frame[chosen]), sightings.rays[chosen]
    start = sightings.poses[frames[0]]
    poses = sightings.poses[frames] @ inverse(start)
    seen_from_start = sightings.points[numbers] @ start[:3, :3].T + start[:3, 3]
    rest = _limited(poses, seen_from_start, camera, point, rays)
    unit = rest[:, 2].median()
    poses[:, :3, 3] /= unit
    rest = rest / unit
    field = SurfaceField.over(rest, nodes)
    none = torch.zeros(len(frames), 0, dtype=torch.float64)
    amplitudes = torch.zeros(len(field.nodes), 3, 0, dtype=torch.float64)
    bundle = MovingBundle(poses, rest, amplitudes, camera, point, rays, none, field.influence(rest), field)
    return bundle, numbers


def _limited(poses: Tensor, rest: Tensor, camera: Tensor, point: Tensor, rays: Tensor) -> Tensor:
    """The points where they were first seen, none much nearer or farther than most."""
    number = torch.arange(len(point))
    first = torch.zeros(len(rest), dtype=torch.int64).scatter_reduce(0, point, number, "amin", include_self=False)
    pose = poses[camera[first]]
    depth = (pose[:, 2, :3] * rest).sum(1) + pose[:, 2, 3]
    middle = depth.median()
    depth = torch.where((depth > NEAREST * middle) & (depth < FARTHEST * middle), depth, middle)
    local = torch.cat([rays[first], torch.ones_like(depth)[:, None]], 1) * depth[:, None]
    return (pose[:, :3, :3].transpose(1, 2) @ (local - pose[:, :3, 3])[:, :, None])[:, :, 0]


def _with_new_nodes(bundle: MovingBundle) -> MovingBundle:
    """The same motion, with nodes among the points where they are now."""
    field = SurfaceField.over(bundle.rest, len(bundle.field.nodes))
    amplitudes = torch.einsum("nm,mjb->njb", bundle.field.influence(field.nodes), bundle.amplitudes)
    return replace(bundle, field=field, amplitudes=amplitudes, influence=field.influence(bundle.rest))


def _all_placed(
    sightings: Sightings, frames: Tensor, found: MovingBundle, numbers: Tensor, frequencies_hz: Sequence[float]
) -> Tensor:
    """Poses of all frames: of those between the ones looked at, where the moving points fit."""
    poses = _between(frames, found.poses, len(sightings.times_s))
    chosen = torch.isin(sightings.point, numbers) & ~torch.isin(sightings.frame, frames)
    shared = torch.bincount(sightings.frame[chosen], minlength=len(poses))
    chosen &= shared[sightings.frame] >= LEAST_SHARED
    rest = torch.searchsorted(numbers, sightings.point[chosen])
    amplitudes_at = torch.einsum("pm,mjb->pjb", found.influence, found.amplitudes)
    moved = torch.einsum(
        "kjb,kb->kj", amplitudes_at[rest], waves(sightings.times_s, frequencies_hz)[sightings.frame[chosen]]
    )
    at = torch.arange(len(rest))
    between = Bundle(poses, found.rest[rest] + moved, sightings.frame[chosen], at, sightings.rays[chosen], 1 / FINEST)
    fixed = shared < LEAST_SHARED
    fixed[frames] = True
    if fixed.all():
        return poses
    return adjust_still(between, fixed=fixed, rounds=PLACE_ROUNDS, points_move=False).poses


def _between(frames: Tensor, poses: Tensor, count: int) -> Tensor:
    """Poses of all frames [count, 4, 4] from those of some, along screw motions; before the first and after the last one it stands."""
    number = torch.arange(count)
    after = torch.searchsorted(frames, number).clamp(1, len(frames) - 1)
    first, second = frames[after - 1], frames[after]
    share = ((number - first) / (second - first)).clamp(0, 1)[:, None].double()
    start = poses[after - 1]
    return exp(share * log(poses[after] @ inverse(start))) @ start
