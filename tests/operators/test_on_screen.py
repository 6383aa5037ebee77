"""A frame is scored by what was on the screen when the next frame arrived."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gsplat_core.training.metrics import psnr_tissue_db
from operators.frame_log import FrameLog, read_frames
from operators.messages import PictureState, ShownPicture
from operators.metrics import QualityResult
from operators.on_screen import OnScreenMetricsOp, OnScreenResult
from operators.outcome import OutcomeBuilder

MS = 1_000_000
PERIOD = 40 * MS


def shown(picture, at_ns, new=True):
    return ShownPicture(picture, picture.image, PictureState.LIVE, 5 * MS, at_ns, new)


@pytest.fixture
def stream(frame, rendered):
    """Frames 40 ms apart and their pictures, `offset` grey levels too bright."""

    def make(count, offset=2):
        frames = [frame(k, arrived_ns=k * PERIOD) for k in range(count)]
        return frames, [rendered(k, frame=frames[k], offset=offset, content=frames[k]) for k in range(count)]

    return make


def score(operator, compute_queued, frames, pictures):
    operator.start()
    scored = compute_queued(operator, frame=frames, shown=pictures)
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return scored, outcome.find(OnScreenResult), outcome.find(QualityResult)


def test_a_picture_in_time_is_scored_against_its_own_frame(stream, compute_queued, tmp_path):
    frames, pictures = stream(5)
    operator = OnScreenMetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    _, result, quality = score(
        operator, compute_queued, frames, [shown(p, k * PERIOD + 15 * MS) for k, p in enumerate(pictures)]
    )
    assert (result.frames, result.not_on_screen, quality.frames) == (5, 0, 5)
    expected = -20 * np.log10(2 / 255)
    assert [row["psnr_tissue_db"] for row in read_frames(operator.log.path)] == pytest.approx([expected] * 5)


def test_a_picture_that_comes_after_the_next_frame_does_not_count_for_its_own(stream, compute_queued, tmp_path):
    frames, pictures = stream(4)
    late = [shown(pictures[0], 10 * MS), shown(pictures[1], 2 * PERIOD + 1), shown(pictures[2], 2 * PERIOD + 10 * MS)]
    operator = OnScreenMetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    _, result, _ = score(operator, compute_queued, frames, late)
    rows = list(read_frames(operator.log.path))
    assert [(row["seq"], row["shown_seq"]) for row in rows] == [(0, 0), (1, 0), (2, 2), (3, 2)]
    assert result.not_on_screen == 2
    assert rows[1]["psnr_tissue_db"] < rows[0]["psnr_tissue_db"]


def test_frames_before_the_first_picture_are_not_scored(stream, compute_queued):
    frames, pictures = stream(4)
    _, result, _ = score(OnScreenMetricsOp(None), compute_queued, frames, [shown(pictures[2], 2 * PERIOD + MS)])
    assert result.frames == 2


def test_a_picture_that_is_only_sent_again_is_no_new_one(stream, compute_queued):
    frames, pictures = stream(3)
    again = [shown(pictures[0], MS), shown(pictures[0], PERIOD + MS, new=False)]
    operator = OnScreenMetricsOp(None)
    _, _, quality = score(operator, compute_queued, frames, again)
    once = OnScreenMetricsOp(None)
    assert quality.frames_sha256 == score(once, compute_queued, frames, again[:1])[2].frames_sha256


def test_withheld_frames_are_shown_and_not_scored(stream, compute_queued):
    frames, pictures = stream(4)
    frames[1] = frames[1].with_fields(withheld="blur")
    _, result, quality = score(
        OnScreenMetricsOp(None), compute_queued, frames, [shown(p, k * PERIOD + MS) for k, p in enumerate(pictures)]
    )
    assert (result.frames, quality.trained.count) == (4, 3)


def test_frames_that_were_passed_over_before_scoring_are_counted(stream, compute_queued):
    frames, pictures = stream(6)
    _, result, _ = score(
        OnScreenMetricsOp(None), compute_queued, [frames[0], frames[3], frames[5]], [shown(pictures[0], MS)]
    )
    assert result.unscored == 3


def test_the_first_second_is_left_out_of_the_settled_figures(frame, rendered, compute_queued):
    frames = [frame(k, arrived_ns=k * PERIOD) for k in range(40)]
    pictures = [rendered(k, frame=frames[k], offset=60 if k < 20 else 1) for k in range(40)]
    _, result, quality = score(
        OnScreenMetricsOp(None), compute_queued, frames, [shown(p, k * PERIOD + MS) for k, p in enumerate(pictures)]
    )
    assert result.settled_db == pytest.approx(-20 * np.log10(1 / 255), abs=0.1)
    assert quality.trained.means()["psnr_tissue_db"] < result.settled_db - 5
    before = [psnr_tissue_db(a.image, b.image, None) for a, b in pairwise(frames)]
    assert result.previous_frame_throughout_db == pytest.approx(np.mean(before))
    assert result.previous_frame_db == pytest.approx(np.mean(before[24:]))


def test_memory_does_not_grow_when_pictures_come_without_frames(stream, compute_queued):
    _, pictures = stream(1)
    operator = OnScreenMetricsOp(None)
    operator.start()
    for k in range(1000):
        compute_queued(operator, shown=[shown(pictures[0], k)])
    assert len(operator._shown) <= 64
    operator.stop()
