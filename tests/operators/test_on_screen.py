"""A frame is scored by what was on the screen when the next frame arrived."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gsplat_core.scene.frames import FrameStatus
from gsplat_core.training.metrics import psnr_tissue_db
from operators.frame_log import FrameLog, read_frames
from operators.messages import PictureState, Prediction, ShownPicture
from operators.metrics import PREDICTIONS_KEPT, MetricsOp, NextFrameResult, OnScreenResult, QualityResult
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


def test_on_screen_picture_in_time_is_scored_against_own_frame(stream, compute_queued, tmp_path):
    frames, pictures = stream(5)
    operator = MetricsOp(None, on_screen=True, log=FrameLog(tmp_path / "frames.jsonl"))
    _, result, quality = score(
        operator, compute_queued, frames, [shown(p, k * PERIOD + 15 * MS) for k, p in enumerate(pictures)]
    )
    assert (result.frames, result.not_on_screen, quality.frames) == (5, 0, 5)
    expected = -20 * np.log10(2 / 255)
    assert [row["psnr_tissue_db"] for row in read_frames(operator.log.path)] == pytest.approx([expected] * 5)


def test_on_screen_late_picture_does_not_count_for_own_frame(stream, compute_queued, tmp_path):
    frames, pictures = stream(4)
    late = [shown(pictures[0], 10 * MS), shown(pictures[1], 2 * PERIOD + 1), shown(pictures[2], 2 * PERIOD + 10 * MS)]
    operator = MetricsOp(None, on_screen=True, log=FrameLog(tmp_path / "frames.jsonl"))
    _, result, _ = score(operator, compute_queued, frames, late)
    rows = list(read_frames(operator.log.path))
    assert [(row["seq"], row["shown_seq"]) for row in rows] == [(0, 0), (1, 0), (2, 2), (3, 2)]
    assert result.not_on_screen == 2
    assert rows[1]["psnr_tissue_db"] < rows[0]["psnr_tissue_db"]


def test_on_screen_does_not_score_frames_before_first_picture(stream, compute_queued):
    frames, pictures = stream(4)
    _, result, _ = score(MetricsOp(None, on_screen=True), compute_queued, frames, [shown(pictures[2], 2 * PERIOD + MS)])
    assert result.frames == 2


def test_on_screen_digest_ignores_resent_picture(stream, compute_queued):
    frames, pictures = stream(3)
    again = [shown(pictures[0], MS), shown(pictures[0], PERIOD + MS, new=False)]
    operator = MetricsOp(None, on_screen=True)
    _, _, quality = score(operator, compute_queued, frames, again)
    once = MetricsOp(None, on_screen=True)
    assert quality.frames_sha256 == score(once, compute_queued, frames, again[:1])[2].frames_sha256


def test_on_screen_does_not_score_withheld_frames(stream, compute_queued):
    frames, pictures = stream(4)
    frames[1] = frames[1].with_fields(withheld="blur")
    _, result, quality = score(
        MetricsOp(None, on_screen=True),
        compute_queued,
        frames,
        [shown(p, k * PERIOD + MS) for k, p in enumerate(pictures)],
    )
    assert (result.frames, quality.trained.count) == (4, 3)


def test_on_screen_counts_skipped_frames_as_unscored(stream, compute_queued):
    frames, pictures = stream(6)
    _, result, _ = score(
        MetricsOp(None, on_screen=True), compute_queued, [frames[0], frames[3], frames[5]], [shown(pictures[0], MS)]
    )
    assert result.unscored == 3


def test_on_screen_settled_figures_exclude_first_second(frame, rendered, compute_queued):
    frames = [frame(k, arrived_ns=k * PERIOD) for k in range(40)]
    pictures = [rendered(k, frame=frames[k], offset=60 if k < 20 else 1) for k in range(40)]
    _, result, quality = score(
        MetricsOp(None, on_screen=True),
        compute_queued,
        frames,
        [shown(p, k * PERIOD + MS) for k, p in enumerate(pictures)],
    )
    assert result.settled_db == pytest.approx(-20 * np.log10(1 / 255), abs=0.1)
    assert quality.trained.means()["psnr_tissue_db"] < result.settled_db - 5
    before = [psnr_tissue_db(a.image, b.image, None) for a, b in pairwise(frames)]
    assert quality.previous_frame_db == pytest.approx(np.mean(before))
    assert result.previous_frame_db == pytest.approx(np.mean(before[24:]))


def test_on_screen_memory_is_bounded_without_frames(stream, compute_queued):
    _, pictures = stream(1)
    operator = MetricsOp(None, on_screen=True)
    operator.start()
    for k in range(1000):
        compute_queued(operator, shown=[shown(pictures[0], k)])
    assert len(operator._screen._shown) <= 64
    operator.stop()


def decibels(grey_levels):
    return 20 * np.log10(255 / grey_levels)


def in_time(pictures):
    return [shown(picture, k * PERIOD + MS) for k, picture in enumerate(pictures)]


@pytest.mark.parametrize("worst_at", [25, 30, 39])
def test_on_screen_worst_frame_excludes_first_second(frame, rendered, compute_queued, worst_at):
    """The first second has an even lower score, and one frame has a higher score than all others."""
    offsets = {k: 60 for k in range(25)} | {worst_at: 30, 27: 1}
    frames = [frame(k, arrived_ns=k * PERIOD) for k in range(40)]
    pictures = [rendered(k, frame=frames[k], offset=offsets.get(k, 5)) for k in range(40)]
    _, result, _ = score(MetricsOp(None, on_screen=True), compute_queued, frames, in_time(pictures))
    assert result.worst_seq == worst_at
    assert result.worst_db == pytest.approx(decibels(30), abs=0.05)


def test_on_screen_settled_figures_include_frame_at_one_second(frame, rendered, compute_queued):
    frames = [frame(k, arrived_ns=k * PERIOD) for k in range(26)]
    pictures = [rendered(k, frame=frames[k], offset=9 if k < 25 else 3) for k in range(26)]
    _, result, _ = score(MetricsOp(None, on_screen=True), compute_queued, frames, in_time(pictures))
    assert result.settled_db == pytest.approx(decibels(3), abs=0.05), "frame 25 was taken at 1.00 s"


def test_on_screen_settled_figures_are_none_for_short_stream(stream, compute_queued):
    frames, pictures = stream(6)
    _, result, _ = score(MetricsOp(None, on_screen=True), compute_queued, frames, in_time(pictures))
    assert (result.settled_db, result.worst_db, result.worst_seq, result.previous_frame_db) == (None,) * 4


def test_on_screen_unscored_frames_are_not_in_means_or_worst(frame, rendered, compute_queued):
    frames = [frame(k, arrived_ns=k * PERIOD) for k in range(40)]
    frames[30] = frames[30].with_fields(status=FrameStatus.DAMAGED)
    frames[31] = frames[31].with_fields(withheld="black")
    frames[32] = frames[32].with_fields(mask=np.zeros((16, 24), np.uint8))
    bad = {30: 90, 31: 80, 32: 70, 35: 20}
    pictures = [rendered(k, frame=frames[k], offset=bad.get(k, 2)) for k in range(40)]
    _, result, quality = score(MetricsOp(None, on_screen=True), compute_queued, frames, in_time(pictures))
    assert (result.worst_seq, result.frames) == (35, 40)
    assert quality.trained.count == 38, "the frame without tissue was observed and has no figure"
    assert result.not_on_screen == 0


def test_on_screen_counts_picture_shown_exactly_at_next_frame(stream, compute_queued):
    frames, pictures = stream(3)
    exactly = [shown(pictures[0], MS), shown(pictures[1], 2 * PERIOD), shown(pictures[2], 3 * PERIOD)]
    assert score(MetricsOp(None, on_screen=True), compute_queued, frames, exactly)[1].not_on_screen == 0
    later = [exactly[0], shown(pictures[1], 2 * PERIOD + 1), exactly[2]]
    assert score(MetricsOp(None, on_screen=True), compute_queued, frames, later)[1].not_on_screen == 1


def test_on_screen_does_not_score_picture_of_other_size(stream, frame, rendered, compute_queued):
    frames, pictures = stream(2)
    small = frame(2, image=np.zeros((8, 12, 3), np.uint8), arrived_ns=2 * PERIOD)
    _, result, _ = score(MetricsOp(None, on_screen=True), compute_queued, [*frames, small], in_time(pictures))
    assert result.frames == 2


def test_on_screen_ssim_is_measured_every_eighth_frame(stream, compute_queued, tmp_path):
    frames, pictures = stream(20)
    operator = MetricsOp(None, on_screen=True, log=FrameLog(tmp_path / "frames.jsonl"))
    score(operator, compute_queued, frames, in_time(pictures))
    assert [row["seq"] for row in read_frames(operator.log.path) if row["ssim"] is not None] == [0, 8, 16]


def test_on_screen_log_contains_shown_picture_and_times(stream, rendered, compute_queued, tmp_path):
    frames, _ = stream(2)
    picture = rendered(
        0, frame=frames[0], content=frames[0], steps=7, taken_ns=3 * MS, published_ns=9 * MS, model_version=5
    )
    operator = MetricsOp(None, on_screen=True, log=FrameLog(tmp_path / "frames.jsonl"))
    score(
        operator,
        compute_queued,
        frames,
        [ShownPicture(picture, picture.image, PictureState.STALE, 15 * MS, 15 * MS, True)],
    )
    first, second = read_frames(operator.log.path)
    published = {
        "seq": 0,
        "shown_seq": 0,
        "shown_ns": 15 * MS,
        "age_ms": 15.0,
        "state": "stale",
        "taken_ms": 3.0,
        "published_ms": 9.0,
    }
    assert first.items() >= (published | {"steps": 7, "model_version": 5, "withheld": None}).items()
    assert (second["seq"], second["shown_seq"]) == (1, 0)


def predicted(frames, offsets):
    return [Prediction(frames[k], frames[k].image + np.uint8(offset)) for k, offset in offsets.items()]


@pytest.mark.parametrize("late", [False, True])
def test_on_screen_scores_early_and_late_predictions_over_same_frames(frame, rendered, compute_queued, tmp_path, late):
    levels = [100 + (k % 2) * 6 for k in range(40)]
    levels[33] = 130
    frames = [
        frame(k, image=np.full((16, 24, 3), level, np.uint8), arrived_ns=k * PERIOD) for k, level in enumerate(levels)
    ]
    pictures = [rendered(k, frame=frames[k]) for k in range(40)]
    operator = MetricsOp(None, on_screen=True, log=FrameLog(tmp_path / "frames.jsonl"))
    predictions = [*predicted(frames, {10: 90, 26: 3, 33: 5}), Prediction(frames[35], None)]
    operator.start()
    compute_queued(operator, frame=frames, shown=in_time(pictures), predicted=[] if late else predictions)
    compute_queued(operator, predicted=predictions if late else [])
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    found = outcome.find(NextFrameResult)
    assert found.frames == 2, "frame 10 is of the first second, and frame 35 was not predicted"
    assert found.psnr_tissue_db == pytest.approx((decibels(3) + decibels(5)) / 2)
    assert found.previous_frame_db == pytest.approx((decibels(6) + decibels(30)) / 2)
    logged = {row["seq"]: row["next_frame_db"] for row in read_frames(operator.log.path)}
    known = {seq: value for seq, value in logged.items() if value is not None}
    assert known == ({} if late else pytest.approx({10: decibels(90), 26: decibels(3), 33: decibels(5)}))


def test_on_screen_limits_predictions_of_missing_frames(stream, compute_queued):
    frames, _ = stream(1)
    operator = MetricsOp(None, on_screen=True)
    operator.start()
    for k in range(10 * PREDICTIONS_KEPT):
        compute_queued(operator, predicted=[Prediction(frames[0].with_fields(seq=k), frames[0].image)])
    assert len(operator._predicted) <= PREDICTIONS_KEPT
    operator.stop()


def test_on_screen_limits_frames_waiting_for_prediction(frame, rendered, compute_queued):
    frames = [frame(k, arrived_ns=k * PERIOD) for k in range(30 + 2 * PREDICTIONS_KEPT)]
    pictures = [rendered(k, frame=frames[k]) for k in range(len(frames))]
    operator = MetricsOp(None, on_screen=True)
    score(operator, compute_queued, frames, in_time(pictures))
    assert 0 < len(operator._waiting_db) <= PREDICTIONS_KEPT


def test_on_screen_without_report_skips_ssim_and_digest(stream, compute_queued, monkeypatch):
    frames, pictures = stream(10)
    operator = MetricsOp(None, on_screen=True, report=False)
    scored, result, quality = score(operator, compute_queued, frames, in_time(pictures))
    assert quality is None and result.frames == 10
    assert all(np.isnan(each.quality.ssim) and each.quality.psnr_tissue_db > 40 for each in scored)
    assert operator._digest.hexdigest() == MetricsOp(None, on_screen=True)._digest.hexdigest(), "no picture was hashed"


def test_on_screen_digest_depends_on_every_new_picture_byte(stream, rendered, compute_queued):
    frames, pictures = stream(3)
    digest = lambda shown_ones: (
        score(MetricsOp(None, on_screen=True), compute_queued, frames, shown_ones)[2].frames_sha256
    )
    changed = rendered(1, frame=frames[1], image=pictures[1].image.copy())
    changed.image[-1, -1, -1] ^= 1
    all_of_them = in_time(pictures)
    other = [all_of_them[0], shown(changed, PERIOD + MS), all_of_them[2]]
    assert len({digest(all_of_them), digest(other), digest(all_of_them[:2])}) == 3
    assert digest(all_of_them) == digest(in_time(pictures))


def test_on_screen_first_second_starts_at_first_frame(frame, rendered, compute_queued):
    start_ns = 3_600_000_000_000
    frames = [frame(k, pts_ns=start_ns + k * PERIOD, arrived_ns=k * PERIOD) for k in range(30)]
    pictures = [rendered(k, frame=frames[k], offset=9 if k < 25 else 3) for k in range(30)]
    _, result, _ = score(MetricsOp(None, on_screen=True), compute_queued, frames, in_time(pictures))
    assert result.settled_db == pytest.approx(decibels(3), abs=0.05)
