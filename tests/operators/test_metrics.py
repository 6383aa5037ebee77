"""Scores of displayed frames, their baseline, and the digest of what was displayed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from operators.metrics import MetricsOp


def score(operator, compute, frames):
    operator.start()
    return [compute(operator, rendered=shown)[0] for shown in frames]


def test_live_and_held_out_frames_are_scored_apart(rendered, compute):
    operator = MetricsOp(None)
    score(operator, compute, [rendered(0, offset=2), rendered(1, offset=20, trained=False), rendered(2, offset=2)])
    exact = 20 * math.log10(255 / 2)
    assert operator.live.means()["psnr_tissue_db"] == pytest.approx(exact, abs=1e-3)
    assert operator.held_out.means()["psnr_tissue_db"] == pytest.approx(20 * math.log10(255 / 20), abs=1e-3)
    assert [entry["trained"] for entry in operator.series] == [True, False, True]


def test_only_tissue_counts(rendered, frame, compute):
    mask = np.ones((16, 24), np.uint8)
    mask[:, 12:] = 0
    shown = rendered(frame=frame(0, mask=mask))
    image = shown.image.copy()
    image[:, 12:] = 0
    operator = MetricsOp(None)
    (scored,) = score(operator, compute, [rendered(frame=shown.frame, image=image)])
    assert scored.quality.psnr_tissue_db == pytest.approx(20 * math.log10(255 / 2), abs=1e-3)


def test_the_baseline_is_the_previous_raw_frame(rendered, compute):
    first, second = rendered(0), rendered(1)
    operator = MetricsOp(None)
    scored = score(operator, compute, [first, second])
    error = (first.frame.image.astype(float) - second.frame.image) / 255
    assert math.isnan(scored[0].previous_frame_db)
    assert scored[1].previous_frame_db == pytest.approx(-10 * math.log10((error**2).mean()), abs=1e-3)
    assert operator.series[0]["previous_frame_db"] is None, "NaN is not JSON"


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
