"""Bundle adjustment before tissue that moves: exact data, and against the one for tissue at rest."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from gsplat_core.poses.breathing import waves
from gsplat_core.poses.bundle import Bundle, errors_px
from gsplat_core.poses.bundle import adjust as adjust_still
from gsplat_core.poses.moving_bundle import Rhythm, _cost, _step, adjust, learned_from, with_rhythm, with_waves
from gsplat_core.poses.se3 import exp
from tests.gsplat_core.geometry.breathing_points import BREATHING_HZ, HEART_HZ
from tests.gsplat_core.geometry.breathing_sightings import bundle_of, seen_for


def breathing(length_s=9.0, rate_hz=4.0, noise_px=0.0):
    sightings, _ = seen_for(length_s, rate_hz=rate_hz, noise_px=noise_px)
    return bundle_of(sightings, waves(sightings.times_s, (BREATHING_HZ, HEART_HZ))), sightings.times_s


def test_moving_bundle_adjust_explains_exact_sightings():
    bundle, _ = breathing()
    before = float(bundle.off().norm(dim=1).median())
    found, _ = adjust(bundle, 0.004, 12)
    assert float(found.off().norm(dim=1).median()) < min(0.1 / 280, 0.1 * before)


def test_moving_bundle_without_waves_equals_static_bundle():
    """Scales of the losses far above the errors, because the losses differ."""
    sightings, _ = seen_for(5.0, breathes=0.0, rate_hz=4.0)
    start = bundle_of(sightings, waves(sightings.times_s, ()))
    start = replace(
        start, poses=exp(1e-3 * torch.sin(torch.arange(6 * len(start.poses)).view(-1, 6).double())) @ start.poses
    )
    found, _ = adjust(start, 0.1, 15)
    still = Bundle(start.poses, start.rest, start.camera, start.point, start.rays, 1 / 0.1)
    fixed = torch.arange(len(start.poses)) == 0
    expected = errors_px(adjust_still(still, fixed=fixed, rounds=30)) * 0.1
    assert float((found.off().norm(dim=1) - expected).abs().median()) < 2e-6


@pytest.mark.parametrize("with_prior", [False, True])
def test_moving_bundle_step_decreases_cost(with_prior):
    """Far from the optimum, along the step the cost falls as fast as its slope says: numerically, for cameras, places and swings together."""
    bundle, times_s = breathing(5.0, noise_px=0.5)
    way = learned_from(bundle.poses, times_s, bundle.waves) if with_prior else None
    far = replace(bundle, rest=bundle.rest * (1 + 0.02 * torch.sin(torch.arange(len(bundle.rest)))[:, None]))
    step = _step(far, 1.0, 1e-9, way)
    begin, end = _cost(far, 1.0, way), _cost(step, 1.0, way)
    assert end < begin
    # The quadratic model of nearly quadratic costs: a second step gains almost nothing over the first.
    again = _cost(_step(step, 1.0, 1e-9, way), 1.0, way)
    assert end - again < 0.05 * (begin - end)


def test_moving_bundle_adjust_never_increases_cost():
    bundle, times_s = breathing(5.0, noise_px=1.0)
    way = learned_from(bundle.poses, times_s, bundle.waves)
    costs = [adjust(bundle, 0.004, rounds, way)[1] for rounds in range(5)]
    assert all(after <= before for before, after in pairwise(costs)) and costs[-1] < costs[0]


@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("nodes", [1, 2])
def test_moving_bundle_adjust_with_few_nodes_decreases_cost(nodes, with_prior):
    """Points that lie close together have a single node."""
    sightings, _ = seen_for(5.0, rate_hz=4.0)
    few = bundle_of(sightings, waves(sightings.times_s, (BREATHING_HZ,)), nodes)
    way = learned_from(few.poses, sightings.times_s, few.waves) if with_prior else None
    assert len(few.field.nodes) == nodes
    assert adjust(few, 0.004, 4, way)[1] < 0.9 * adjust(few, 0.004, 0, way)[1]


def test_moving_bundle_keeps_first_camera():
    bundle, _ = breathing(5.0)
    found, _ = adjust(bundle, 0.004, 3)
    turn = found.poses[0, :3, :3]
    torch.testing.assert_close(turn, bundle.poses[0, :3, :3])


def test_with_waves_adds_zero_amplitudes():
    bundle, times_s = breathing(5.0)
    none = replace(bundle, amplitudes=bundle.amplitudes[:, :, :0])
    one, _ = adjust(with_waves(none, waves(times_s, (BREATHING_HZ,))), 0.004, 1)
    both = with_waves(one, waves(times_s, (BREATHING_HZ, HEART_HZ)))
    torch.testing.assert_close(both.off(), one.off())
    assert not both.amplitudes[:, :, 2:].any()


def test_moving_bundle_cost_equals_negative_log_likelihood_and_priors():
    """Relief has a standard deviation of 0.3 of the median depth, motion that of its field, a ray 0.002 with the loss of Geman and McClure."""
    bundle, _ = breathing(5.0)
    generator = torch.Generator().manual_seed(0)
    swings = 0.01 * torch.randn(bundle.amplitudes.shape, generator=generator, dtype=torch.float64)
    moving = replace(bundle, amplitudes=swings)
    moving = replace(moving, rays=moving.rays + moving.off())  # explained exactly
    assert float(moving.off().abs().max()) < 1e-12
    depth = moving.rest[:, 2]
    relief = ((depth - depth.median()) ** 2).sum() / (2 * 0.3**2)
    vectors = swings.reshape(len(swings), -1)
    motion = sum(each @ moving.field.stiffness @ each for each in vectors.unbind(1)) / 2
    assert adjust(moving, 0.004, 0)[1] == pytest.approx(float(relief + motion), rel=1e-9)
    rays = moving.rays.clone()
    rays[7] += torch.tensor([0.003, -0.004], dtype=torch.float64)
    square = (0.005 / 0.004) ** 2
    off = 0.5 * (0.004 / 0.002) ** 2 * square / (1 + square)
    assert adjust(replace(moving, rays=rays), 0.004, 0)[1] == pytest.approx(float(relief + motion) + off, rel=1e-9)


def warped(times_s: torch.Tensor, most: float = 0.4) -> Rhythm:
    """Phases of breathing and heart whose breathing is early or late by at most some radians."""
    rhythm = Rhythm.steady(times_s, (BREATHING_HZ, HEART_HZ))
    late = most * torch.sin(2 * torch.pi * 0.15 * times_s)
    return replace(rhythm, phases=rhythm.phases + torch.stack([late, 0 * late], 1))


def test_moving_bundle_estimates_phases():
    """From phases of a constant rate that are off by up to 0.4 rad."""
    bundle, times_s = breathing(noise_px=0.2)
    way = learned_from(bundle.poses, times_s, bundle.waves)
    off = lambda rhythm: float((rhythm.phases[:, 0] - 2 * torch.pi * BREATHING_HZ * times_s).diff().abs().mean())
    started = with_rhythm(adjust(bundle, 0.004, 8, way)[0], warped(times_s))
    found, _ = adjust(started, 0.004, 20, way)
    assert found.rhythm is not None and off(found.rhythm) < 0.4 * off(warped(times_s))
    torch.testing.assert_close(found.waves, found.rhythm.waves)


def test_moving_bundle_step_with_phases_decreases_cost():
    bundle, times_s = breathing(5.0, noise_px=0.5)
    way = learned_from(bundle.poses, times_s, bundle.waves)
    start = with_rhythm(adjust(bundle, 1.0, 8, way)[0], warped(times_s, 0.05))
    begin, end = _cost(start, 1.0, way), _cost(_step(start, 1.0, 1e-9, way), 1.0, way)
    again = _cost(_step(_step(start, 1.0, 1e-9, way), 1.0, 1e-9, way), 1.0, way)
    assert end < begin and end - again < 0.1 * (begin - end)


def test_rhythm_cost_is_that_of_random_walk():
    """Breathing deviates from its rate by half, for a sixth of a breath; the phase by 1 rad, in the mean by 0.05 rad."""
    times_s = torch.tensor([0.0, 0.3, 0.5, 1.1], dtype=torch.float64)
    steady = Rhythm.steady(times_s, (0.4,))
    assert steady.cost() == 0
    change = torch.tensor([0.2, -0.1, 0.3, 0.05], dtype=torch.float64)
    variance = (2 * torch.pi * 0.4 * 0.5) ** 2 * times_s.diff() / 6 / 0.4
    expected = 0.5 * ((change.diff() ** 2 / variance).sum() + (change**2).mean() + (change.mean() / 0.05) ** 2)
    assert steady.moved(change[:, None]).cost() == pytest.approx(float(expected), rel=1e-9)


def test_moving_bundle_is_robust_to_pulled_tissue():
    """A third of the points moves by seven times the scale in the same direction, in the middle third of the time."""
    sightings, _ = seen_for(5.0, breathes=0.0, rate_hz=4.0, noise_px=0.0)
    start = bundle_of(sightings, waves(sightings.times_s, ()))
    middle = (start.camera // (len(start.poses) // 3 + 1) == 1) & (start.point % 3 == 0)
    pulled = replace(start, rays=start.rays + 0.02 * middle[:, None])
    found, _ = adjust(pulled, 0.004, 15)
    assert float(found.off()[~middle].norm(dim=1).max()) < 0.0002
