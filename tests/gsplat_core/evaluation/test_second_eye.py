"""Measures of the right eye's view, and the scores of trivial predictors."""

import numpy as np
import pytest

from gsplat_core.evaluation.views import (
    BEYOND_TYPICAL,
    EVERY,
    MATCHED,
    RIGHT_BEFORE,
    SHIFTED,
    evaluate_second_eye,
    line_psnr_db,
    matched_disparity,
    warped_by_disparity,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import PSNR_CAP_DB

WIDTH, HEIGHT, DISPARITY = 160, 60, 20
LEFT = Camera.from_focal(120.0, WIDTH, HEIGHT)
RIGHT = LEFT.right_eye(10.0)  # of a plane at 60 mm: 20 px


def wide(seq):
    """Smooth patches, other ones for every frame; the left eye's picture begins where the right one's does, and DISPARITY farther."""
    random = np.random.default_rng(seq)
    patches = random.integers(20, 236, (HEIGHT // 4, (WIDTH + DISPARITY) // 4, 3)).astype(np.uint8)
    return patches.repeat(4, 0).repeat(4, 1)


def stereo(seq, **fields):
    picture = wide(seq)
    left, right = picture[:, :WIDTH], picture[:, DISPARITY:]
    given = {"right_image": np.ascontiguousarray(right), "right_camera": RIGHT} | fields
    return Frame(seq, seq * 40_000_000, np.ascontiguousarray(left), **given)


def test_second_eye_exact_view_scores_cap_on_every_tenth_frame():
    asked, log = [], []

    def exact(frame, eye):
        asked.append((frame.seq, eye))
        return frame.right_image

    found = evaluate_second_eye([stereo(seq) for seq in range(25)], LEFT, exact, record=log.append)
    assert [seq for seq, _ in asked] == [0, EVERY, 2 * EVERY] and all(eye == RIGHT for _, eye in asked)
    assert (found.score.psnr_tissue_db, found.score.frames, found.score.worst_seq) == (PSNR_CAP_DB, 3, 0)
    assert [entry["seq"] for entry in log] == [0, 10, 20] and log[1]["psnr_tissue_db"] == PSNR_CAP_DB
    assert found.baselines[RIGHT_BEFORE].frames == 2, "the first frame has none before it"
    assert found.left_out_px == round(BEYOND_TYPICAL * DISPARITY)


def test_second_eye_shift_and_match_baselines_exact_for_plane():
    frames = [stereo(seq) for seq in range(EVERY + 1)]
    found = evaluate_second_eye(frames, LEFT, lambda frame, eye: frame.image)
    assert found.baselines[SHIFTED].psnr_tissue_db > 40
    assert found.baselines[MATCHED].psnr_tissue_db > 40
    assert found.baselines[RIGHT_BEFORE].psnr_tissue_db < 15
    assert found.score.psnr_tissue_db < 15, "the left picture itself"


def test_second_eye_uses_pose_of_frame():
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    eyes = []
    evaluate_second_eye([stereo(0, pose=pose)], LEFT, lambda frame, eye: eyes.append(eye) or frame.image)
    assert np.allclose(eyes[0].world_to_camera, RIGHT.world_to_camera @ pose)


def test_second_eye_ignores_border_and_columns_of_right_eye_only():
    frame = stereo(0)
    wrong = frame.right_image.copy()
    wrong[:, WIDTH - 30 :] = 0
    wrong[:4], wrong[-4:], wrong[:, :4] = 255, 255, 255
    counted = evaluate_second_eye([frame], LEFT, lambda *_: wrong, left_out_px=30)
    assert counted.score.psnr_tissue_db == PSNR_CAP_DB
    assert evaluate_second_eye([frame], LEFT, lambda *_: wrong, left_out_px=29).score.psnr_tissue_db < 40


def test_second_eye_ignores_area_possibly_hidden_by_tool():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[20:40, 80:100] = 0
    frame = stereo(0, mask=mask)
    wrong = frame.right_image.copy()
    wrong[20:40, 60:80] = 0
    assert evaluate_second_eye([frame], LEFT, lambda *_: wrong).score.psnr_tissue_db == PSNR_CAP_DB


def test_line_psnr_ignores_linear_but_not_nonlinear_colour_change():
    true = wide(1)[:, :WIDTH]
    all_of_it = np.ones(true.shape[:2], bool)
    line = (true / 255) * [0.5, 0.8, 0.3] + [0.1, 0.0, 0.4]
    assert line_psnr_db(line, true, all_of_it) == PSNR_CAP_DB
    assert line_psnr_db((true / 255) ** 2, true, all_of_it) < 40


def test_line_psnr_measures_residual_of_linear_fit():
    true = np.zeros((4, 4, 3), np.uint8)
    true[::2] = 20
    flat = np.full((4, 4, 3), 7, np.uint8)
    assert line_psnr_db(flat, true, np.ones((4, 4), bool)) == pytest.approx(20 * np.log10(255 / 10))
    assert np.isnan(line_psnr_db(flat, true, np.zeros((4, 4), bool)))


def test_second_eye_counts_unscored_frames_by_reason():
    frames = [
        stereo(0, status=FrameStatus.DAMAGED),
        *(stereo(seq) for seq in range(1, 10)),
        stereo(10, withheld="blur"),
    ]
    found = evaluate_second_eye(frames, LEFT, lambda frame, eye: frame.image)
    assert found.score.left_out == {"damaged": 1, "withheld": 1}
    assert (found.score.frames, found.score.psnr_tissue_db, found.score.worst_seq) == (0, None, None)


@pytest.mark.parametrize("missing", ["right_image", "right_camera"])
def test_second_eye_without_right_eye_is_none(missing):
    assert evaluate_second_eye([stereo(0, **{missing: None})], LEFT, lambda frame, eye: frame.image) is None


def test_matched_disparity_of_either_sign():
    picture = wide(2)
    left, right = np.ascontiguousarray(picture[:, :WIDTH]), np.ascontiguousarray(picture[:, DISPARITY:])
    assert np.median(matched_disparity(left, right)) == pytest.approx(DISPARITY, abs=0.2)
    assert np.median(matched_disparity(right, left)) == pytest.approx(-DISPARITY, abs=0.2)


def test_warp_by_zero_disparity_keeps_image():
    picture = wide(3)[:, :WIDTH]
    assert np.array_equal(warped_by_disparity(picture, np.zeros(picture.shape[:2], np.float32)), picture)
