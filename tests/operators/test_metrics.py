"""Scores of displayed frames, their baseline, and the digest of what was displayed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsplat_core.scene.frames import FrameStatus
from operators.frame_log import FrameLog
from operators.messages import Prediction
from operators.metrics import MetricsOp, NextFrameResult, QualityResult
from operators.outcome import OutcomeBuilder


def score(operator, compute, frames):
    operator.start()
    scored = [compute(operator, rendered=shown)[0] for shown in frames]
    operator.stop()
    return scored


def result(operator):
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome.find(QualityResult), outcome.outputs


def test_metrics_score_trained_and_heldout_frames_separately(rendered, compute, tmp_path):
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    score(operator, compute, [rendered(0, offset=2), rendered(1, offset=20, trained=False), rendered(2, offset=2)])
    exact = 20 * math.log10(255 / 2)
    assert operator.trained.means()["psnr_tissue_db"] == pytest.approx(exact, abs=1e-3)
    assert operator.held_out.means()["psnr_tissue_db"] == pytest.approx(20 * math.log10(255 / 20), abs=1e-3)
    quality, outputs = result(operator)
    assert (quality.trained.count, quality.held_out.count, quality.frames, operator.frames) == (2, 1, 3, 3)
    assert [entry["trained"] for entry in quality.series] == [True, False, True]
    assert quality.frames_per_entry == 1 and outputs == {"frames": tmp_path / "frames.jsonl"}


def test_metrics_score_only_tissue_pixels(rendered, frame, compute):
    mask = np.ones((16, 24), np.uint8)
    mask[:, 12:] = 0
    shown = rendered(frame=frame(0, mask=mask))
    image = shown.image.copy()
    image[:, 12:] = 0
    operator = MetricsOp(None)
    (scored,) = score(operator, compute, [rendered(frame=shown.frame, image=image)])
    assert scored.quality.psnr_tissue_db == pytest.approx(20 * math.log10(255 / 2), abs=1e-3)


def test_heldout_baseline_is_mean_of_neighbour_frames(rendered, frame, compute):
    """A withheld frame that cannot be shown is no neighbour, a blurred one is; the last held-out frame has no next one."""
    mask = np.ones((16, 24), np.uint8)
    mask[:, 12:] = 0
    given = [
        frame(0), frame(1, mask=mask), frame(2, withheld="black"), frame(3, withheld="blur"), frame(4), frame(5), frame(6)
    ]  # fmt: skip
    operator = MetricsOp(None)
    offsets = {1: 4, 5: 8, 6: 16}
    scored = score(
        operator,
        compute,
        [rendered(frame=each, trained=each.seq not in offsets, offset=offsets.get(each.seq, 2)) for each in given],
    )

    def expected(before, held_out, after, columns):
        mean = (given[before].image.astype(float) + given[after].image) / 2
        return -10 * math.log10((((mean - given[held_out].image) / 255)[:, :columns] ** 2).mean())

    quality = result(operator)[0]
    found = quality.heldout_between
    assert found.neighbour_mean_db == pytest.approx((expected(0, 1, 3, 12) + expected(4, 5, 6, 24)) / 2, abs=1e-3)
    assert found.psnr_tissue_db == pytest.approx(np.mean([scored[k].quality.psnr_tissue_db for k in (1, 5)]))
    assert (found.frames, quality.held_out.count) == (2, 3)
    operator.start()
    assert result(operator)[0].heldout_between is None


def test_metrics_baseline_is_previous_raw_frame(rendered, compute, tmp_path):
    first, second = rendered(0), rendered(1)
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    scored = score(operator, compute, [first, second])
    error = (first.frame.image.astype(float) - second.frame.image) / 255
    assert math.isnan(scored[0].previous_frame_db)
    assert scored[1].previous_frame_db == pytest.approx(-10 * math.log10((error**2).mean()), abs=1e-3)
    assert result(operator)[0].series[0]["previous_frame_db"] is None, "NaN is not JSON"


def test_metrics_do_not_score_damaged_frame(rendered, frame, compute, tmp_path):
    damaged = frame(1, status=FrameStatus.DAMAGED)
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    scored = score(operator, compute, [rendered(0), rendered(frame=damaged, trained=False), rendered(2)])
    quality, _ = result(operator)
    assert (quality.frames, quality.trained.count, quality.held_out.count) == (3, 2, 0)
    assert math.isnan(scored[1].quality.psnr_tissue_db) and math.isnan(scored[1].previous_frame_db)
    assert [entry["psnr_tissue_db"] is None for entry in quality.series] == [False, True, False]
    whole = MetricsOp(None)
    score(whole, compute, [rendered(0), rendered(1, trained=False), rendered(2)])
    assert quality.frames_sha256 == whole.frames_sha256, "what was displayed is the same"


def test_baselines_use_scored_frames_and_pixels(rendered, frame, compute):
    """A run's own tool masks and withheld frames count for its baseline as for its pictures."""
    mask = np.ones((16, 24), np.uint8)
    mask[:, 12:] = 0
    frames = [frame(0), frame(1, mask=mask), frame(2, withheld="black"), frame(3, withheld="black"), frame(4), frame(5)]
    operator = MetricsOp(None)
    scored = score(operator, compute, [rendered(frame=one, trained=one.seq != 5) for one in frames])
    quality, _ = result(operator)
    left = [one.image[:, :12].astype(float) for one in frames[:2]]
    of_tissue = -10 * math.log10((((left[1] - left[0]) / 255) ** 2).mean())
    assert scored[1].previous_frame_db == pytest.approx(of_tissue, abs=1e-3)
    assert quality.previous_frame_db == pytest.approx(np.mean([scored[k].previous_frame_db for k in (1, 4, 5)]))
    before = -10 * math.log10((((frames[4].image.astype(float) - frames[1].image) / 255) ** 2).mean())
    assert scored[4].previous_frame_db == pytest.approx(before, abs=1e-3), "black pictures are not shown"
    assert quality.heldout_previous_frame_db == pytest.approx(scored[5].previous_frame_db)


def test_metrics_without_frames_have_result_and_no_output_file(tmp_path, compute):
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    quality, outputs = result(operator)
    assert quality.frames == 0 and quality.series == () and outputs == {}
    score(operator, compute, [])
    assert result(operator)[1] == {}


def test_metrics_series_has_bounded_length(rendered, compute, tmp_path, monkeypatch):
    monkeypatch.setattr("operators.frame_log.MAX_SERIES", 4)
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    score(operator, compute, [rendered(k, offset=2) for k in range(10)])
    quality, _ = result(operator)
    assert quality.frames_per_entry == 3
    assert [(entry["seq"], entry["frames"]) for entry in quality.series] == [(0, 3), (3, 3), (6, 3), (9, 1)]


def test_metrics_digest_depends_on_every_byte_and_order(rendered, compute):
    def digest(*frames):
        operator = MetricsOp(None)
        score(operator, compute, frames)
        return operator.frames_sha256

    changed = rendered(1)
    changed.image[3, 4, 1] ^= 1
    same = digest(rendered(0), rendered(1))
    assert same == digest(rendered(0), rendered(1))
    assert len({same, digest(rendered(0), changed), digest(rendered(1), rendered(0)), digest(rendered(0))}) == 4


def _decibels(grey_levels):
    return 20 * math.log10(255 / grey_levels)


def test_next_frame_result_averages_frames_with_prediction_and_baseline(frame, rendered, compute, tmp_path):
    grey = [frame(k, image=np.full((16, 24, 3), 100 + level, np.uint8)) for k, level in enumerate((0, 4, 24, 25))]
    offsets = (9, 2, None, 8)
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    operator.start()
    for source, offset in zip(grey, offsets, strict=True):
        image = None if offset is None else source.image + np.uint8(offset)
        compute(operator, rendered=rendered(frame=source), predicted=Prediction(source, image))
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    found = outcome.find(NextFrameResult)
    # The first frame has no previous one, and the third was not predicted.
    assert found.frames == 2
    assert found.psnr_tissue_db == pytest.approx((_decibels(2) + _decibels(8)) / 2)
    assert found.previous_frame_db == pytest.approx((_decibels(4) + _decibels(1)) / 2)
    logged = [entry["next_frame_db"] for entry in outcome.find(QualityResult).series]
    assert logged == [pytest.approx(_decibels(9)), pytest.approx(_decibels(2)), None, pytest.approx(_decibels(8))]


def test_next_frame_score_uses_only_tissue_pixels(frame, rendered, compute):
    mask = np.ones((16, 24), np.uint8)
    mask[:, 12:] = 0
    source = frame(1, mask=mask)
    image = source.image + np.uint8(5)
    image[:, 12:] = 0
    operator = MetricsOp(None)
    operator.start()
    compute(operator, rendered=rendered(0))
    (scored,) = compute(operator, rendered=rendered(frame=source), predicted=Prediction(source, image))
    assert scored.next_frame_db == pytest.approx(_decibels(5))


def test_next_frame_result_is_none_without_predictions(rendered, compute):
    operator = MetricsOp(None)
    (_, scored) = score(operator, compute, [rendered(0), rendered(1)])
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert outcome.find(NextFrameResult) == NextFrameResult(None, None, 0)
    assert math.isnan(scored.next_frame_db) and scored.as_json()["next_frame_db"] is None


def test_previous_frame_baseline_is_independent_of_shown_pictures(frame, rendered, compute):
    """Fails for a baseline from the displayed picture, from an older frame or with a different mask."""
    levels = [frame(k, image=np.full((16, 24, 3), 100 + level, np.uint8)) for k, level in enumerate((0, 3, 10))]
    scored = score(MetricsOp(None), compute, [rendered(frame=each, offset=50) for each in levels])
    assert [each.previous_frame_db for each in scored[1:]] == [pytest.approx(_decibels(3)), pytest.approx(_decibels(7))]


def test_frame_of_other_size_has_no_baseline(frame, rendered, compute):
    other = frame(1, image=np.zeros((8, 12, 3), np.uint8))
    scored = score(MetricsOp(None), compute, [rendered(0), rendered(frame=other, offset=2), rendered(frame=other)])
    assert [math.isnan(each.previous_frame_db) for each in scored] == [True, True, False]


def test_metrics_start_resets_scores(rendered, compute):
    operator = MetricsOp(None)
    score(operator, compute, [rendered(0), rendered(1)])
    first = operator.frames_sha256
    (scored,) = score(operator, compute, [rendered(0)])
    assert operator.frames == operator.trained.count == 1 and operator.frames_sha256 != first
    assert math.isnan(scored.previous_frame_db)
