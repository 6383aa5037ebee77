"""The trivial baselines: by hand on a small stream, and the protocol's figures on the real recording."""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.baselines import AGES, measure_baselines
from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.scene.frames import Frame, FrameStatus

RECORDINGS = Path(
    os.environ.get("INTRASPLAT_RECORDINGS", Path(__file__).resolve().parents[4] / "shared" / "recordings")
)


def frame(seq, level, mask=None):
    return Frame(seq=seq, pts_ns=seq, image=np.full((2, 3, 3), level, np.uint8), mask=mask)


def decibels(difference):
    return -20 * np.log10(difference / 255)


def test_baselines_of_three_grey_frames_equal_expected_values():
    measured = measure_baselines([frame(0, 100), frame(1, 120), frame(2, 180)])
    assert measured.previous_frame_db == pytest.approx((decibels(20) + decibels(60)) / 2, abs=1e-4)
    assert measured.heldout_previous_frame_db == pytest.approx(decibels(20), abs=1e-4)
    assert measured.heldout_neighbour_mean_db == pytest.approx(decibels(20), abs=1e-4)  # (100 + 180) / 2 = 140
    assert measured.heldout_train_mean_db == pytest.approx(decibels(20), abs=1e-4)


def test_baselines_hold_out_frames_by_number_with_missing_frames():
    # Frame 1, the held-out one, was lost: nothing is held out, and frame 2 is compared with frame 0.
    measured = measure_baselines([frame(0, 100), frame(2, 180)])
    assert measured.previous_frame_db == pytest.approx(decibels(80), abs=1e-4)
    assert measured.heldout_previous_frame_db is measured.heldout_train_mean_db is None
    # Frame 8 was lost: 9 is held out, and its neighbours are 7 and 10.
    measured = measure_baselines([frame(7, 100), frame(9, 120), frame(10, 180)])
    assert measured.heldout_previous_frame_db == pytest.approx(decibels(20), abs=1e-4)
    assert measured.heldout_neighbour_mean_db == pytest.approx(decibels(20), abs=1e-4)


def test_baselines_do_not_score_damaged_frame():
    damaged = Frame(seq=1, pts_ns=1, image=np.full((2, 3, 3), 7, np.uint8), status=FrameStatus.DAMAGED)
    measured = measure_baselines([frame(0, 100), damaged, frame(2, 27)])
    assert measured.previous_frame_db == pytest.approx(decibels(20), abs=1e-4), "shown before frame 2, as it came"
    assert measured.heldout_previous_frame_db is measured.heldout_neighbour_mean_db is None
    assert measured.heldout_train_mean_db is None


def test_baselines_of_too_short_stream_are_none():
    one = measure_baselines([frame(0, 7)])
    assert one.previous_frame_db is one.heldout_train_mean_db is None
    two = measure_baselines([frame(0, 7), frame(1, 9)])
    assert two.heldout_previous_frame_db == pytest.approx(decibels(2), abs=1e-4)
    assert two.heldout_neighbour_mean_db is None


def test_baselines_omit_frames_without_tissue():
    nothing = np.zeros((2, 3), np.uint8)
    measured = measure_baselines([frame(0, 10), frame(1, 30, nothing), frame(2, 40)])
    assert measured.previous_frame_db == pytest.approx(decibels(10), abs=1e-4)
    assert measured.heldout_previous_frame_db is None


def test_baselines_copies_of_several_ages_with_masks():
    mask = np.array([[1, 1, 0], [1, 1, 0]], np.uint8)
    other = np.array([[0, 1, 1], [0, 1, 1]], np.uint8)
    old = frame(0, 100, mask)
    old.image[:, 0] = 0  # a tool there
    measured = measure_baselines([old, frame(1, 100, mask), frame(2, 110, other), frame(3, 110, mask)], ages=(1, 3))
    assert set(measured.copies) == {1, 3}
    assert measured.copies[3].frames == 1
    far = np.sqrt((2 * 110**2 + 2 * 10**2) / 4)
    assert measured.copies[3].psnr_tissue_db == pytest.approx(decibels(far), abs=1e-4)
    assert measured.copies[3].psnr_frame_db == pytest.approx(decibels(far) + 10 * np.log10(6 / 4), abs=1e-4)
    both = measure_baselines([frame(0, 100, mask), frame(2, 110, other)])
    assert both.copies[1].psnr_both_db == pytest.approx(decibels(10), abs=1e-4), "one column is tissue in both"
    assert measure_baselines([old, frame(1, 90, other)]).copies[1].psnr_both_db == pytest.approx(decibels(10), abs=1e-4)
    with pytest.raises(InvalidInput, match="at least one frame old"):
        measure_baselines([frame(0, 1)], ages=(0,))


def test_baselines_ignore_pixels_outside_round_view():
    """Pixels outside the view are equal in all frames and would raise the scores of the baselines."""
    inside = np.array([[1, 1, 0], [1, 0, 0]], np.uint8)

    def seen(seq, level):
        return dataclasses.replace(
            frame(seq, level), image=inside[..., None] * np.uint8(level) * np.ones(3, np.uint8), loss_mask=inside
        )

    measured = measure_baselines([seen(0, 100), seen(1, 120), seen(2, 130), seen(3, 150)])
    assert measured.previous_frame_db == pytest.approx(np.mean([decibels(d) for d in (20, 10, 20)]), abs=1e-4)
    assert measured.heldout_neighbour_mean_db == pytest.approx(decibels(5), abs=1e-4)
    expected = np.mean([100, 130, 150]) - 120
    assert measured.heldout_train_mean_db == pytest.approx(decibels(expected), abs=1e-3)
    assert measured.copies[1].psnr_both_db == pytest.approx(measured.previous_frame_db)


def moving(seq, shift_px, size=48):
    """Waves that have moved to the right."""
    y, x = np.mgrid[:size, :size]
    waves = [np.sin(0.4 * (x - shift_px) + 0.2 * y), np.cos(0.3 * (x - shift_px) - 0.25 * y), np.sin(0.35 * y)]
    return Frame(seq=seq, pts_ns=seq, image=np.rint(127 + 90 * np.stack(waves, -1)).astype(np.uint8))


def test_flow_baselines_extrapolate_and_halve_steady_motion():
    measured = measure_baselines([moving(k, 2.0 * k) for k in range(4)], flow=True)
    copy, half = measured.copies[1], measured.every["half_velocity_flow"]
    assert (copy.frames, half.frames) == (3, 2)
    assert half.psnr_tissue_db > copy.psnr_tissue_db + 4, "half of the way is there"
    assert measured.heldout["half_way_flow"].psnr_tissue_db > measured.heldout["neighbour_mean"].psnr_tissue_db + 6
    plain = measure_baselines([moving(k, 2.0 * k) for k in range(4)])
    assert "half_way_flow" not in plain.heldout and not plain.every


def test_flow_baselines_absent_for_too_small_images():
    measured = measure_baselines([moving(k, k, size=11) for k in range(4)], flow=True)
    assert not measured.every and "half_way_flow" not in measured.heldout
    assert measured.copies[1].frames == 3


def test_baselines_record_figures_of_each_frame_in_order():
    log = []
    measure_baselines([moving(k, 2.0 * k) for k in range(12)], ages=(1, 2), flow=True, record=log.append)
    assert [entry["seq"] for entry in log] == list(range(1, 12))
    assert len({tuple(entry) for entry in log}) == 1, "a series of bins needs the same names in every entry"
    assert {name for name, value in log[1].items() if value is None} == {
        "previous_frame_db",
        "neighbour_mean_db",
        "half_way_flow_db",
    }, "frame 2 is not held out"
    assert set(log[1]) >= {"psnr_tissue_db", "copy_1_db", "copy_2_db", "half_velocity_flow_db"}
    assert log[0]["psnr_tissue_db"] == log[0]["copy_1_db"] == log[0]["previous_frame_db"]


def test_baselines_count_withheld_frames_and_exclude_them_from_mean():
    withheld = Frame(seq=2, pts_ns=2, image=np.full((2, 3, 3), 250, np.uint8), withheld="blur")
    measured = measure_baselines([frame(0, 100), frame(1, 120), withheld])
    assert measured.left_out == {"withheld": 1}
    assert measured.heldout_train_mean_db == pytest.approx(decibels(20), abs=1e-4)


@pytest.mark.parametrize(("withheld", "previous", "after"), [("black", 100, 130), ("blur", 40, 130)])
def test_baselines_undisplayable_image_is_not_neighbour(withheld, previous, after):
    """The display keeps the previous picture instead of an undisplayable one, and so does the baseline."""
    odd = Frame(seq=8, pts_ns=8, image=np.full((2, 3, 3), 40, np.uint8), withheld=withheld)
    measured = measure_baselines([frame(7, 100), odd, frame(9, 120), frame(10, 130)])
    assert measured.left_out == {"withheld": 1} and measured.copies[1].frames == 2
    assert measured.heldout_previous_frame_db == pytest.approx(decibels(120 - previous), abs=1e-4)
    assert measured.heldout_neighbour_mean_db == pytest.approx(decibels(120 - (previous + after) / 2), abs=1e-4)


def test_baselines_thread_error_reaches_caller():
    wrong = Frame(seq=1, pts_ns=1, image=np.zeros((2, 3, 3), np.uint8), mask=np.ones((2, 3), np.uint8))
    object.__setattr__(wrong, "mask", np.ones((5, 5), np.uint8))
    with pytest.raises(InvalidInput, match="mask must be"):
        measure_baselines([frame(0, 1), wrong])


def test_baselines_reject_iterator():
    with pytest.raises(InvalidInput, match="twice"):
        measure_baselines(iter([frame(0, 1)]))


class CuttingRecording:
    """The real recording, decoded here so that the figures do not hang on a reader of ours."""

    folder = RECORDINGS / "cutting"

    def __init__(self, frames: int = 156) -> None:
        self._frames = frames

    def __iter__(self) -> Iterator[Frame]:
        video = cv2.VideoCapture(str(self.folder / "video.mp4"))
        seq = 0
        while seq < self._frames:
            _, image = video.read()
            tool = cv2.imread(str(self.folder / "masks" / f"{seq:06d}.png"), cv2.IMREAD_GRAYSCALE)
            yield Frame(seq=seq, pts_ns=seq * 33_333_333, image=image[..., ::-1], mask=(tool == 0).astype(np.uint8))
            seq += 1
        video.release()


@pytest.mark.recordings
@pytest.mark.skipif(
    not CuttingRecording.folder.exists() and "CI" not in os.environ, reason=f"no recording at {CuttingRecording.folder}"
)
@pytest.mark.slow
def test_baselines_of_cutting_equal_published_figures():
    assert sum(is_heldout(index) for index in range(156)) == 20
    measured = measure_baselines(CuttingRecording())
    assert measured.heldout_previous_frame_db == pytest.approx(37.24, abs=0.05)
    assert measured.heldout_neighbour_mean_db == pytest.approx(41.26, abs=0.05)
    assert measured.heldout_train_mean_db == pytest.approx(24.69, abs=0.05)
    assert measured.previous_frame_db == pytest.approx(37.14, abs=0.05)


@pytest.mark.recordings
@pytest.mark.slow
def test_flow_and_older_frame_baselines_equal_published_figures(recordings_dir):
    """Baselines of the first frames only, because optical flow takes long."""
    cutting = measure_baselines(CuttingRecording(42), ages=AGES, flow=True)
    assert cutting.heldout["half_way_flow"].psnr_tissue_db == pytest.approx(41.26, abs=0.05)
    assert cutting.heldout_neighbour_mean_db == pytest.approx(40.85, abs=0.05)
    assert cutting.every["half_velocity_flow"].psnr_tissue_db == pytest.approx(38.03, abs=0.05)
    # The published frame-hold curve is over the pixels that are tissue in both frames.
    both = [cutting.copies[age].psnr_both_db for age in (1, 2, 3, 5, 8)]
    assert both == pytest.approx([36.7, 33.0, 31.2, 28.9, 27.1], abs=0.06)
    heart = open_recording(recordings_dir / "heart" / "left.mp4", max_frames=60)
    measured = measure_baselines(heart, ages=(1, 2, 5), flow=True)
    assert measured.previous_frame_db == pytest.approx(23.02, abs=0.05)
    assert measured.every["half_velocity_flow"].psnr_tissue_db == pytest.approx(23.73, abs=0.05)
