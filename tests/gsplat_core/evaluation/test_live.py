"""Sums of the scores of displayed pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsplat_core.evaluation.scores import MOST_BEHIND, NOTHING_SHOWN, LiveSums
from gsplat_core.training.metrics import frame_quality

NOTHING_BEFORE = (math.nan, math.nan)


def quality(seq, level, shown):
    """Quality of an even picture of level `shown` against a frame of level `level`."""
    image, picture = (np.full((16, 20, 3), each, np.uint8) for each in (level, shown))
    return frame_quality(seq, picture, image, None)


def test_live_sums_of_scores_lateness_and_ages(decibels):
    log = []
    sums = LiveSums(log.append)
    for age_ms in (10, 11, 12, 13):
        sums.picture(age_ms, "live")
    for seq, (error, behind) in enumerate([(1, 0), (2, 1), (5, 1), (5, 30)]):
        sums.frame(quality(seq, 100, 100 + error), seq * 0.04, behind, 40.0 * (behind + 1), NOTHING_BEFORE)
    found = sums.live
    assert found.score.psnr_tissue_db == pytest.approx(np.mean([decibels(d) for d in (1, 2, 5, 5)]), abs=1e-6)
    assert (found.score.frames, found.in_time, found.behind) == (4, 1, {0: 1, 1: 2, MOST_BEHIND: 1})
    assert found.age_when_shown.count == 4 and found.age_when_shown.max_ms == 13
    assert found.age_when_shown.p50_ms == pytest.approx(11, rel=0.011)
    assert found.age_on_screen.max_ms == 31 * 40
    assert [(entry["seq"], entry["behind"], entry["age_ms"]) for entry in log[:2]] == [(0, 0, 40), (1, 1, 80)]


def test_live_sums_count_omitted_frames_by_reason():
    sums = LiveSums()
    sums.leave_out(NOTHING_SHOWN)
    found = sums.live
    assert found.score.left_out == {NOTHING_SHOWN: 1} and found.score.frames == 0
    assert found.score.psnr_tissue_db is found.age_when_shown is found.age_on_screen is None


def test_live_sums_settled_figures_exclude_first_second(decibels):
    sums = LiveSums()
    for seq in range(60):
        before = (decibels(10), decibels(10)) if seq < 25 else NOTHING_BEFORE
        sums.frame(quality(seq, 100, 120 if seq < 25 else 101), 0.04 * seq, 0, 40.0, before)
    found = sums.live
    assert (found.score.frames, found.settled.frames) == (60, 35)
    assert found.settled.psnr_tissue_db == found.settled.worst_db == pytest.approx(decibels(1), abs=1e-6)
    assert found.score.worst_db == pytest.approx(decibels(20), abs=1e-6)
    assert found.previous.psnr_tissue_db == pytest.approx(decibels(10), abs=1e-6)
    assert (found.previous.frames, found.settled_previous.psnr_tissue_db) == (25, None)


def test_live_sums_limit_number_of_states():
    sums = LiveSums()
    for k in range(100):
        sums.picture(1 + k / 10, f"state {k}")
    states = sums.live.states
    assert len(states) == 17 and sum(states.values()) == 100
