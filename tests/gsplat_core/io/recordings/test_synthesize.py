"""Synthetic recordings: what is written, read back through the ordinary reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording, synthesize, validate_recording
from gsplat_core.io.recordings.synthetic.scene import Extras


def _bytes(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_synthesized_recording_opens_without_notes(synthetic_folder: Path) -> None:
    recording = open_recording(synthetic_folder)
    assert recording.notes == ()
    assert (recording.frame_count, recording.width_px, recording.height_px, recording.fps) == (4, 96, 80, 3)
    assert recording.fields == {"mask", "pose", "depth", "right_image"}
    assert recording.stereo_baseline_mm == 4.4
    report = validate_recording(synthetic_folder)
    assert report.ok and not report.warnings
    assert report.facts["camera_moves"] is True
    share = report.facts["tool_share"]
    assert isinstance(share, float) and 0.02 < share < 0.4  # a tool is there, and the masks are the right way round


@pytest.mark.slow
def test_synthesize_with_same_arguments_gives_same_bytes(tmp_path: Path) -> None:
    arguments = {"frames": 2, "width_px": 48, "height_px": 40, "fps": 2, "seed": 11}
    first = _bytes(synthesize(tmp_path / "a", **arguments))
    assert first == _bytes(synthesize(tmp_path / "b", **arguments))
    other = _bytes(synthesize(tmp_path / "c", **{**arguments, "seed": 12}))
    assert first.keys() == other.keys()
    assert first["images/frame-000000.color.png"] != other["images/frame-000000.color.png"]


def test_synthesize_fixed_camera_without_stereo(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    folder = synthesize(
        tmp_path / "x", frames=2, width_px=48, height_px=40, stereo=False, progress=lambda *at: done.append(at)
    )
    recording = open_recording(folder)
    assert recording.fields == {"mask", "pose", "depth"} and recording.stereo_baseline_mm is None
    assert all(np.array_equal(frame.pose, np.eye(4)) for frame in recording)
    assert done == [(1, 2), (2, 2)]
    assert [entry.name for entry in tmp_path.iterdir()] == ["x"]  # nothing half-written stays


def test_synthesize_description_lists_ground_truth(synthetic_folder: Path) -> None:
    content = json.loads((synthetic_folder / "recording.json").read_text())
    assert content["depth_unit_mm"] == 0.01 and content["units"] == "mm" and content["seed"] == 5
    assert set(content["ground_truth"]) == {
        "images",
        "images_right",
        "masks",
        "depth",
        "poses_bounds.npy",
        "tracks.npy",
    }


@pytest.mark.slow
def test_synthesize_overwrites_only_own_folder(tmp_path: Path) -> None:
    arguments = {"width_px": 48, "height_px": 40, "stereo": False}
    folder = synthesize(tmp_path / "x", frames=2, **arguments)
    assert open_recording(synthesize(folder, frames=1, **arguments)).frame_count == 1
    (folder / "thesis.txt").write_text("mine")
    with pytest.raises(InvalidSetting, match="holds what synthesize did not write"):
        synthesize(folder, frames=1, **arguments)
    assert (folder / "thesis.txt").read_text() == "mine"
    with pytest.raises(InvalidSetting, match="is a file"):
        synthesize(folder / "thesis.txt", frames=1, **arguments)


def test_synthesize_overwrites_recording_with_every_extra(tmp_path: Path) -> None:
    extras = Extras(third=True, flow=True, tracks=True, behind=True, depth_noise_mm=0.1)
    arguments = {"frames": 1, "width_px": 32, "height_px": 32, "extras": extras}
    first = _bytes(synthesize(tmp_path / "x", **arguments))
    assert any(name.startswith("behind/depth/") for name in first)
    assert _bytes(synthesize(tmp_path / "x", **arguments)) == first


def test_interrupted_synthesize_leaves_no_files(tmp_path: Path) -> None:
    def stop(done: int, frames: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize(tmp_path / "x", frames=20, width_px=48, height_px=40, progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments", [{"frames": 0}, {"width_px": 8}, {"fps": 0}, {"seed": -1}, {"camera": "flying"}, {"height_px": 10**6}]
)
def test_synthesize_refuses_arguments_out_of_range(tmp_path: Path, arguments: dict) -> None:
    with pytest.raises(InvalidSetting, match=str(next(iter(arguments.values())))):
        synthesize(tmp_path / "x", **arguments)
    assert list(tmp_path.iterdir()) == []
