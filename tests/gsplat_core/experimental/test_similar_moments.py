"""Prediction of the next motion from what followed similar earlier moments."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.experimental.learned_prior import FOLLOWED, REMEMBERED, SOONEST, SimilarMoments, weighted_mean


def motion(phase: float, shape: tuple[int, int] = (12, 16)) -> NDArray[np.float32]:
    """A wave that runs over the picture."""
    columns = np.arange(shape[1], dtype=np.float32) / shape[1]
    wave = np.sin(2 * np.pi * (phase - columns)) + 0.4 * np.sin(4 * np.pi * phase)
    return np.broadcast_to(np.stack([wave, -wave], axis=1), (*shape, 2)).astype(np.float32)


def test_similar_moments_empty_before_first_comparison() -> None:
    moments = SimilarMoments()
    assert moments.next_motions() == []
    for frame in range(SOONEST + 1):
        moments.take(motion(frame / 9))
        assert moments.next_motions() == []
    moments.take(motion(0.0))
    assert len(moments.next_motions()) == 1


@pytest.mark.parametrize("period", [11, 17.5])
@pytest.mark.parametrize("frames", [60, REMEMBERED + 90])
def test_similar_moments_forecast_periodic_motion(period: float, frames: int) -> None:
    """The forecast is far better than the last motion, before and after the ring buffer is overwritten."""
    moments = SimilarMoments()
    for frame in range(frames):
        moments.take(motion(frame / period))
    followed = moments.next_motions()
    assert len(followed) == FOLLOWED and sum(weight for weight, _ in followed) == pytest.approx(1)
    came, forecast = motion(frames / period), weighted_mean(followed)
    of_last = np.square(motion((frames - 1) / period) - came).mean()
    assert np.square(forecast - came).mean() < 0.15 * of_last


def test_similar_moments_difference_includes_earlier_motions() -> None:
    """Two moments with the same last motion are distinguished by the motions before it."""
    up, down, same = (np.full((8, 8, 2), value, np.float32) for value in (1.0, -1.0, 0.25))
    rest = [np.zeros((8, 8, 2), np.float32)] * 8
    moments = SimilarMoments()
    for each in [*rest, up, same, up, *rest, down, same, down, *rest, down, same]:
        moments.take(each)
    assert weighted_mean(moments.next_motions()).mean() < -0.4


def test_similar_moments_of_still_scene_predict_no_motion() -> None:
    moments = SimilarMoments()
    for _ in range(20):
        moments.take(np.zeros((12, 16, 2), np.float32))
    assert not weighted_mean(moments.next_motions()).any()


def test_similar_moments_restart_after_size_change() -> None:
    moments = SimilarMoments()
    for frame in range(20):
        moments.take(motion(frame / 9))
    moments.take(motion(0.0, (5, 7)))
    assert moments.next_motions() == []
