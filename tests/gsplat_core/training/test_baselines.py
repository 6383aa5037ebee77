"""The trivial baselines: by hand on a small stream, and the protocol's figures on the real recording."""

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import is_heldout
from gsplat_core.scene.frames import Frame
from gsplat_core.training.baselines import measure_baselines

RECORDINGS = Path(
    os.environ.get("INTRASPLAT_RECORDINGS", Path(__file__).resolve().parents[4] / "shared" / "recordings")
)


def frame(seq, level, mask=None):
    return Frame(seq=seq, pts_ns=seq, image=np.full((2, 3, 3), level, np.uint8), mask=mask)


def decibels(difference):
    return -20 * np.log10(difference / 255)


def test_by_hand():
    measured = measure_baselines([frame(0, 100), frame(1, 120), frame(2, 180)])
    assert measured.previous_frame_db == pytest.approx((decibels(20) + decibels(60)) / 2, abs=1e-4)
    assert measured.heldout_previous_frame_db == pytest.approx(decibels(20), abs=1e-4)
    assert measured.heldout_neighbour_mean_db == pytest.approx(decibels(20), abs=1e-4)  # (100 + 180) / 2 = 140
    assert measured.heldout_train_mean_db == pytest.approx(decibels(20), abs=1e-4)


def test_frames_are_held_out_by_their_number_where_some_are_missing():
    # Frame 1, the held-out one, was lost: nothing is held out, and frame 2 is compared with frame 0.
    measured = measure_baselines([frame(0, 100), frame(2, 180)])
    assert measured.previous_frame_db == pytest.approx(decibels(80), abs=1e-4)
    assert measured.heldout_previous_frame_db is measured.heldout_train_mean_db is None
    # Frame 8 was lost: 9 is held out, and its neighbours are 7 and 10.
    measured = measure_baselines([frame(7, 100), frame(9, 120), frame(10, 180)])
    assert measured.heldout_previous_frame_db == pytest.approx(decibels(20), abs=1e-4)
    assert measured.heldout_neighbour_mean_db == pytest.approx(decibels(20), abs=1e-4)


def test_a_stream_too_short_for_a_baseline_says_none():
    one = measure_baselines([frame(0, 7)])
    assert one.previous_frame_db is one.heldout_train_mean_db is None
    two = measure_baselines([frame(0, 7), frame(1, 9)])
    assert two.heldout_previous_frame_db == pytest.approx(decibels(2), abs=1e-4)
    assert two.heldout_neighbour_mean_db is None


def test_frames_without_tissue_are_left_out():
    nothing = np.zeros((2, 3), np.uint8)
    measured = measure_baselines([frame(0, 10), frame(1, 30, nothing), frame(2, 40)])
    assert measured.previous_frame_db == pytest.approx(decibels(10), abs=1e-4)
    assert measured.heldout_previous_frame_db is None


def test_an_iterator_is_refused():
    with pytest.raises(InvalidInput, match="twice"):
        measure_baselines(iter([frame(0, 1)]))


class CuttingRecording:
    """The real recording, decoded here so that the figures do not hang on a reader of ours."""

    folder = RECORDINGS / "cutting"

    def __iter__(self) -> Iterator[Frame]:
        video = cv2.VideoCapture(str(self.folder / "video.mp4"))
        seq = 0
        while True:
            read, image = video.read()
            if not read:
                break
            tool = cv2.imread(str(self.folder / "masks" / f"{seq:06d}.png"), cv2.IMREAD_GRAYSCALE)
            yield Frame(seq=seq, pts_ns=seq * 33_333_333, image=image[..., ::-1], mask=(tool == 0).astype(np.uint8))
            seq += 1
        video.release()


@pytest.mark.recordings
@pytest.mark.skipif(
    not CuttingRecording.folder.exists() and "CI" not in os.environ, reason=f"no recording at {CuttingRecording.folder}"
)
def test_the_protocols_figures_on_the_cutting_recording():
    assert sum(is_heldout(index) for index in range(156)) == 20
    measured = measure_baselines(CuttingRecording())
    assert measured.heldout_previous_frame_db == pytest.approx(37.24, abs=0.05)
    assert measured.heldout_neighbour_mean_db == pytest.approx(41.26, abs=0.05)
    assert measured.heldout_train_mean_db == pytest.approx(24.69, abs=0.05)
    assert measured.previous_frame_db == pytest.approx(37.14, abs=0.05)
