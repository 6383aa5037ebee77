"""Scores of displayed frames, their baseline, and the digest of what was displayed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsplat_core.scene.frames import FrameStatus
from operators.frame_log import FrameLog
from operators.metrics import MetricsOp, QualityResult
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


def test_live_and_held_out_frames_are_scored_apart(rendered, compute, tmp_path):
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    score(operator, compute, [rendered(0, offset=2), rendered(1, offset=20, trained=False), rendered(2, offset=2)])
    exact = 20 * math.log10(255 / 2)
    assert operator.live.means()["psnr_tissue_db"] == pytest.approx(exact, abs=1e-3)
    assert operator.held_out.means()["psnr_tissue_db"] == pytest.approx(20 * math.log10(255 / 20), abs=1e-3)
    quality, outputs = result(operator)
    assert (quality.trained.count, quality.held_out.count, quality.frames, operator.frames) == (2, 1, 3, 3)
    assert [entry["trained"] for entry in quality.series] == [True, False, True]
    assert quality.frames_per_entry == 1 and outputs == {"frames": tmp_path / "frames.jsonl"}


def test_only_tissue_counts(rendered, frame, compute):
    mask = np.ones((16, 24), np.uint8)
    mask[:, 12:] = 0
    shown = rendered(frame=frame(0, mask=mask))
    image = shown.image.copy()
    image[:, 12:] = 0
    operator = MetricsOp(None)
    (scored,) = score(operator, compute, [rendered(frame=shown.frame, image=image)])
    assert scored.quality.psnr_tissue_db == pytest.approx(20 * math.log10(255 / 2), abs=1e-3)


def test_the_baseline_is_the_previous_raw_frame(rendered, compute, tmp_path):
    first, second = rendered(0), rendered(1)
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    scored = score(operator, compute, [first, second])
    error = (first.frame.image.astype(float) - second.frame.image) / 255
    assert math.isnan(scored[0].previous_frame_db)
    assert scored[1].previous_frame_db == pytest.approx(-10 * math.log10((error**2).mean()), abs=1e-3)
    assert result(operator)[0].series[0]["previous_frame_db"] is None, "NaN is not JSON"


def test_a_damaged_frame_is_shown_and_not_scored(rendered, frame, compute, tmp_path):
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


def test_without_a_frame_there_is_a_result_and_no_file_to_show(tmp_path, compute):
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    quality, outputs = result(operator)
    assert quality.frames == 0 and quality.series == () and outputs == {}
    score(operator, compute, [])
    assert result(operator)[1] == {}


def test_a_long_run_has_a_series_of_bounded_length(rendered, compute, tmp_path, monkeypatch):
    monkeypatch.setattr("operators.frame_log.MAX_SERIES", 4)
    operator = MetricsOp(None, log=FrameLog(tmp_path / "frames.jsonl"))
    score(operator, compute, [rendered(k, offset=2) for k in range(10)])
    quality, _ = result(operator)
    assert quality.frames_per_entry == 3
    assert [(entry["seq"], entry["frames"]) for entry in quality.series] == [(0, 3), (3, 3), (6, 3), (9, 1)]


def test_the_digest_depends_on_every_byte_and_on_the_order(rendered, compute):
    def digest(*frames):
        operator = MetricsOp(None)
        score(operator, compute, frames)
        return operator.frames_sha256

    changed = rendered(1)
    changed.image[3, 4, 1] ^= 1
    same = digest(rendered(0), rendered(1))
    assert same == digest(rendered(0), rendered(1))
    assert len({same, digest(rendered(0), changed), digest(rendered(1), rendered(0)), digest(rendered(0))}) == 4
