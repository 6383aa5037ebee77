"""Prior of a scope's trajectory."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.poses.breathing import waves
from gsplat_core.poses.moving_bundle import coordinates, learned_from
from gsplat_core.poses.se3 import exp
from tests.gsplat_core.geometry.breathing_points import DISTANCE, swaying


def way(length_s: float, line: float = 0.0):
    """Poses of a swaying scope, `line` times a motion at 0.31 Hz more, and their times; the unit is the tissue's distance."""
    times_s = torch.arange(0, length_s, 0.4, dtype=torch.float64)
    poses = torch.from_numpy(swaying(times_s.numpy()))
    poses[:, :3, 3] /= DISTANCE
    twist = torch.zeros(len(times_s), 6, dtype=torch.float64)
    twist[:, 0] = line * torch.sin(2 * torch.pi * 0.31 * times_s)
    return exp(twist) @ poses, times_s


def test_coordinates_derivatives_equal_finite_differences():
    poses, _ = way(8.0)
    _, by_twist = coordinates(poses)
    for axis in range(6):
        for camera in (0, 3, len(poses) - 1):
            twist = torch.zeros(len(poses), 6, dtype=torch.float64)
            twist[camera, axis] = 1e-6
            found = (coordinates(exp(twist) @ poses)[0] - coordinates(exp(-twist) @ poses)[0]) / 2e-6
            torch.testing.assert_close(found[camera], by_twist[camera, :, axis], atol=2e-5, rtol=1e-4)


def test_trajectory_prior_cost_and_terms_agree():
    poses, times_s = way(8.0)
    prior = learned_from(poses, times_s, waves(times_s, (0.31,)))
    matrix, slope = prior.terms(poses)
    twist = 1e-5 * torch.cos(torch.arange(6 * len(poses), dtype=torch.float64))
    expected = float(slope @ twist + 0.5 * twist @ matrix @ twist)
    found = prior.cost(exp(twist.view(-1, 6)) @ poses) - prior.cost(poses)
    assert found == pytest.approx(expected, rel=0.02)


def test_trajectory_prior_penalises_periodic_line():
    poses, times_s = way(20.0)
    lined, _ = way(20.0, 0.1)
    prior = learned_from(lined, times_s, waves(times_s, (0.31,)))
    assert prior.cost(poses) < 0.5 * prior.cost(lined)


def test_trajectory_prior_cost_is_independent_of_origin():
    poses, times_s = way(12.0)
    prior = learned_from(poses, times_s, waves(times_s, (0.31,)))
    away = poses.clone()
    away[:, :3, 3] = away[:, :3, 3] - away[:, :3, :3] @ torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    assert prior.cost(away) == pytest.approx(prior.cost(poses), rel=1e-3)


def test_trajectory_prior_uncertainty_falls_with_length():
    uncertain = []
    for length_s in (8.0, 16.0, 32.0):
        poses, times_s = way(length_s)
        uncertain.append(learned_from(poses, times_s, waves(times_s, (0.31,))).uncertain)
    assert uncertain[0] > uncertain[1] > uncertain[2] > 0


def test_trajectory_prior_of_scope_at_rest_is_finite():
    poses = torch.eye(4, dtype=torch.float64).repeat(30, 1, 1)
    times_s = torch.arange(30, dtype=torch.float64)
    prior = learned_from(poses, times_s, waves(times_s, (0.31,)))
    assert bool(prior.precision.isfinite().all()) and prior.cost(poses) == 0
