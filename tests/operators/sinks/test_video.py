"""The video of a run is either playable or absent."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from operators.errors import StorageFull
from operators.outcome import OutcomeBuilder
from operators.sinks.video import DisplayResult, VideoSinkOp
from operators.storage import StorageReserve


def frames_of(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1])
    return frames


def test_video_sink_shows_raw_and_reconstruction_side_by_side(tmp_path, rendered, compute):
    operator = VideoSinkOp(None, path=tmp_path / "out.mp4", fps=25.0)
    operator.start()
    for k in range(4):
        compute(operator, rendered=rendered(k, offset=30))
    assert not (tmp_path / "out.mp4").exists(), "the name appears with the finished file"
    operator.stop()
    frames = frames_of(tmp_path / "out.mp4")
    assert len(frames) == 4 == operator.displayed
    _height, width = frames[0].shape[:2]
    assert width == 2 * 14 * 24, "small frames are enlarged by a whole factor"
    raw, reconstruction = frames[0][40:, : width // 2 - 8], frames[0][40:, width // 2 + 8 :]
    assert 20 < float(reconstruction.mean()) - float(raw.mean()) < 40


def test_video_caption_changes_with_model_version_and_training(tmp_path, rendered, compute):
    """The caption changes with the frame number and never covers the picture; no character recognition is used."""
    from operators.sinks.video import CAPTION_HEIGHT_PX, side_by_side

    one, other = side_by_side(rendered(1)), side_by_side(rendered(1, model_version=77))
    differs = np.abs(one.astype(int) - other).sum(axis=2) > 0
    assert differs[:CAPTION_HEIGHT_PX].any() and not differs[CAPTION_HEIGHT_PX:].any()
    held_out = side_by_side(rendered(1, trained=False))
    assert (np.abs(one.astype(int) - held_out).sum(axis=2) > 0)[:CAPTION_HEIGHT_PX].any()


def test_video_sink_without_frames_leaves_no_file(tmp_path):
    operator = VideoSinkOp(None, path=tmp_path / "out.mp4", fps=25.0)
    operator.start()
    operator.stop()
    assert list(tmp_path.iterdir()) == []


def test_video_sink_keeps_earlier_video_if_run_fails(tmp_path, rendered, compute):
    path = tmp_path / "out.mp4"
    path.write_bytes(b"earlier")
    operator = VideoSinkOp(None, path=path, fps=25.0, reserve=StorageReserve(tmp_path, lambda: 1 << 60))
    operator.start()
    with pytest.raises(StorageFull, match=r"the disk of .* is full"):
        compute(operator, rendered=rendered())
    operator.stop()
    assert path.read_bytes() == b"earlier" and len(list(tmp_path.iterdir())) == 1


def test_video_sink_finishes_video_if_disk_fills_up(tmp_path, rendered, compute):
    reserve_bytes = 0
    operator = VideoSinkOp(
        None, path=tmp_path / "out.mp4", fps=25.0, reserve=StorageReserve(tmp_path, lambda: reserve_bytes)
    )
    operator.start()
    compute(operator, rendered=rendered(0))
    compute(operator, rendered=rendered(1))
    reserve_bytes = 1 << 60
    with pytest.raises(StorageFull, match="free some space on that disk or choose another --out"):
        compute(operator, rendered=rendered(2))
    operator.stop()
    assert len(frames_of(tmp_path / "out.mp4")) == 2


@pytest.mark.parametrize("size", [(400, 500), (9, 700), (300, 8)])
def test_video_sink_fits_frame_of_other_size(tmp_path, rendered, frame, compute, size):
    operator = VideoSinkOp(None, path=tmp_path / "out.mp4", fps=25.0)
    operator.start()
    compute(operator, rendered=rendered(0))
    compute(operator, rendered=rendered(frame=frame(1, image=np.full((*size, 3), 200, np.uint8))))
    operator.stop()
    first, second = frames_of(tmp_path / "out.mp4")
    assert first.shape == second.shape
    assert 150 < second.max() <= 255


def test_video_sink_contributes_frame_count_and_video_path(tmp_path, rendered, compute):
    operator, outcome = VideoSinkOp(None, path=tmp_path / "out.mp4", fps=25.0), OutcomeBuilder()
    operator.contribute(outcome)
    assert outcome.find(DisplayResult) == DisplayResult(0) and outcome.outputs == {}
    operator.start()
    compute(operator, rendered=rendered(0))
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert outcome.find(DisplayResult) == DisplayResult(1) and outcome.outputs == {"video": tmp_path / "out.mp4"}
