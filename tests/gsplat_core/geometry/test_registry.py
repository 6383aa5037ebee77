"""Choice of the depth estimator of a stream, and of the frames that it processes."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth import maps
from gsplat_core.depth.maps import DepthFinder, Sentences
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthOrigin, Frame
from tests.gsplat_core.geometry.moving_scope import FIRST, HEIGHT, SIDEWAYS, WIDTH, video

FRAME_NS = 33_333_333


@pytest.fixture(scope="module")
def stream() -> list[Frame]:
    """A moving scope with poses and without depth."""
    frames, cameras = video(16, SIDEWAYS)
    return [
        frame.with_fields(seq=number, pts_ns=number * FRAME_NS, pose=camera.world_to_camera)
        for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True))
    ]


def origins(finder: DepthFinder, frames: list[Frame]) -> set[DepthOrigin | None]:
    return {finder.with_depth(frame).depth_origin for frame in frames}


@pytest.mark.slow
def test_auto_depth_uses_parallax_only_with_time(stream):
    """A camera that has to be kept up with gets none."""
    assert origins(DepthFinder("auto", FIRST, has_time=True), stream) == {None, DEPTH_ORIGINS["parallax"]}
    assert origins(DepthFinder("auto", FIRST), stream) == {None}
    assert origins(DepthFinder("parallax", FIRST), stream) == {None, DEPTH_ORIGINS["parallax"]}


def test_depth_finder_ignores_frames_only_shown(stream):
    finder = DepthFinder("auto", FIRST, has_time=True)
    assert all(finder.find(frame, shown_only=True) is None for frame in stream[:-1])
    assert finder.find(stream[-1]) is None, "no key frame came before"


def test_depth_finder_prefers_recorded_depth(stream):
    measured = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    given = [frame.with_fields(depth=measured, depth_origin=DEPTH_ORIGINS["measured"]) for frame in stream]
    finder = DepthFinder("auto", FIRST, has_time=True)
    assert all(finder.with_depth(frame) is frame for frame in given)
    assert finder.with_depth(given[0], shown_only=True) is given[0]


def test_depth_finder_resizes_camera_to_frame(stream, monkeypatch):
    asked = []

    class Watched:
        def estimate(self, frame, camera):
            asked.append(camera)

    monkeypatch.setattr(maps, "DEPTHS", {"light": Watched})
    half = stream[1].with_fields(image=np.ascontiguousarray(stream[1].image[::2, ::2]))
    finder = DepthFinder("light", FIRST)
    for frame in (stream[1], half):
        assert finder.find(frame) is None
    assert asked == [(at := FIRST.with_pose(stream[1].pose)), at.resized(WIDTH // 2, HEIGHT // 2)]


def test_depth_finder_refuses_unknown_estimator():
    with pytest.raises(InvalidSetting, match="depth is 'sonar'; choose auto, recorded"):
        DepthFinder("sonar", FIRST)


def test_sentences_are_counted_regardless_of_numbers():
    said = Sentences()
    for sentence in ("rows are off: 2.1 px", None, "rows are off: 1.4 px", "too little texture"):
        said.add(sentence)
    assert said.counted() == {"rows are off: 2.1 px": 2, "too little texture": 1}
