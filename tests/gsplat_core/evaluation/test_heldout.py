"""The held-out protocol: which frames, which figures, what is left out."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.evaluation.protocols import OUTSIDE, evaluate_heldout
from gsplat_core.scene.frames import FrameStatus
from gsplat_core.training.metrics import PSNR_CAP_DB

ALWAYS = (0.0, 1e9)


def test_heldout_exact_model_scores_cap_on_held_out_frames_only(frame, picture):
    asked = []

    def exact(each):
        asked.append(each.seq)
        return picture(int(each.image[0, 0, 0]))

    log = []
    frames = [frame(k, 50 + k) for k in range(20)]
    found = evaluate_heldout(frames, exact, window_s=ALWAYS, record=log.append)
    assert asked == [1, 9, 17], "no other frame is rendered"
    assert (found.score.psnr_tissue_db, found.score.psnr_frame_db, found.score.frames) == (PSNR_CAP_DB, PSNR_CAP_DB, 3)
    assert found.score.ssim == pytest.approx(1, abs=1e-6) and found.unrounded_db == PSNR_CAP_DB
    assert found.score.left_out == {} and found.depth is None
    assert [(entry["seq"], entry["psnr_tissue_db"]) for entry in log] == [(1, 100.0), (9, 100.0), (17, 100.0)]


@pytest.mark.parametrize("excluded", ["mask", "loss_mask"])
def test_heldout_psnr_of_tissue_frame_and_unrounded_image(frame, picture, decibels, excluded):
    mask = np.ones((16, 20), np.uint8)
    mask[:, :15] = 0
    shown = evaluate_heldout([frame(1, 100, **{excluded: mask})], lambda _: picture(110.4), window_s=ALWAYS)
    assert shown.score.psnr_tissue_db == pytest.approx(decibels(10), abs=1e-6), "as a PNG file holds it"
    assert shown.score.psnr_frame_db == pytest.approx(decibels(10) + 10 * np.log10(4), abs=1e-6), "a quarter is tissue"
    assert shown.unrounded_db == pytest.approx(decibels(10.4), abs=1e-4)


def test_heldout_counts_unscored_frames_by_reason(frame, picture, decibels):
    frames = [
        frame(1, status=FrameStatus.DAMAGED),
        frame(9, withheld="blur"),
        frame(17, mask=np.zeros((16, 20), np.uint8)),
        frame(25),
        frame(33),
    ]
    found = evaluate_heldout(frames, lambda _: picture(105), window_s=(0.0, 1.0))
    assert found.score.left_out == {"damaged": 1, "no tissue": 1, "withheld": 1, OUTSIDE: 1}
    assert (found.score.frames, found.score.worst_seq) == (1, 25)
    assert found.score.worst_db == found.score.psnr_tissue_db == pytest.approx(decibels(5), abs=1e-6)


def test_heldout_without_scored_frames_has_no_figure(frame, picture):
    found = evaluate_heldout([frame(0), frame(2)], lambda _: picture(0), window_s=ALWAYS)
    assert found.score.psnr_tissue_db is found.score.worst_db is found.unrounded_db is None
    assert found.score.frames == 0


def test_heldout_compares_depth_at_known_pixels(frame, picture):
    true = np.full((16, 20), 50, np.float32)
    true[0], true[1], true[2] = 0, np.nan, np.inf
    mask = np.ones((16, 20), np.uint8)
    mask[-1] = 0
    true[-1] = 1e6  # under the tool
    found = evaluate_heldout([frame(1, depth=true, mask=mask)], lambda _: picture(100, depth=55), window_s=ALWAYS)
    assert found.depth is not None
    assert found.depth.mae_mm == found.depth.rmse_mm == pytest.approx(5) and found.depth.relative == pytest.approx(0.1)
    assert found.depth.scaled_rmse_mm == pytest.approx(0, abs=1e-5), "one factor makes it exact"
    assert (found.depth.covered, found.depth.frames) == (1.0, 1)


def test_heldout_depth_is_none_for_model_without_depth(frame, picture):
    known = np.full((16, 20), 50, np.float32)
    found = evaluate_heldout([frame(1, depth=known)], lambda _: picture(100, depth=0), window_s=ALWAYS)
    assert found.depth is None
