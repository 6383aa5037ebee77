"""Scope trajectory in front of breathing tissue, estimated together with the periodic motion of the tissue.

Poses estimated for static tissue contain its breathing. This module searches for breathing and heart frequencies that
explain the observations better. It then optimises cameras, points, periodic motion and its phase in each frame together
(`moving_bundle`). A prior of the scope's trajectory (`TrajectoryPrior`) is re-estimated as the trajectory improves.

The prior attributes to the tissue the part of a motion with the phases of breathing that a smooth trajectory does not
have. `separability` tests the result with phases that are faster or slower by half a cycle per recording, with which the
tissue has no motion. Any motion attributed to the tissue there is scope motion. An error of the same size is expected
with the phases of breathing. A scope that moves nearly as fast as the tissue breathes shows at both neighbours.

There is no result if no frequency explains the observations clearly better, if the recording shows less than one and a
half breaths, or if the scope itself moves nearly as fast as the tissue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsplat_core.machine import one_thread
from gsplat_core.poses.bundle import Bundle, place_cameras
from gsplat_core.poses.moving_bundle import (
    MOST_NODES,
    PLACES,
    MovingBundle,
    Rhythm,
    SurfaceField,
    TrajectoryPrior,
    adjust,
    coordinates,
    learned_from,
    waves_of,
    with_rhythm,
    with_waves,
)
from gsplat_core.poses.se3 import exp, inverse, log

BREATHING_HZ, HEART_HZ = (0.1, 0.8), (0.8, 3.0)
LEAST_CYCLES, FEWEST_TRIED = 1.5, 0.5
"""Fewest breathing cycles in the recording for a frequency to be accepted, and for it to be tried. A smooth scope
trajectory explains a motion of less than `LEAST_CYCLES` equally well. Slower frequencies are still tried, because
otherwise twice their value would be selected.
"""
STEP_CYCLES = 0.25
"""Spacing of the tried breathing frequencies, in cycles over the recording; twice that for the heart."""
SPREAD = 0.007
"""Scale of the robust loss of ray errors (tangents x / z) in the search of frequencies."""
ROUNDS = 3
BREATHES, BEATS = 0.75, 0.94
"""Largest accepted ratio of the cost with all frequencies to that of the static model, and of the cost with a heart
frequency to the median over all tried heart frequencies, because any extra frequency lowers the cost a little.
"""


@dataclass(frozen=True)
class _Try:
    """Candidate in the search of frequencies: a bundle adjusted with motion of these frequencies, and its robust cost."""

    hz: tuple[float, ...]
    bundle: MovingBundle
    cost: float


def waves(times_s: Tensor, frequencies_hz: Sequence[float]) -> Tensor:
    """Return the cosine and sine of each frequency's phase 2π f t at each time, [T, 2 F]."""
    return waves_of(2 * torch.pi * times_s[:, None] * torch.tensor(frequencies_hz, dtype=times_s.dtype))


@one_thread()
def frequencies_of(start: MovingBundle, times_s: Tensor, fastest_hz: float = HEART_HZ[1]) -> tuple[float, ...]:
    """Find the frequencies that best explain the observations.

    Args:
        start: static bundle (no motion amplitudes).
        times_s: float64 [T], time of each camera in seconds.
        fastest_hz: upper limit of the search in Hz, set by the frame rate.

    Returns:
        The breathing frequency, the breathing and heart frequencies, or an empty tuple if static
            tissue explains the observations nearly as well.
    """
    length_s = float(times_s[-1] - times_s[0])
    step = STEP_CYCLES / length_s
    still, cost = adjust(start, SPREAD, 3 * ROUNDS)
    slow = _frequency_grid(max(BREATHING_HZ[0], FEWEST_TRIED / length_s), min(BREATHING_HZ[1], fastest_hz), step)
    breaths = [_tried(still, times_s, (hz,), ROUNDS) for hz in slow]
    best = _breath_of(breaths, length_s)
    if best is None:
        return ()
    # A single adjustment step per heart frequency is enough, since the bundle is already adjusted for breathing.
    beats = [
        _tried(best.bundle, times_s, (*best.hz, hz), 1)
        for hz in _frequency_grid(HEART_HZ[0], min(HEART_HZ[1], fastest_hz), 2 * step)
    ]
    usual = float(np.median([each.cost for each in beats])) if beats else 0.0
    beats = [each for each in _local_minima(beats) if each.cost < BEATS * usual]
    if beats:
        # Search the breathing frequency again with the heartbeat, because a strong heartbeat hides weak breathing.
        both = _best(beats)
        breaths = [_tried(both.bundle, times_s, (hz, both.hz[1]), ROUNDS) for hz in slow]
        best = _breath_of(breaths, length_s) or both
    slower = _best(breaths).hz[0] * length_s < LEAST_CYCLES
    return best.hz if best.cost < BREATHES * cost and not slower else ()


def _tried(start: MovingBundle, times_s: Tensor, hz: tuple[float, ...], rounds: int) -> _Try:
    """Adjust a bundle with motion of the frequencies `hz`. `start` has motion of the same frequencies, or of all but the last."""
    return _Try(hz, *adjust(with_waves(start, waves(times_s, hz)), SPREAD, rounds))


def _best(tries: Sequence[_Try]) -> _Try:
    return min(tries, key=lambda each: each.cost)


def _breath_of(breaths: Sequence[_Try], length_s: float) -> _Try | None:
    """Return the best local minimum over the breathing frequency with at least `LEAST_CYCLES`; None without one."""
    found = [each for each in _local_minima(breaths) if each.hz[0] * length_s >= LEAST_CYCLES]
    return _best(found) if found else None


def _local_minima(tries: Sequence[_Try]) -> list[_Try]:
    """Return the candidates whose cost is not higher than that of both neighbouring frequencies. The ends of the band are left out,
    because a minimum there belongs to a frequency outside it.
    """
    inner = zip(tries, tries[1:], tries[2:], strict=False)
    return [each for before, each, after in inner if each.cost <= min(before.cost, after.cost)]


def _frequency_grid(slowest: float, fastest: float, step: float) -> list[float]:
    return [float(hz) for hz in np.arange(slowest, fastest, step)]


BESIDE_CYCLES = 0.5
"""Difference of the two neighbouring frequencies from the breathing frequency, in cycles over the recording. Motion at
these frequencies is scope motion, which shows how much of it is mistaken for breathing.
"""
CLEARLY = 2.0
"""Smallest accepted ratio of the motion attributed to the tissue to that at the neighbouring frequencies. Below it the
separated poses may be worse than the static ones.
"""


@one_thread()
def separability(before: Tensor, poses: Tensor, times_s: Tensor, phases: Tensor) -> tuple[bool, float]:
    """Compare poses after separating the breathing motion with those for static tissue.

    Args:
        before: poses estimated for static tissue [C, 4, 4].
        poses: poses after separating the breathing [C, 4, 4].
        times_s: times in seconds [C].
        phases: phases of breathing, and of the heart if found, in radians [C, F].

    Returns:
        True if `poses` are more reliable than `before`, and the root mean square scope motion that
            may be attributed to the tissue.
    """
    apart = 2 * torch.pi * BESIDE_CYCLES * (times_s - times_s[0]) / (times_s[-1] - times_s[0])
    beside = [torch.cat([phases[:, :1] + change[:, None], phases[:, 1:]], 1) for change in (-apart, apart)]
    mistaken = min(_given_to_tissue(poses, poses, times_s, each) for each in beside)
    return _given_to_tissue(before, poses, times_s, phases) > CLEARLY * mistaken, mistaken


def _given_to_tissue(poses: Tensor, like: Tensor, times_s: Tensor, phases: Tensor) -> float:
    """Return the root mean square of the camera motion at the breathing phase that a smooth trajectory does not explain.
    The smoothness is learned from the poses `like`.
    """
    swings = waves_of(phases)
    prior = learned_from(like, times_s, swings)
    y, _ = coordinates(poses)
    part = torch.stack([_line(prior, swings, y[:, axis], axis) for axis in range(PLACES.stop)], 1)
    return float((part - part.mean(0)).square().sum(1).mean().sqrt())


def _line(prior: TrajectoryPrior, swings: Tensor, y: Tensor, axis: int) -> Tensor:
    """Return the part [C] of a camera coordinate `y` [C] that varies with the breathing phase, the first one in `swings`, by
    generalised least squares with the precision of the trajectory prior.
    """
    pushed = swings.T @ prior.precision[axis]
    return swings[:, :2] @ torch.linalg.solve(pushed @ swings, pushed @ y)[:2]


EVERY_S = 0.2
"""Average time in seconds between the frames that are adjusted; longer if there would be more than `MOST_FRAMES` of them."""
FEWEST_FRAMES, MOST_FRAMES = 40, 150
LONGEST_S = 60.0
POINTS, LEAST_SEEN = 400, 5
"""Largest number of points that are adjusted, those with the most observations, and the least number of observations of each."""
FEWEST_POINTS = 60
NEAREST, FARTHEST = 0.5, 2.0
"""Range of accepted initial depths relative to the median depth. Points outside it start at the median depth."""
FINEST = 0.002
STAGES = ((0.016, 8), (0.008, 8), (0.004, 8), *((FINEST, 8),) * 13)
"""Optimisation stages: scale of the robust loss of ray errors (x / z) and number of steps. The trajectory prior is re-estimated
before each stage.
"""
FEW_POINTS, FEW_FRAMES, FEW_NODES = 200, 100, 16
"""Size of the reduced problem on which frequencies are searched. With fewer frames,
aliasing at their rate resembles a heartbeat.
"""
SAMPLED = 0.4
"""Highest frequency of tissue motion that is searched, as a share of the frame rate, to avoid aliasing."""
LEAST_SHARED, PLACE_ROUNDS = 24, 10
"""Fewest observations of moving points for refining the pose of an intermediate frame, and the number of adjustment
steps for it.
"""
GOLDEN = 0.5 * (5**0.5 - 1)


@dataclass(frozen=True)
class Sightings:
    """Point observations of all frames with a static reconstruction.

    The unit of length is about the distance of the points from the camera.
    """

    frame: Tensor
    """Frame index of each observation, int64 [K], ascending."""
    point: Tensor
    """Point index of each observation, int64 [K]."""
    rays: Tensor
    """Observed rays as x / z and y / z, [K, 2]."""
    times_s: Tensor
    """Time of every frame in seconds, [N]."""
    poses: Tensor
    """World-to-camera poses of the static reconstruction, [N, 4, 4]."""
    points: Tensor
    """Point positions of the static reconstruction, [P, 3]."""


@dataclass(frozen=True)
class BreathingTrajectory:
    """Trajectory and periodic motion found for a recording."""

    poses: Tensor
    """World-to-camera poses of all frames, [N, 4, 4]. The first one is the identity. The unit of
    length is the median depth of the points.
    """
    points: Tensor
    """Rest positions of the points used, [P, 3]."""
    frequencies_hz: tuple[float, ...]
    """Mean breathing frequency, or mean breathing and heart frequencies."""
    uncertain: float
    """Root mean square share of the trajectory that may be tissue motion instead of scope motion,
    in units of the median depth.
    """
    error: float
    """Median distance between the observed rays and the projected moving points, in units of the focal length (x / z)."""


@one_thread()
def breathing_trajectory(sightings: Sightings, placed: Tensor) -> BreathingTrajectory | None:
    """Estimate the scope's trajectory in front of breathing tissue.

    Args:
        sightings: observations and the static reconstruction.
        placed: bool [N], frames with a known pose.

    Returns:
        The trajectory, or None if the recording is unsuitable or no periodic motion is found.
    """
    length_s = float(sightings.times_s[-1] - sightings.times_s[0])
    known = torch.nonzero(placed)[:, 0]
    if not LEAST_CYCLES / BREATHING_HZ[1] <= length_s <= LONGEST_S or len(known) < FEWEST_FRAMES:
        return None
    frames = _some(known, max(FEWEST_FRAMES, min(MOST_FRAMES, round(length_s / EVERY_S) + 1)))
    few = _some(known, FEW_FRAMES)
    fewer = _bundle(sightings, few, FEW_POINTS, FEW_NODES)
    if fewer is None:
        return None
    fastest_hz = SAMPLED * (len(sightings.times_s) - 1) / length_s
    frequencies_hz = frequencies_of(fewer[0], sightings.times_s[few], fastest_hz)
    start = _bundle(sightings, frames, POINTS, MOST_NODES)
    if not frequencies_hz or start is None:
        return None
    found, rhythm, prior = refined(start[0], sightings.times_s[frames], frequencies_hz)
    separable, mistaken = separability(start[0].poses, found.poses, sightings.times_s[frames], rhythm.phases)
    turns = (rhythm.phases[-1] - rhythm.phases[0]) / (2 * torch.pi)
    if not separable or float(turns[0]) < LEAST_CYCLES:
        return None
    poses = _all_placed(sightings, frames, found, start[1], rhythm)
    frequencies_hz = tuple((turns / (sightings.times_s[frames[-1]] - sightings.times_s[frames[0]])).tolist())
    error = float(found.off().norm(dim=1).median())
    return BreathingTrajectory(poses, found.rest, frequencies_hz, max(prior.uncertain, mistaken), error)


@one_thread()
def refined(
    start: MovingBundle, times_s: Tensor, frequencies_hz: tuple[float, ...]
) -> tuple[MovingBundle, Rhythm, TrajectoryPrior]:
    """Optimise cameras, tissue, periodic motion and its phases from a static start.

    Args:
        start: static bundle.
        times_s: float64 [T], time of each camera in seconds.
        frequencies_hz: mean frequencies.

    Returns:
        The adjusted bundle, its phases, and the trajectory prior learned from the result.
    """
    bundle = with_rhythm(start, Rhythm.steady(times_s, frequencies_hz))
    for spread, rounds in STAGES:
        prior = learned_from(bundle.poses, times_s, bundle.waves)
        bundle, _ = adjust(_with_new_nodes(bundle), spread, rounds, prior)
    assert bundle.rhythm is not None
    return bundle, bundle.rhythm, learned_from(bundle.poses, times_s, bundle.waves)


def _some(frames: Tensor, most: int) -> Tensor:
    """Select at most `most` frames, including the first and the last. The spacing is irregular to
    avoid aliasing of fast motion.
    """
    if len(frames) <= most:
        return frames
    shift = (torch.arange(most, dtype=torch.float64) * GOLDEN) % 1 - 0.5
    shift[0] = shift[-1] = 0
    at = torch.linspace(0, len(frames) - 1, most, dtype=torch.float64) + 0.8 * shift * (len(frames) / most)
    return frames[torch.unique(at.round().long().clamp(0, len(frames) - 1))]


def _bundle(sightings: Sightings, frames: Tensor, most: int, nodes: int) -> tuple[MovingBundle, Tensor] | None:
    """Build a static bundle from the given frames and their most observed points.

    Returns:
        The bundle and the point numbers, or None with fewer than `FEWEST_POINTS` points.
    """
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
    """Return points [P, 3] moved to the rays of their first observation, with their depth, or with the median depth if theirs is
    outside of `NEAREST` to `FARTHEST` times the median.
    """
    number = torch.arange(len(point))
    first = torch.zeros(len(rest), dtype=torch.int64).scatter_reduce(0, point, number, "amin", include_self=False)
    pose = poses[camera[first]]
    depth = (pose[:, 2, :3] * rest).sum(1) + pose[:, 2, 3]
    middle = depth.median()
    depth = torch.where((depth > NEAREST * middle) & (depth < FARTHEST * middle), depth, middle)
    local = torch.cat([rays[first], torch.ones_like(depth)[:, None]], 1) * depth[:, None]
    return (pose[:, :3, :3].transpose(1, 2) @ (local - pose[:, :3, 3])[:, :, None])[:, :, 0]


def _with_new_nodes(bundle: MovingBundle) -> MovingBundle:
    """Resample the motion field on nodes placed among the points' current rest positions."""
    field = SurfaceField.over(bundle.rest, len(bundle.field.nodes))
    amplitudes = torch.einsum("nm,mjb->njb", bundle.field.influence(field.nodes), bundle.amplitudes)
    return replace(bundle, field=field, amplitudes=amplitudes, influence=field.influence(bundle.rest))


def _all_placed(sightings: Sightings, frames: Tensor, found: MovingBundle, numbers: Tensor, rhythm: Rhythm) -> Tensor:
    """Return poses of all frames. Poses and phases of frames between the adjusted ones are interpolated, and the poses
    then aligned to the moving points.
    """
    poses = _between(frames, found.poses, len(sightings.times_s))
    chosen = torch.isin(sightings.point, numbers) & ~torch.isin(sightings.frame, frames)
    shared = torch.bincount(sightings.frame[chosen], minlength=len(poses))
    chosen &= shared[sightings.frame] >= LEAST_SHARED
    rest = torch.searchsorted(numbers, sightings.point[chosen])
    amplitudes_at = torch.einsum("pm,mjb->pjb", found.influence, found.amplitudes)
    swings = waves_of(_interpolated(sightings.times_s, sightings.times_s[frames], rhythm.phases))
    moved = torch.einsum("kjb,kb->kj", amplitudes_at[rest], swings[sightings.frame[chosen]])
    at = torch.arange(len(rest))
    between = Bundle(poses, found.rest[rest] + moved, sightings.frame[chosen], at, sightings.rays[chosen], 1 / FINEST)
    fixed = shared < LEAST_SHARED
    fixed[frames] = True
    if fixed.all():
        return poses
    return place_cameras(between, fixed=fixed, rounds=PLACE_ROUNDS)


def _between(frames: Tensor, poses: Tensor, count: int) -> Tensor:
    """Interpolate poses of all frames [count, 4, 4] along screw motions. Poses are constant before
    the first and after the last given frame.
    """
    number = torch.arange(count)
    after = torch.searchsorted(frames, number).clamp(1, len(frames) - 1)
    first, second = frames[after - 1], frames[after]
    share = ((number - first) / (second - first)).clamp(0, 1)[:, None].double()
    start = poses[after - 1]
    return exp(share * log(poses[after] @ inverse(start))) @ start


def _interpolated(times_s: Tensor, known_s: Tensor, phases: Tensor) -> Tensor:
    """Interpolate phases [C, F] at the known times [C] linearly at other times [N]."""
    columns = [np.interp(times_s.numpy(), known_s.numpy(), each.numpy()) for each in phases.T]
    return torch.from_numpy(np.stack(columns, 1))
