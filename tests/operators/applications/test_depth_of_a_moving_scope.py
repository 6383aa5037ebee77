"""A moving scope without depth, run as a user runs it: who looks for parallax when nothing is asked for, and in which frames."""

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
def asked(monkeypatch):
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


def test_replay_finds_it_by_parallax_unless_something_else_is_asked_for(settings, asked):
    outcome = replay(settings)
    found = depth_of(outcome)
    assert set(found.frames) == {"parallax"} and found.frames["parallax"] >= 1
    assert found.known_share > 0.5 and not found.metric
    assert asked == list(range(COUNT))
    assert any("depth was estimated" in note and "its unit is not known" in note for note in outcome.notes)


@pytest.mark.slow
@pytest.mark.parametrize("depth", ["recorded", "none", "stereo"])
def test_replay_looks_for_none_where_something_else_is_asked_for(settings, asked, depth):
    assert depth_of(replay(replace(settings, depth=depth))).frames == {}
    assert asked == []


def test_held_out_frames_take_no_part(settings, asked):
    found = depth_of(replay(replace(settings, heldout=True)))
    assert asked == [number for number in range(COUNT) if not is_heldout(number)] and len(asked) < COUNT
    assert found.frames["parallax"] >= 1


@pytest.mark.slow
def test_showing_a_finished_model_looks_for_none(settings, asked):
    """Offline, training has found it before, in all frames at once."""
    outcome = reconstruct(settings, steps=2)
    assert depth_of(outcome).frames == {} and not any("interrupted" in note for note in outcome.notes)
    assert asked == []
