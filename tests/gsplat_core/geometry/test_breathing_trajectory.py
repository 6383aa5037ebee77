"""The scope's trajectory before tissue that breathes, in worlds of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.poses.breathing import LONGEST_S, BreathingTrajectory, breathing_trajectory, frequencies_of, waves
from tests.gsplat_core.geometry.breathing_points import BREATHING_HZ, HEART_HZ
from tests.gsplat_core.geometry.breathing_sightings import bundle_of, seen_for


def off_share(poses, true):
    errors = evaluate_trajectory(poses.numpy(), true)
    assert errors is not None
    return errors.similarity_share


def found_in(sightings) -> BreathingTrajectory | None:
    return breathing_trajectory(sightings, torch.ones(len(sightings.times_s), dtype=torch.bool))


@pytest.fixture(scope="module")
def breathing():
    sightings, true = seen_for(14.0, rate_hz=5.0, points=150)
    return sightings, true, found_in(sightings)


@pytest.mark.slow
def test_breathing_trajectory_separates_breathing_and_heart(breathing):
    sightings, true, found = breathing
    assert found is not None
    assert off_share(sightings.poses, true) > 0.02
    assert off_share(found.poses, true) < 0.007
    np.testing.assert_allclose(found.frequencies_hz, (BREATHING_HZ, HEART_HZ), atol=0.01)
    assert found.error < 0.002


@pytest.mark.slow
def test_breathing_trajectory_uncertainty_matches_error(breathing):
    _, true, found = breathing
    assert found is not None
    way = np.linalg.norm(np.diff(np.linalg.inv(found.poses.numpy())[:, :3, 3], axis=0), axis=1).sum()
    assert 0.2 * off_share(found.poses, true) < found.uncertain / way < 5 * off_share(found.poses, true)


@pytest.mark.slow
def test_breathing_trajectory_starts_at_identity_with_unit_distance(breathing):
    *_, found = breathing
    assert found is not None
    torch.testing.assert_close(found.poses[0], torch.eye(4, dtype=torch.float64))
    assert float(found.points[:, 2].median()) == pytest.approx(1.0)


@pytest.mark.slow
def test_breathing_trajectory_is_robust_to_pulled_tissue():
    sightings, true = seen_for(12.0, rate_hz=4.0, pulled=30, points=150)
    found = found_in(sightings)
    assert found is not None
    assert off_share(found.poses, true) < 0.01


@pytest.mark.slow
def test_breathing_trajectory_finds_smaller_and_faster_breaths():
    sightings, true = seen_for(14.0, breathes=0.5, rate_hz=5.0, points=150)
    faster = replace(sightings, times_s=sightings.times_s / 1.5)
    found = found_in(faster)
    assert found is not None
    assert found.frequencies_hz[0] == pytest.approx(1.5 * BREATHING_HZ, abs=0.02)
    assert off_share(found.poses, true) < off_share(sightings.poses, true)


@pytest.mark.slow
def test_breathing_trajectory_is_none_for_tissue_at_rest():
    assert found_in(seen_for(20.0, breathes=0.0, rate_hz=5.0, points=150)[0]) is None


@pytest.mark.parametrize("length_s", [1.0, 2.5, 4.5])
def test_breathing_trajectory_is_none_below_one_and_a_half_breaths(length_s):
    assert found_in(seen_for(length_s, rate_hz=30.0, points=100)[0]) is None


def test_breathing_trajectory_is_none_for_too_long_recording():
    sightings, _ = seen_for(8.0)
    assert found_in(replace(sightings, times_s=sightings.times_s * (LONGEST_S + 1) / 7.9)) is None


def test_breathing_trajectory_is_none_for_few_points_or_frames():
    sightings, _ = seen_for(12.0)
    some = sightings.point < 50
    few = replace(sightings, frame=sightings.frame[some], point=sightings.point[some], rays=sightings.rays[some])
    assert found_in(few) is None
    assert breathing_trajectory(sightings, torch.arange(len(sightings.times_s)) < 30) is None


@pytest.mark.slow
def test_breathing_trajectory_tolerates_bad_points_and_unplaced_frames():
    """Some points start behind the scope or far away, and four frames have neither a pose nor observations."""
    sightings, true = seen_for(12.0, rate_hz=4.0, points=150)
    points = sightings.points.clone()
    points[::9, 2] *= -1
    points[4::9] *= 1e4
    placed = torch.ones(len(sightings.times_s), dtype=torch.bool)
    placed[40:44] = False
    poses, seen = sightings.poses.clone(), placed[sightings.frame]
    poses[40:44] = torch.nan
    kept = {name: getattr(sightings, name)[seen] for name in ("frame", "point", "rays")}
    found = breathing_trajectory(replace(sightings, poses=poses, points=points, **kept), placed)
    assert found is not None and bool(found.poses.isfinite().all())
    assert off_share(found.poses, true) < 0.01


@pytest.mark.slow
def test_frequencies_of_finds_breathing_and_heart_and_none_at_rest():
    """To half a step of the search, 0.25 cycles for breathing and 0.5 for the heart; `refined` estimates them further."""
    for breathes, expected in ((1.0, (BREATHING_HZ, HEART_HZ)), (0.0, ())):
        sightings, _ = seen_for(12.0, breathes, rate_hz=4.0, points=100)
        found = frequencies_of(
            bundle_of(sightings, waves(sightings.times_s, ()), 12), sightings.times_s, fastest_hz=1.6
        )
        assert len(found) == len(expected)
        for hz, true, cycles in zip(found, expected, (0.125, 0.25), strict=False):
            assert hz == pytest.approx(true, abs=cycles / 11.7)
