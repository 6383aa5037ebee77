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
def test_parallax_is_looked_for_by_itself_only_where_there_is_time(stream):
    """A camera that has to be kept up with gets none."""
    assert origins(DepthFinder("auto", FIRST, has_time=True), stream) == {None, DEPTH_ORIGINS["parallax"]}
    assert origins(DepthFinder("auto", FIRST), stream) == {None}
    assert origins(DepthFinder("parallax", FIRST), stream) == {None, DEPTH_ORIGINS["parallax"]}


def test_nothing_is_learned_from_frames_that_are_only_shown(stream):
    finder = DepthFinder("auto", FIRST, has_time=True)
    assert all(finder.find(frame, shown_only=True) is None for frame in stream[:-1])
    assert finder.find(stream[-1]) is None, "no key frame came before"


def test_depth_that_a_frame_came_with_is_taken_first(stream):
    measured = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    given = [frame.with_fields(depth=measured, depth_origin=DEPTH_ORIGINS["measured"]) for frame in stream]
    finder = DepthFinder("auto", FIRST, has_time=True)
    assert all(finder.with_depth(frame) is frame for frame in given)
    assert finder.with_depth(given[0], shown_only=True) is given[0]


def test_a_stream_that_changes_its_size_keeps_its_camera(stream, monkeypatch):
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


def test_another_name_is_refused():
    with pytest.raises(InvalidSetting, match="depth is 'sonar'; choose auto, recorded"):
        DepthFinder("sonar", FIRST)


def test_a_sentence_is_kept_once_whatever_its_numbers():
    said = Sentences()
    for sentence in ("rows are off: 2.1 px", None, "rows are off: 1.4 px", "too little texture"):
        said.add(sentence)
    assert said.counted() == {"rows are off: 2.1 px": 2, "too little texture": 1}
