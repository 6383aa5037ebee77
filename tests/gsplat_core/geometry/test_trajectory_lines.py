"""Breathing is taken from a trajectory only if it can be separated from the scope's own motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.poses.breathing import separability, waves
from gsplat_core.poses.moving_bundle import coordinates, learned_from
from gsplat_core.poses.se3 import exp

TIMES_S = torch.arange(0, 20, 0.2, dtype=torch.float64)


def poses(*swings: tuple[float, float, int]) -> torch.Tensor:
    """A scope that sways along its axes with these frequencies and amplitudes, in units of the tissue's distance."""
    twist = torch.zeros(len(TIMES_S), 6, dtype=torch.float64)
    random = torch.from_numpy(np.random.default_rng(0).normal(0, 3e-4, twist.shape))
    for hz, amplitude, axis in swings:
        twist[:, axis] += amplitude * torch.sin(2 * torch.pi * hz * TIMES_S + axis)
    return exp(twist + random)


def refined(poses: torch.Tensor, hz: tuple[float, ...]) -> torch.Tensor:
    """Return a trajectory without the periodic part that the prior attributes to the tissue."""
    poses, swings = poses.clone(), waves(TIMES_S, hz)
    for _ in range(4):
        prior = learned_from(poses, TIMES_S, swings)
        y, _ = coordinates(poses)
        for axis in range(3):
            pushed = swings.T @ prior.precision[axis]
            y[:, axis] -= swings @ torch.linalg.solve(pushed @ swings, pushed @ y[:, axis])
        poses[:, :3, 3] = -(poses[:, :3, :3] @ y[:, :3, None])[:, :, 0]
    return poses


def phases(*hz: float) -> torch.Tensor:
    return 2 * torch.pi * TIMES_S[:, None] * torch.tensor(hz, dtype=torch.float64)


def sways(fastest_hz: float) -> list[tuple[float, float, int]]:
    return [(fastest_hz, 0.1, 0), (0.19, 0.06, 1), (0.15, 0.08, 2)]


def test_separability_of_breathing_faster_than_scope():
    way, breathing = sways(0.22), (0.33, 0.03, 0)
    separable, mistaken = separability(both := poses(*way, breathing), refined(both, (0.33,)), TIMES_S, phases(0.33))
    assert separable and mistaken < 0.01


@pytest.mark.parametrize("gap_hz", [0.027, -0.027])
def test_separability_fails_for_scope_swaying_nearly_as_fast(gap_hz):
    way, breathing = sways(0.25 + gap_hz), (0.25, 0.01, 0)
    separable, mistaken = separability(both := poses(*way, breathing), refined(both, (0.25,)), TIMES_S, phases(0.25))
    assert not separable and mistaken > 0.01


def test_separability_of_strong_breathing_near_scope_frequency():
    """Poses that keep it would be off by more."""
    way, breathing = sways(0.22), (0.25, 0.4, 0)
    separable, mistaken = separability(both := poses(*way, breathing), refined(both, (0.25,)), TIMES_S, phases(0.25))
    assert separable and mistaken > 0.005


def test_separability_of_breathing_with_heart_frequency():
    way, lines = sways(0.22), [(0.33, 0.03, 0), (1.1, 0.02, 1)]
    separable, _ = separability(both := poses(*way, *lines), refined(both, (0.33, 1.1)), TIMES_S, phases(0.33, 1.1))
    assert separable


def test_separability_of_breathing_slightly_faster_than_scope():
    """Slow scope motion raises only the side below the breathing frequency, so breathing is still separable."""
    way, breathing = sways(0.27), (0.33, 0.03, 0)
    separable, mistaken = separability(both := poses(*way, breathing), refined(both, (0.33,)), TIMES_S, phases(0.33))
    assert separable and mistaken < 0.005
