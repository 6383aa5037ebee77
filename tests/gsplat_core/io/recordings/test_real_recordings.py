"""The real recordings: their facts, to the number."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording, validate_recording

pytestmark = pytest.mark.recordings


def test_cutting_recording_facts(recordings_dir: Path) -> None:
    recording = open_recording(recordings_dir / "cutting")
    assert (recording.frame_count, recording.width_px, recording.height_px, recording.fps) == (156, 640, 512, 30)
    assert recording.camera.K[0, 0] == pytest.approx(569.46820041)
    assert recording.camera.K[:2, 2].tolist() == [320, 256]
    assert recording.notes == ()
    report = validate_recording(recordings_dir / "cutting")
    assert report.ok and report.facts["frames_decoded"] == 156
    assert report.facts["tool_share"] == pytest.approx(0.197, abs=0.01)
    assert report.facts["camera_moves"] is False


def test_cutting_previous_frame_baseline(recordings_dir: Path) -> None:
    """The frames, masks and their order are right: the previous frame scores what is published with the recording."""
    previous, scores = None, []
    for frame in open_recording(recordings_dir / "cutting", max_frames=26):
        if previous is not None and frame.seq in (1, 9, 17, 25):
            assert frame.mask is not None
            error = (frame.image.astype(np.float64) - previous)[frame.mask == 1] / 255
            scores.append(-10 * np.log10(np.mean(error**2)))
        previous = frame.image
    assert 33 < np.mean(scores) < 42


def test_truncated_cutting_video_is_refused(recordings_dir: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    data = (recordings_dir / "cutting" / "video.mp4").read_bytes()
    (tmp_path / "video.mp4").write_bytes(data[: len(data) // 2])
    refused(tmp_path, RecordingInvalid, "cut off")


def test_sinus_recording_facts(recordings_dir: Path) -> None:
    recording = open_recording(recordings_dir / "sinus")
    assert (recording.frame_count, recording.width_px, recording.height_px, recording.fps) == (35, 540, 540, 30)
    assert recording.camera.K[0, 0] == pytest.approx(338.5855)
    positions = np.array([recording.camera_at(index).position for index in range(35)])
    assert positions[0] == pytest.approx([-0.0058837, -0.0245542, -0.0262863], abs=1e-6)
    assert np.linalg.norm(positions[-1] - positions[0]) > 0.2  # it moves
    frames = list(recording)
    assert len(frames) == 35
    assert frames[0].mask is not None and frames[0].mask.mean() == pytest.approx(0.673, abs=0.001)


def test_sinus_poses_reproject_the_published_points(recordings_dir: Path) -> None:
    """Structure from motion placed points with these cameras: each lies in the images that saw it."""
    recording = open_recording(recordings_dir / "sinus")
    with np.load(recordings_dir / "sinus" / "sfm_points.npz", allow_pickle=False) as data:
        points, seen_point, seen_frame = data["points"], data["obs_point"], data["obs_frame"]
    for index in (0, 17, 34):
        seen = points[seen_point[seen_frame == index]]
        assert len(seen) > 100
        camera = recording.camera_at(index)
        local = seen @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        assert (local[:, 2] > 0).all()
        pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
        assert ((pixels > 0) & (pixels < 540)).all()
