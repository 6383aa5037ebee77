"""Parts of the trajectory before breathing tissue: search of frequencies, choice of frames and points, frames between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.poses import breathing
from gsplat_core.poses.breathing import Sightings, breathing_trajectory, frequencies_of, separability, waves
from gsplat_core.poses.moving_bundle import MovingBundle, Rhythm, SurfaceField
from gsplat_core.poses.se3 import exp
from tests.gsplat_core.geometry.breathing_sightings import bundle_of, seen_for

Cost = Callable[[tuple[float, ...]], float]


def valley(hz: float, at: float, deep: float, wide: float = 0.06) -> float:
    """Return by how much a frequency lowers the cost: linear to both sides of its place."""
    return deep * max(0.0, 1 - abs(hz - at) / wide)


@pytest.fixture
def search(monkeypatch):
    """Return the frequencies found and tried in a recording where tissue at rest costs 100 and frequencies a given cost."""
    bundle = bundle_of(seen_for(2.0, points=20)[0], torch.zeros(20, 0))

    def found(cost: Cost, length_s: float = 20.0, fastest_hz: float = 3.0):
        tried = []

        def adjusted(start: MovingBundle, times_s, hz: tuple[float, ...], rounds: int):
            tried.append(hz)
            return breathing._Try(hz, start, cost(hz))

        monkeypatch.setattr(breathing, "adjust", lambda start, spread, rounds: (start, 100.0))
        monkeypatch.setattr(breathing, "_tried", adjusted)
        times_s = torch.linspace(3.0, 3.0 + length_s, 20, dtype=torch.float64)
        return frequencies_of(bundle, times_s, fastest_hz), tried

    return found


@pytest.mark.parametrize(("deep", "expected"), [(24.0, ()), (26.0, (0.3,))])
def test_breathing_frequency_requires_a_quarter_lower_cost(search, deep, expected):
    hz, _ = search(lambda hz: 100 - valley(hz[0], 0.3, deep))
    assert hz == pytest.approx(expected)


@pytest.mark.parametrize(("share", "expected"), [(0.05, (0.3,)), (0.07, (0.3, 1.2))])
def test_heart_frequency_requires_cost_below_94_percent(search, share, expected):
    hz, _ = search(
        lambda hz: (100 - valley(hz[0], 0.3, 50)) * (1 - (valley(hz[1], 1.2, share) if len(hz) > 1 else 0.0))
    )
    assert hz == pytest.approx(expected)


@pytest.mark.parametrize(
    ("length_s", "fastest_hz", "slowest", "last", "heart"),
    [(20.0, 3.0, 0.1, 0.8, 3.0), (4.0, 3.0, 0.125, 0.8, 3.0), (20.0, 1.5, 0.1, 0.8, 1.5), (20.0, 0.5, 0.1, 0.5, None)],
)
def test_frequency_search_steps_and_bounds(search, length_s, fastest_hz, slowest, last, heart):
    """From a tenth of a Hertz, or half a cycle in the recording, to 0.8 Hz, and from there to three."""
    _, tried = search(lambda hz: 100 - valley(hz[0], 0.45, 50, 0.4), length_s, fastest_hz)
    breaths = [hz[0] for hz in tried if len(hz) == 1]
    beats = [hz[1] for hz in tried if len(hz) == 2]
    assert breaths[0] == pytest.approx(slowest)
    np.testing.assert_allclose(np.diff(breaths), 0.25 / length_s)
    assert last - 0.25 / length_s - 1e-9 <= breaths[-1] < last
    if heart is None:
        assert beats == []
    else:
        assert beats[0] == pytest.approx(0.8)
        np.testing.assert_allclose(np.diff(beats), 0.5 / length_s)
        assert heart - 0.5 / length_s - 1e-9 <= beats[-1] < heart


def test_frequency_below_one_and_a_half_cycles_is_not_breathing(search):
    """A slower frequency that explains more is motion of the scope, and twice its value is not breathing."""
    cost = lambda slow: lambda hz: 100 - valley(hz[0], 0.125, slow, 0.03) - valley(hz[0], 0.275, 40, 0.03)
    assert search(cost(60.0), 10.0)[0] == ()
    assert search(cost(20.0), 10.0)[0] == pytest.approx((0.275,))
    for at, expected in ((0.125, ()), (0.175, (0.175,))):
        assert search(lambda hz, at=at: 100 - valley(hz[0], at, 50, 0.03), 10.0)[0] == pytest.approx(expected)


@pytest.mark.parametrize("at", [0.05, 0.85])
def test_frequency_at_band_end_is_rejected(search, at):
    assert search(lambda hz: 100 - valley(hz[0], at, 90, 0.3))[0] == ()


def test_breathing_frequency_is_refined_after_heart_is_found(search):
    """Without the heart, weak breathing at 0.3 Hz is hidden and another frequency looks a little better."""

    def cost(hz: tuple[float, ...]) -> float:
        if len(hz) == 1:
            return 90 - valley(hz[0], 0.5, 2)
        return 90 - valley(hz[1], 1.5, 40) - (valley(hz[0], 0.3, 20) if abs(hz[1] - 1.5) < 0.03 else 0)

    assert search(cost)[0] == pytest.approx((0.3, 1.5))


TIMES_S = torch.arange(0, 20, 0.25, dtype=torch.float64)


def way(breath: float, sway_hz: float) -> torch.Tensor:
    """Return poses of a scope that sways, and moves with the breathing at 0.4 Hz in all directions."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(TIMES_S), 1, 1)
    sway, phase = 0.2 * torch.sin(2 * torch.pi * sway_hz * TIMES_S), 2 * torch.pi * 0.4 * TIMES_S
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 1e-4, (len(TIMES_S), 3)))
    moved = torch.stack([2 * torch.sin(phase), 2 * torch.cos(phase), torch.sin(phase + 1)], 1)
    poses[:, :3, 3] = torch.stack([sway, -sway, 0.5 * sway], 1) + breath * moved + noise
    return poses


def test_separability_of_breathing_from_slow_scope():
    phases = 2 * torch.pi * 0.4 * TIMES_S[:, None]
    reliable, mistaken = separability(way(0.03, 0.08), way(0.0, 0.08), TIMES_S, phases)
    assert reliable and mistaken < 0.001
    given = breathing._given_to_tissue(way(0.03, 0.08), way(0.0, 0.08), TIMES_S, phases)
    assert given == pytest.approx(0.03 * (9 / 2) ** 0.5, rel=0.05)


@pytest.mark.parametrize("sway_hz", [0.375, 0.425])
def test_separability_fails_if_scope_sways_at_both_neighbour_frequencies(sway_hz):
    both = way(0.0, 0.375)
    both[:, :3, 3] += way(0.0, 0.425)[:, :3, 3]
    phases = 2 * torch.pi * 0.4 * TIMES_S[:, None]
    reliable, mistaken = separability(both, both, TIMES_S, phases)
    assert not reliable and mistaken > 0.05
    alone = way(0.0, sway_hz)
    assert separability(way(0.03, 0.08), alone, TIMES_S, phases)[1] < 0.02, "one neighbour is the slow scope"


@pytest.mark.parametrize(("ratio", "reliable"), [(1.9, False), (2.1, True)])
def test_separability_requires_twice_the_neighbour_amplitude(monkeypatch, ratio, reliable):
    phases = 2 * torch.pi * 0.4 * TIMES_S[:, None]
    before, poses = way(0.03, 0.08), way(0.0, 0.08)
    monkeypatch.setattr(breathing, "_given_to_tissue", lambda poses, *_: ratio if poses is before else 1.0)
    assert separability(before, poses, TIMES_S, phases) == (reliable, 1.0)


@pytest.mark.parametrize(("count", "most"), [(500, 100), (500, 150), (120, 100), (3000, 40)])
def test_some_frames_are_irregularly_spread_over_recording(count, most):
    frames = torch.arange(count) * 3 + 7
    some = breathing._some(frames, most)
    assert some[0] == frames[0] and some[-1] == frames[-1] and bool(torch.isin(some, frames).all())
    assert 0.8 * most <= len(some) <= most
    gaps = some.diff().double() / 3 / (count / most)
    assert bool((gaps > 0).all()) and float(gaps.max()) < 2.1
    assert count < 2 * most or float(gaps.std()) > 0.3
    assert torch.equal(breathing._some(frames, count), frames)


def sightings(frames: int = 12, points: int = 80, seed: int = 0) -> tuple[Sightings, torch.Tensor]:
    """Return exact observations of points by a scope that moves along a screw, and the scope's twist per frame."""
    random = np.random.default_rng(seed)
    at = torch.from_numpy(random.uniform([-1, -1, 1.6], [1, 1, 2.4], (points, 3)))
    twist = torch.tensor([0.02, -0.01, 0.015, 0.01, 0.02, -0.03], dtype=torch.float64)
    poses = exp(torch.arange(frames, dtype=torch.float64)[:, None] * twist)
    frame, point = (
        each.flatten() for each in torch.meshgrid(torch.arange(frames), torch.arange(points), indexing="ij")
    )
    local = (poses[frame, :3, :3] @ at[point][:, :, None])[:, :, 0] + poses[frame, :3, 3]
    times_s = torch.arange(frames, dtype=torch.float64) / 5
    return Sightings(frame, point, local[:, :2] / local[:, 2:], times_s, poses, at), twist


def test_breathing_bundle_keeps_most_seen_points_and_unit_depth():
    seen, _ = sightings()
    frames = torch.arange(2, 11)
    # 0 to 9 are seen in four frames, 10 to 19 in five and 20 to 29 in eight of the nine.
    kept = torch.ones(len(seen.frame), dtype=torch.bool)
    for first, last in ((0, 5), (10, 6), (20, 9)):
        kept &= ~((seen.point >= first) & (seen.point < first + 10) & (seen.frame > last))
    some = replace(seen, frame=seen.frame[kept], point=seen.point[kept], rays=seen.rays[kept])
    built = breathing._bundle(some, frames, 400, 16)
    assert built is not None
    bundle, numbers = built
    assert numbers.tolist() == list(range(10, 80))
    fewer = breathing._bundle(some, frames, 65, 16)
    assert fewer is not None and set(range(20, 80)) <= set(fewer[1].tolist()) and len(fewer[1]) == 65
    assert float(bundle.rest[:, 2].median()) == pytest.approx(1.0)
    torch.testing.assert_close(bundle.poses[0], torch.eye(4, dtype=torch.float64))
    assert float(bundle.off().abs().max()) < 1e-12, "exact sightings fit"
    assert len(bundle.poses) == 9 and len(bundle.field.nodes) <= 16 and bundle.amplitudes.shape[1:] == (3, 0)


@pytest.mark.parametrize(("points", "enough"), [(59, False), (60, True)])
def test_breathing_bundle_requires_sixty_points(points, enough):
    seen, _ = sightings(points=points)
    assert (breathing._bundle(seen, torch.arange(12), 400, 16) is not None) == enough


def test_limited_moves_implausible_points_to_median_depth():
    seen, _ = sightings(points=9)
    local = torch.tensor([2.0] * 5 + [0.98, 1.02, 3.96, 4.04], dtype=torch.float64)
    rest = torch.cat([seen.rays[:9], torch.ones(9, 1)], 1) * local[:, None]
    found = breathing._limited(seen.poses, rest, seen.frame, seen.point, seen.rays)
    torch.testing.assert_close(found[:, 2], local.where((local > 1) & (local < 4), 2.0))
    torch.testing.assert_close(found[:, :2] / found[:, 2:], seen.rays[:9])


def test_between_interpolates_screw_motion_and_holds_ends():
    frames = torch.tensor([2, 5, 9])
    seen, twist = sightings()
    found = breathing._between(frames, seen.poses[frames], 12)
    for number in range(12):
        torch.testing.assert_close(found[number], exp(min(max(number, 2), 9) * twist[None])[0])


def test_all_placed_uses_frames_with_24_or_more_points():
    """Their true poses are not between those of their neighbours. Frame 5 sees 23 of the points and frame 7 sees 24."""
    seen, _ = sightings()
    frames = torch.tensor([0, 2, 4, 6, 8, 11])
    aside = torch.eye(4, dtype=torch.float64)
    aside[:3, 3] = torch.tensor([0.03, -0.02, 0.01])
    true = torch.stack([pose if number in frames else aside @ pose for number, pose in enumerate(seen.poses)])
    field = SurfaceField.over(seen.points, 16)
    amplitudes = torch.zeros(len(field.nodes), 3, 2, dtype=torch.float64)
    amplitudes[:, :, 0], amplitudes[:, :, 1] = torch.tensor([0.05, 0.0, 0.02]), torch.tensor([0.0, -0.03, 0.0])
    rhythm = Rhythm.steady(seen.times_s[frames], (0.4,))
    found = MovingBundle(
        seen.poses[frames], seen.points, amplitudes, seen.frame[:0], seen.point[:0], seen.rays[:0],
        rhythm.waves, field.influence(seen.points), field, rhythm,
    )  # fmt: skip
    swings = waves(seen.times_s, (0.4,))
    vectors = torch.einsum("pm,mjb->pjb", found.influence, amplitudes)
    at = seen.points[seen.point] + torch.einsum("kjb,kb->kj", vectors[seen.point], swings[seen.frame])
    local = (true[seen.frame, :3, :3] @ at[:, :, None])[:, :, 0] + true[seen.frame, :3, 3]
    kept = ~((seen.frame == 5) & (seen.point >= 23)) & ~((seen.frame == 7) & (seen.point >= 24))
    moved = replace(seen, frame=seen.frame[kept], point=seen.point[kept], rays=(local[:, :2] / local[:, 2:])[kept])
    placed = breathing._all_placed(moved, frames, found, torch.arange(80), rhythm)
    for number in range(12):
        expected = seen.poses[number] if number == 5 else true[number]
        torch.testing.assert_close(placed[number], expected, atol=1e-6, rtol=0)


def test_interpolated_phases_are_linear_in_time():
    known_s, times_s = torch.tensor([0.0, 1.0, 3.0]).double(), torch.tensor([0.0, 0.5, 2.0, 3.0]).double()
    phases = torch.tensor([[0.0, 1.0], [2.0, 5.0], [4.0, 6.0]]).double()
    expected = [[0.0, 1.0], [1.0, 3.0], [3.0, 5.5], [4.0, 6.0]]
    assert breathing._interpolated(times_s, known_s, phases).tolist() == expected


def test_with_new_nodes_keeps_motion():
    seen, _ = sightings()
    bundle = bundle_of(seen, waves(seen.times_s, (0.4,)), 30)
    linear = torch.tensor([[0.1, 0.0, 0.02], [0.0, -0.05, 0.0], [0.03, 0.0, 0.0]], dtype=torch.float64)
    amplitudes = torch.stack([bundle.field.nodes @ linear, torch.ones_like(bundle.field.nodes)], 2)
    bundle = replace(bundle, amplitudes=amplitudes, rest=bundle.rest + 0.05)
    found = breathing._with_new_nodes(bundle)
    assert len(found.field.nodes) == len(bundle.field.nodes) and not torch.equal(found.field.nodes, bundle.field.nodes)
    motion = torch.einsum("pm,mjb->pjb", found.influence, found.amplitudes)
    assert float((motion[:, :, 0] - found.rest @ linear).abs().max()) < 0.005
    torch.testing.assert_close(motion[:, :, 1], torch.ones(80, 3, dtype=torch.float64), atol=1e-3, rtol=0)


class Reached(Exception):
    """Raised in place of the optimisation."""


@pytest.mark.parametrize(
    ("count", "length_s", "chosen"),
    [
        (80, 1.8, None),
        (80, 1.9, (100, 40)),
        (400, 6.0, (100, 40)),
        (400, 20.0, (100, 101)),
        (400, 59.0, (100, 150)),
        (400, 60.1, None),
        (39, 20.0, None),
        (40, 20.0, (40, 101)),
    ],
)
def test_breathing_trajectory_frame_count_by_recording_length(monkeypatch, count, length_s, chosen):
    """About 100 for the frequencies, and then five per second, from 40 to 150, in recordings of 1.875 to 60 seconds."""
    times_s = torch.linspace(0, length_s, count, dtype=torch.float64)
    seen = Sightings(*(torch.zeros(0),) * 3, times_s, torch.zeros(count, 4, 4), torch.zeros(0, 3))
    some, sizes = breathing._some, []

    def spread(frames, most):
        found = some(frames, most)
        sizes.append((most, len(found)))
        return found

    def searched(bundle, at_s, fastest_hz):
        assert at_s[0] == 0 and at_s[-1] == times_s[-1] and bundle == "bundle"
        assert fastest_hz == pytest.approx(0.4 * (count - 1) / length_s)
        raise Reached

    monkeypatch.setattr(breathing, "_some", spread)
    monkeypatch.setattr(breathing, "_bundle", lambda seen, frames, most, nodes: ("bundle", None))
    monkeypatch.setattr(breathing, "frequencies_of", searched)
    placed = torch.ones(count, dtype=torch.bool)
    if chosen is None:
        assert breathing_trajectory(seen, placed) is None and sizes == []
        return
    with pytest.raises(Reached):
        breathing_trajectory(seen, placed)
    assert sorted(most for most, _ in sizes) == sorted((100, chosen[1]))
    assert all(0.8 * min(most, count) <= size <= min(most, count) for most, size in sizes)
