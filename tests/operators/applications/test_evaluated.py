"""Mapping of a recording's timestamps to those of the run that played it, and the match of model and recording."""

from __future__ import annotations

import math
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting, RecordingInvalid
from gsplat_core.io.recordings import open_recording
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.applications import evaluated
from operators.applications.evaluated import Playback, SeenFrames, fitting_source
from operators.sources.recording import RecordingSource
from operators.sources.source import SourceDescription
from tests.gsplat_core.io.recordings import videos

CAMERA = Camera.from_focal(60.0, 64, 48)


def frame(seq: int) -> Frame:
    return Frame(seq, seq * 100_000_000, np.zeros((2, 2, 3), np.uint8))


def about(count=10, fps=10.0) -> SourceDescription:
    return SourceDescription("clip", 64, 48, fps, CAMERA, frame_count=count, digest="d")


def model(start_s: float, end_s: float):
    return SimpleNamespace(time_window_s=(start_s, end_s))


def test_playback_times_offset_by_round_and_stretch():
    once = Playback(0.9)
    first = frame(3)
    assert once.times(first, 0, 10) is first
    stretched = Playback(0.9, stretch=0.5, round_s=0.5).times(frame(3), 2, 10)
    assert (stretched.seq, stretched.pts_ns) == (23, 1_150_000_000)
    assert Playback(0.9, stretch=2.0).times(frame(3), 0, 10).pts_ns == 600_000_000


@pytest.fixture
def seen(monkeypatch):
    monkeypatch.setattr(evaluated, "FirstFrames", lambda source, count: [frame(k) for k in range(count)])

    def run(from_s, until_s, playback=Playback(0.9), stop=lambda: False):
        done = []
        source = SimpleNamespace(description=about())
        found = [each.seq for each in SeenFrames(source, from_s, until_s, playback, stop, done.append)]
        return found, done

    return run


def test_evaluated_frames_are_limited_to_time_range(seen):
    assert seen(-math.inf, 0.35) == ([0, 1, 2, 3], [1, 2, 3, 4])
    assert seen(0.25, 0.55) == ([3, 4, 5], [1, 2, 3, 4, 5, 6]), "frames before the range are read, too"
    assert seen(0.0, 99.0)[0] == list(range(10)), "a recording that is not looped ends"
    assert seen(0.0, 99.0, stop=lambda: True) == ([], [])


def test_playback_ends_at_last_timestamp_of_variable_frame_rate_file(tmp_path):
    times_ms = [0, 33, 99, 132, 232, 265, 331, 364]
    path = videos.write_timed(tmp_path / "v.mkv", times_ms, 30, Fraction(1, 1000))
    source = RecordingSource(open_recording(path))
    made = SimpleNamespace(
        camera=source.description.camera, training_digest=source.description.digest, time_window_s=(0.0, 0.364)
    )
    _, _, playback, notes = fitting_source(path, made, None, None)
    assert playback.last_s == pytest.approx(0.364) and notes == []


def test_evaluated_frames_of_looped_recording_include_later_rounds(seen):
    looped = Playback(0.9, round_s=1.0)
    assert seen(1.75, 2.15, looped) == ([18, 19, 20, 21], list(range(1, 13))), "reading begins with the second round"
    assert seen(1.0, 1.05, looped)[0] == [10]
    assert seen(-math.inf, 1.05, looped)[0] == list(range(11))


@pytest.mark.parametrize(
    ("run_scale", "scale"), [(None, 0.5), (0.5, 0.5), (0.25, 0.5)], ids=["unknown", "the run's", "another"]
)
def test_scale_of_model_maps_recording_size_to_model_size(run_scale, scale):
    assert evaluated._scale_of_model(CAMERA.scaled(0.5), CAMERA, run_scale) == scale
    assert evaluated._scale_of_model(CAMERA, CAMERA, run_scale) == 1.0


def test_scale_of_model_prefers_run_scale_within_rounding():
    made = CAMERA.scaled(0.51)
    assert evaluated._scale_of_model(made, CAMERA, 0.51) == 0.51
    assert made.width_px / CAMERA.width_px != 0.51


def moved(focal=0.0, x=0.0) -> Camera:
    K = CAMERA.K.copy()
    K[0, 0] += focal
    K[0, 2] += x
    return SimpleNamespace(model="pinhole", width_px=64, height_px=48, K=K, scaled=lambda ratio: CAMERA.scaled(ratio))


def test_check_camera_refuses_differences_beyond_rounding():
    check = lambda made, seen: evaluated._check_camera(made, seen, "clip")
    check(CAMERA, CAMERA)
    check(CAMERA, moved(focal=0.05))
    check(CAMERA, CAMERA.scaled(0.5))
    check(CAMERA.scaled(0.5), CAMERA)
    for other, said in (
        (moved(focal=0.2), "focal length of 60.00"),
        (moved(x=-0.2), "focal length"),
        (SimpleNamespace(model="fisheye"), "has a fisheye one"),
        (SimpleNamespace(model="pinhole", width_px=64, height_px=50), "another shape"),
        (SimpleNamespace(model="pinhole", width_px=64, height_px=46), "another shape"),
    ):
        with pytest.raises(InvalidSetting, match=said):
            check(CAMERA, other)
    check(CAMERA, SimpleNamespace(model="pinhole", width_px=64, height_px=49, K=CAMERA.K))


def test_playback_of_run_at_recording_rate():
    playback, notes = evaluated._playback(model(0.0, 0.9), about(), None, False)
    assert (playback.last_s, playback.stretch, playback.round_s, notes) == (0.9, 1.0, math.inf, [])
    _, notes = evaluated._playback(model(0.0, 0.55), about(), None, False)
    assert notes == ["the model has seen 0.00 to 0.55 s: the first 7 of the 10 frames are evaluated"]
    assert evaluated._playback(model(0.0, 0.8), about(), None, False)[1] == [], "the frame after the last one counts"
    _, notes = evaluated._playback(model(0.0, 3.0), about(), None, False)
    assert notes == ["the model has seen 0.00 to 3.00 s, and the frames that are evaluated end at 1.00 s"]
    with pytest.raises(InvalidSetting, match="no time in common"):
        evaluated._playback(model(1.2, 3.0), about(), None, False)
    evaluated._playback(model(1.05, 3.0), about(), None, False)


def test_playback_of_run_at_other_rate_or_looped():
    playback, notes = evaluated._playback(model(0.0, 0.45), about(), 20.0, False)
    assert (playback.last_s, playback.stretch, playback.round_s) == (0.45, 0.5, math.inf)
    assert notes == ["the run played the recording at 20 frames/s; times are the run's"]
    playback, notes = evaluated._playback(model(0.0, 1.25), about(), 20.0, False)
    assert (playback.last_s, playback.round_s) == (0.45, 0.5)
    assert "the last of 2.5 rounds" in notes[1]
    playback, notes = evaluated._playback(model(0.0, 2.5), about(), 10.0, False)
    assert playback.round_s == 1.0 and len(notes) == 1
    assert math.isinf(evaluated._playback(model(0.0, 2.5), about(), 10.0, True)[0].round_s), "a shortened one is none"
    assert math.isinf(evaluated._playback(model(0.0, 1.05), about(), 10.0, False)[0].round_s), "within the tolerance"


def test_session_playback_uses_timestamps_of_run(monkeypatch, tmp_path):
    lines = [SimpleNamespace(pts_ns=k * 100_000_000) for k in (0, 2, 1, 50)]
    monkeypatch.setattr(evaluated, "SessionReader", lambda folder: SimpleNamespace(frame_lines=lambda: iter(lines)))
    playback, notes = evaluated._session_playback(model(0.0, 0.2), tmp_path, about(count=3))
    assert playback == Playback(0.2) and notes == []


@pytest.mark.parametrize("made", ["file", "none", "damaged", "no run", "own poses"])
def test_with_poses_of_run_applies_poses_file_by_frame(tmp_path, made):
    """Frames beyond the last pose, of a recording that was read longer, have the last one."""
    poses = np.eye(4)[None].repeat(3, 0)
    poses[:, 0, 3] = 1, 2, 3
    if made in ("file", "own poses"):
        np.save(tmp_path / evaluated.POSES_FILE, poses)
    if made == "damaged":
        (tmp_path / evaluated.POSES_FILE).write_bytes(b"nothing")
    run = None if made == "no run" else SimpleNamespace(folder=tmp_path)
    source = SimpleNamespace(description=SimpleNamespace(fields={"pose"} if made == "own poses" else set()))
    if made == "damaged":
        with pytest.raises(RecordingInvalid, match="has no poses"):
            evaluated.with_poses_of_run(source, run)
        return
    if made != "file":
        assert evaluated.with_poses_of_run(source, run) is source
        return
    found = evaluated.with_poses_of_run(SimpleNamespace(description=about()), run)
    assert [found._pose_of(frame(seq))[0, 3] for seq in (0, 2, 7)] == [-1, -3, -3], "from camera to world in the file"
