"""`intrasplat poses`: the written file, notes, and refused inputs."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.io.recordings import open_recording
from gsplat_core.poses import focal_length
from gsplat_core.poses.focal_length import FocalLength
from gsplat_core.poses.odometry import Breathing
from services.cli import recordings
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK
from tests.gsplat_core.geometry.moving_scope import FOCAL, HEIGHT, SIDEWAYS, WIDTH, video

COUNT = 10
STILL = (0.0, 0.0, 0.0)


@pytest.fixture
def clip(tmp_path):
    """Return a function that writes images of a scope moving by `step` per frame, with or without calibration."""

    def write(step=SIDEWAYS, calibrated=True, blank=()):
        folder = tmp_path / "clip"
        folder.mkdir()
        frames, _ = video(COUNT, step)
        noise = np.random.default_rng(0)
        for number, frame in enumerate(frames):
            noisy = np.clip(frame.image + noise.normal(0, 3, frame.image.shape), 0, 255).astype(np.uint8)
            picture = np.full_like(noisy, 90) if number in blank else noisy
            cv2.imwrite(str(folder / f"{number}.png"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        if calibrated:
            size = {"width": WIDTH, "height": HEIGHT}
            camera = {**size, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
            facts = {"format": "intrasplat-recording", "version": 1, "fps": 30, "camera": camera}
            (folder / "recording.json").write_text(json.dumps(facts))
        return folder

    return write


def run_poses(capsys, clip, *options):
    assert run(["poses", str(clip), "--out", str(clip / "poses.npy"), "--json", *options]) == OK
    return json.loads(capsys.readouterr().out)


def test_poses_writes_file_that_recording_is_read_with(clip, capsys):
    folder = clip()
    said = run_poses(capsys, folder)
    assert (said["path"], said["frames"], said["not_placed"]) == (str(folder / "poses.npy"), COUNT, [])
    assert said["way"] > 0 and said["points"] > 50 and said["explained"] > 0.9
    assert 0 < said["error_px"] < said["error_px_of_a_still_scope"]
    read = np.stack([frame.pose for frame in open_recording(folder)])
    _, cameras = video(COUNT, SIDEWAYS)
    errors = evaluate_trajectory(read, np.stack([camera.world_to_camera for camera in cameras]))
    assert errors is not None and errors.similarity_share < 0.05


def test_poses_notes_that_lengths_have_no_scale(clip, capsys):
    notes = run_poses(capsys, clip())["notes"]
    assert notes == ["lengths have no scale: the first frame's tissue is taken to be 60 away"]


def test_poses_without_json_prints_table_and_notes(clip, capsys):
    folder = clip()
    assert run(["poses", str(folder), "--out", str(folder / "poses.npy")]) == OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["path", str(folder / "poses.npy")]
    assert "not_placed                 -" in lines
    assert lines[-1].startswith("note: lengths have no scale")


def test_poses_max_frames_limits_frames(clip, capsys):
    assert run_poses(capsys, clip(), "--max-frames", "5")["frames"] == 5


@pytest.mark.slow
def test_poses_notes_unknown_calibration(clip, capsys):
    said = run_poses(capsys, clip(calibrated=False))
    assert any("there is no calibration; a pinhole with f = 144.0 px" in note for note in said["notes"])
    assert any(
        "the pictures do not determine the focal length: tried values from 96 to 256 px" in note
        for note in said["notes"]
    )
    assert (said["focal_px"], said["focal_px_from"], said["focal_px_range"]) == (144, "assumed", [96, 256])


@pytest.mark.slow
def test_poses_uses_and_notes_estimated_focal_length(clip, capsys, monkeypatch):
    focal_length_found = FocalLength(144.0, FOCAL, (130.0, 150.0), True)
    monkeypatch.setattr(focal_length, "focal_length_of", lambda frames, camera, found: focal_length_found)
    folder = clip(calibrated=False)
    said = run_poses(capsys, folder)
    assert (said["focal_px"], said["focal_px_from"], said["focal_px_range"]) == (FOCAL, "pictures", [130, 150])
    (note,) = (note for note in said["notes"] if "the focal length was found" in note)
    assert "140 px fits best, and values from 130 to 150 px fit almost equally well" in note
    stated = json.loads(note.partition('"camera": ')[2])
    described = {"format": "intrasplat-recording", "version": 1, "fps": 30, "camera": stated}
    (folder / "recording.json").write_text(json.dumps(described))
    assert open_recording(folder).camera.K[0, 0] == FOCAL


def test_poses_uses_calibrated_focal_length(clip, capsys):
    said = run_poses(capsys, clip())
    assert (said["focal_px"], said["focal_px_from"], said["focal_px_range"]) == (FOCAL, "calibration", [])


@pytest.mark.slow
def test_poses_notes_that_scope_may_be_at_rest(clip, capsys):
    said = run_poses(capsys, clip(STILL))
    assert said["explained"] < 0.75
    assert any("it may be at rest in front of moving tissue" in note for note in said["notes"])


@pytest.mark.slow
def test_poses_notes_breathing_frequencies_and_uncertainty(clip, capsys, monkeypatch):
    plain = recordings.trajectory_of

    def trajectory(frames, camera):
        found = plain(frames, camera)
        return replace(found, breathing=Breathing((0.294, 1.11), 0.02 * found.path))

    monkeypatch.setattr(recordings, "trajectory_of", trajectory)
    said = run_poses(capsys, clip())
    assert (said["breathing_hz"], said["uncertain"]) == ([0.294, 1.11], 0.02)
    assert any("0.29 and 1.11 times a second" in note and "2.0% of the trajectory" in note for note in said["notes"])


def test_poses_notes_large_reprojection_error(clip, capsys, monkeypatch):
    plain = recordings.trajectory_of
    monkeypatch.setattr(recordings, "trajectory_of", lambda *given: replace(plain(*given), error_px=1.5))
    said = run_poses(capsys, clip())
    assert (said["breathing_hz"], said["uncertain"]) == ([], None)
    assert any("points are off by 1.5 px: the tissue moves by itself" in note for note in said["notes"])


def test_poses_notes_frames_without_texture(clip, capsys):
    said = run_poses(capsys, clip(blank=[4]))
    assert said["not_placed"] == [4]
    assert any("1 frames could not be placed" in note and "from frame 4 on" in note for note in said["notes"])


def test_poses_overwrites_only_its_own_files_on_request(clip, capsys):
    folder = clip()
    file = folder.parent / "mine.npy"
    file.write_bytes(b"mine")
    assert run(["poses", str(folder), "--out", str(file)]) == BAD_INPUT
    assert "already exists" in capsys.readouterr().err and file.read_bytes() == b"mine"
    assert run(["poses", str(folder), "--out", str(file), "--overwrite"]) == BAD_INPUT
    assert "was not written by intrasplat" in capsys.readouterr().err and file.read_bytes() == b"mine"
    file.unlink()
    assert run(["poses", str(folder), "--out", str(file)]) == OK
    assert run(["poses", str(folder), "--out", str(file), "--overwrite"]) == OK
    assert np.load(file).shape == (COUNT, 4, 4)


def test_poses_does_not_overwrite_folder(clip, capsys, tmp_path):
    assert run(["poses", str(clip()), "--out", str(tmp_path), "--overwrite"]) == BAD_INPUT
    assert "does not end in .npy" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("recording", "file", "said"),
    [
        ("clip", "nowhere/poses.npy", "there is no folder"),
        ("missing", "poses.npy", "there is no such file or folder"),
        ("few", "poses.npy", "at least 3 frames, got 2"),
    ],
)
def test_poses_prints_error_for_invalid_input(clip, capsys, tmp_path, recording, file, said):
    folder = clip()
    options = ["--max-frames", "2"] if recording == "few" else []
    given = folder if recording == "few" else tmp_path / recording
    assert run(["poses", str(given), "--out", str(tmp_path / file), *options]) == BAD_INPUT
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error
    assert not (tmp_path / file).exists()
