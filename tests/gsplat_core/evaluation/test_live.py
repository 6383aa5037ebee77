"""The live protocol on made-up timings: what is on the screen when the next frame comes."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.live import MOST_BEHIND, NOT_KEPT, NOTHING_SHOWN, OTHER_SIZE, Shown, evaluate_live

MS = 1_000_000
PERIOD = 40


def arriving(frame, levels, **fields):
    """Frames of these grey levels, one every 40 ms from 1000 ms on."""
    return [frame(k, level, arrived_ns=(1000 + PERIOD * k) * MS, **fields) for k, level in enumerate(levels)]


def shown(seq, after_ms, level=None, **fields):
    """A picture of frame `seq`, put on the screen so many milliseconds after that frame came."""
    arrived_ns = (1000 + PERIOD * seq) * MS
    image = None if level is None else np.full((16, 20, 3), level, np.uint8)
    return Shown(seq, arrived_ns, arrived_ns + round(after_ms * MS), image, **fields)


def test_pictures_in_time_are_scored_against_their_own_frames(frame, decibels):
    log = []
    found = evaluate_live(
        arriving(frame, [100, 110, 120, 130]),
        [shown(k, 10 + k, level) for k, level in enumerate([101, 112, 125, 99])],
        record=log.append,
    )
    assert found.score.psnr_tissue_db == pytest.approx(np.mean([decibels(d) for d in (1, 2, 5)]), abs=1e-6)
    assert (found.score.frames, found.in_time, found.behind) == (3, 3, {0: 3}), "nobody knows until when the last stood"
    assert found.age_when_shown is not None and found.age_on_screen is not None
    assert found.age_when_shown.count == 4 and found.age_when_shown.max_ms == 13
    assert found.age_when_shown.p50_ms == pytest.approx(11, rel=0.011)
    assert found.age_on_screen.max_ms == PERIOD
    assert [(entry["seq"], entry["behind"], entry["age_ms"]) for entry in log] == [(0, 0, 40), (1, 0, 40), (2, 0, 40)]


def test_a_picture_that_comes_too_late_leaves_the_older_one_on_the_screen(frame, decibels):
    # The picture of frame 1 comes 5 ms after frame 2 has come, and is there when frame 3 comes: frame 2 was never shown.
    found = evaluate_live(
        arriving(frame, [100, 110, 120, 130]), [shown(0, 10, 100), shown(1, 45, 110), shown(3, 10, 130)]
    )
    assert found.behind == {0: 1, 1: 2} and found.in_time == 1
    assert found.score.psnr_tissue_db == pytest.approx((100 + 2 * decibels(10)) / 3, abs=1e-6)
    assert found.age_on_screen is not None and found.age_on_screen.max_ms == 80


def test_a_picture_shown_at_the_very_moment_is_not_before_it(frame, decibels):
    found = evaluate_live(arriving(frame, [100, 110, 120]), [shown(0, 10, 100), shown(1, 40, 110)])
    assert found.behind == {0: 1, 1: 1}
    assert found.score.psnr_tissue_db == pytest.approx((100 + decibels(10)) / 2, abs=1e-6)


def test_the_last_of_several_pictures_of_one_frame_counts(frame, decibels):
    found = evaluate_live(arriving(frame, [100, 110]), [shown(0, 10, 150), shown(0, 30, 102), shown(0, 41, 100)])
    assert found.score.psnr_tissue_db == pytest.approx(decibels(2), abs=1e-6)


def test_before_the_first_picture_nothing_is_scored(frame):
    found = evaluate_live(arriving(frame, [100, 110, 120]), [shown(0, 60, 100)])
    assert found.score.left_out == {NOTHING_SHOWN: 1} and found.score.frames == 1
    assert found.behind == {1: 1}
    nothing = evaluate_live(arriving(frame, [100, 110, 120]), [])
    assert nothing.score.psnr_tissue_db is nothing.age_when_shown is nothing.age_on_screen is None
    assert nothing.score.left_out == {NOTHING_SHOWN: 2}


def test_a_freeze_is_scored_with_the_frozen_picture_however_old_it_grows(frame):
    frames = arriving(frame, [100 + k for k in range(30)])
    found = evaluate_live(frames, [shown(0, 5, 100), shown(0, 700, 100, state="frozen")])
    assert found.behind[MOST_BEHIND] == 29 - MOST_BEHIND and found.in_time == 1
    assert found.score.frames == 29 and found.score.worst_seq == 28
    assert found.states == {"frozen": 1, "live": 1}


def test_a_picture_that_was_not_kept_is_left_out(frame):
    found = evaluate_live(arriving(frame, [100, 110]), [shown(0, 10)])
    assert found.score.left_out == {NOT_KEPT: 1} and found.behind == {}
    other_size = Shown(0, 1000 * MS, 1001 * MS, np.zeros((8, 8, 3), np.uint8))
    assert evaluate_live(arriving(frame, [100, 110]), [other_size]).score.left_out == {OTHER_SIZE: 1}


def test_the_first_second_is_left_out_of_the_settled_figures(frame, decibels):
    levels = [100] * 60
    found = evaluate_live(arriving(frame, levels), [shown(k, 5, 120 if k < 25 else 101) for k in range(60)])
    assert (found.score.frames, found.settled.frames) == (59, 34)
    assert found.settled.psnr_tissue_db == found.settled.worst_db == pytest.approx(decibels(1), abs=1e-6)
    assert found.score.worst_db == pytest.approx(decibels(20), abs=1e-6)


def test_the_previous_frame_is_scored_on_the_same_frames(frame, decibels):
    found = evaluate_live(arriving(frame, [100, 110, 130, 130]), [shown(0, 41, 100), shown(2, 5, 130)])
    assert found.score.left_out == {NOTHING_SHOWN: 1}
    assert found.previous.psnr_tissue_db == pytest.approx((decibels(10) + decibels(20)) / 2, abs=1e-6)
    assert (found.previous.frames, found.settled_previous.psnr_tissue_db) == (2, None)


def test_withheld_frames_are_not_scored(frame):
    frames = [*arriving(frame, [100])[:1], *arriving(frame, [0, 110, 120, 130], withheld="blur")[1:]]
    found = evaluate_live(frames, [shown(0, 10, 100)])
    assert found.score.left_out == {"withheld": 2} and found.score.frames == 1


def test_times_that_run_backwards_are_refused(frame):
    with pytest.raises(InvalidInput, match="no time of arrival"):
        evaluate_live([frame(0), frame(1)], [])
    with pytest.raises(InvalidInput, match="arrived before frame 1"):
        evaluate_live([frame(1, arrived_ns=5), frame(2, arrived_ns=4)], [])
    with pytest.raises(InvalidInput, match="was shown before"):
        evaluate_live(arriving(frame, [1, 2, 3, 4]), [shown(1, 10, 1), shown(0, 10, 1)])


def test_memory_does_not_grow_with_states_that_a_log_makes_up(frame):
    pictures = [shown(0, 1 + k / 10, 100, state=f"state {k}") for k in range(100)]
    found = evaluate_live(arriving(frame, [100, 100]), pictures)
    assert len(found.states) == 17 and sum(found.states.values()) == 100
