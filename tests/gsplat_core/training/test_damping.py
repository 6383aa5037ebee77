"""Estimate of the share of the last motion that continues."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.training.motion_prior import AT_FIRST, Damping


def share_of(damping: Damping) -> float:
    return float(damping.damped(torch.ones(1, 3))[0, 0])


def test_damping_starts_with_constant_share() -> None:
    assert share_of(Damping()) == pytest.approx(AT_FIRST)


@pytest.mark.parametrize(("ratio", "learned"), [(1.0, 1.0), (0.3, 0.3), (0.0, 0.0), (-0.4, 0.0), (50.0, 1.0)])
def test_damping_learns_share_clamped_to_0_and_1(ratio: float, learned: float) -> None:
    damping, last = Damping(), torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    for _ in range(60):
        damping.learn(last, ratio * last)
    assert share_of(damping) == pytest.approx(learned, abs=1e-3)


def test_damping_of_random_motion_approaches_zero() -> None:
    damping, random = Damping(), torch.Generator().manual_seed(1)
    for _ in range(60):
        damping.learn(torch.randn(500, 3, generator=random), torch.randn(500, 3, generator=random))
    assert share_of(damping) < 0.1


def test_damping_ignores_zero_nan_and_empty_motion() -> None:
    damping = Damping()
    damping.learn(torch.zeros(4, 3), torch.ones(4, 3))
    damping.learn(torch.full((4, 3), torch.nan), torch.ones(4, 3))
    damping.learn(torch.zeros(0, 3), torch.zeros(0, 3))
    assert share_of(damping) == pytest.approx(AT_FIRST)


@pytest.mark.parametrize(("ratio", "share"), [(1.0, 0.66), (0.0, 0.51), (50.0, 0.735), (-50.0, 0.435)])
def test_damping_update_weight_and_clamp_of_one_frame(ratio: float, share: float) -> None:
    """The estimate starts at 0.6 and moves by 0.15 (ratio - 0.6), with the ratio clamped to [-0.5, 1.5]."""
    damping, last = Damping(), torch.ones(5, 3)
    damping.learn(last, ratio * last)
    assert share_of(damping) == pytest.approx(share, abs=1e-6)
