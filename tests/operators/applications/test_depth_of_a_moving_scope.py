"""Depth by parallax for a moving scope without recorded depth: in which runs and in which frames."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gsplat_core.depth import maps
from gsplat_core.depth.multiview import ParallaxDepth
from gsplat_core.io.recordings import is_heldout
from gsplat_core.io.recordings.calibration import write_poses
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings, replay
from operators.applications.session import RunOutcome
from operators.depth import FoundDepth
from tests.gsplat_core.geometry.moving_scope import FOCAL, HEIGHT, SIDEWAYS, WIDTH, video

COUNT = 12


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Pictures of a scope that moves sideways, with its poses and its camera, and without depth."""
    folder = tmp_path_factory.mktemp("clip")
    frames, cameras = video(COUNT, SIDEWAYS)
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number}.png"), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    write_poses(folder / "poses.npy", np.stack([camera.world_to_camera for camera in cameras]))
    camera = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    described = {"format": "intrasplat-recording", "version": 1, "fps": 30, "camera": camera}
    (folder / "recording.json").write_text(json.dumps(described))
    return folder


@pytest.fixture
def settings(clip, tmp_path):
    # The texture of the clip does not look like tissue.
    checks = {"tool_mask": "none", "out_of_body": "off"}
    return ReplaySettings(recording=clip, out=tmp_path / "out", steps_per_frame=1, sinks=(), **checks)


@pytest.fixture
def parallax_frames(monkeypatch):
    """Numbers of the frames in which parallax was looked for while the run went on."""
    numbers = []

    class Watched(ParallaxDepth):
        def estimate(self, frame, camera):
            numbers.append(frame.seq)
            return super().estimate(frame, camera)

    others = {name: maps.DEPTHS[name] for name in maps.DEPTHS if name != "parallax"}
    monkeypatch.setattr(maps, "DEPTHS", {**others, "parallax": Watched})
    return numbers


def depth_of(outcome: RunOutcome) -> FoundDepth:
    found = outcome.find(FoundDepth)
    assert found is not None
    return found


def test_replay_estimates_depth_by_parallax_by_default(settings, parallax_frames):
    outcome = replay(settings)
    found = depth_of(outcome)
    assert set(found.frames) == {"parallax"} and found.frames["parallax"] >= 1
    assert found.known_share > 0.5 and not found.metric
    assert parallax_frames == list(range(COUNT))
    assert any("depth was estimated" in note and "its unit is not known" in note for note in outcome.notes)


@pytest.mark.slow
@pytest.mark.parametrize("depth", ["recorded", "none", "stereo"])
def test_replay_skips_parallax_depth_for_other_depth_settings(settings, parallax_frames, depth):
    assert depth_of(replay(replace(settings, depth=depth))).frames == {}
    assert parallax_frames == []


def test_parallax_depth_skips_heldout_frames(settings, parallax_frames):
    found = depth_of(replay(replace(settings, heldout=True)))
    assert (
        parallax_frames == [number for number in range(COUNT) if not is_heldout(number)]
        and len(parallax_frames) < COUNT
    )
    assert found.frames["parallax"] >= 1


@pytest.mark.slow
def test_offline_reconstruction_skips_live_parallax_depth(settings, parallax_frames):
    """Offline training estimates depth by parallax in all frames before the run."""
    outcome = reconstruct(settings, steps=2)
    assert depth_of(outcome).frames == {} and not any("interrupted" in note for note in outcome.notes)
    assert parallax_frames == []
