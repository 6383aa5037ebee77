"""Depth of a stream, found against key frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.depth.maps import DEPTHS, DepthMap
from gsplat_core.depth.multiview import MOST_KEY_FRAMES, ParallaxDepth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame
from tests.gsplat_core.geometry.moving_scope import FIRST, HEIGHT, SIDEWAYS, WIDTH, camera_at, video

FRAME_NS = 33_333_333


def stream(count: int, step: tuple[float, float, float] = SIDEWAYS) -> list[Frame]:
    frames, cameras = video(count, step)
    return [
        frame.with_fields(seq=number, pts_ns=number * FRAME_NS, pose=camera.world_to_camera)
        for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True))
    ]


def answers(estimator: ParallaxDepth, frames: list[Frame]) -> list[DepthMap | None]:
    return [estimator.estimate(frame, FIRST if frame.pose is None else FIRST.with_pose(frame.pose)) for frame in frames]


def median_depth(found: DepthMap | None) -> float:
    assert found is not None
    assert found.doubt is None
    return float(np.median(found.depth[found.confidence >= BELIEVED]))


def test_parallax_estimator_is_registered_by_name() -> None:
    assert isinstance(DEPTHS["parallax"](), ParallaxDepth)


@pytest.mark.slow
def test_stream_depth_starts_with_second_agreeing_map_then_periodically() -> None:
    found = answers(ParallaxDepth(), stream(20))
    known = [number for number, each in enumerate(found) if each is not None and each.doubt is None]
    assert found[0] is None
    assert 6 <= known[0] <= 9
    assert all(later - earlier >= 6 for earlier, later in pairwise(known))
    assert len(known) >= 2
    assert all(1.5 < median_depth(found[number]) < 2.1 for number in known)


@pytest.mark.slow
def test_key_frames_of_stream_are_bounded() -> None:
    estimator = ParallaxDepth()
    answers(estimator, stream(30, (0.006, 0.0, 0.0)))
    assert len(estimator._kept) == MOST_KEY_FRAMES
    places = sorted(float(view.camera.position[0]) for _, view in estimator._kept)
    assert places[-1] - places[0] > 0.1


def test_old_key_frames_are_dropped() -> None:
    estimator = ParallaxDepth()
    frames = stream(4)
    answers(estimator, frames)
    late = frames[3].with_fields(seq=9, pts_ns=10_000_000_000, pose=camera_at((0.2, 0.0, 0.0)).world_to_camera)
    assert answers(estimator, [late]) == [None]
    assert len(estimator._kept) == 1


def test_new_scene_drops_key_frames() -> None:
    estimator = ParallaxDepth()
    frames = stream(6)
    answers(estimator, frames[:5])
    assert answers(estimator, [frames[5].with_fields(new_scene="cut")]) == [None]
    assert len(estimator._kept) == 1


def test_frames_without_pose_or_of_other_projection_get_no_depth() -> None:
    frames = stream(4)
    assert answers(ParallaxDepth(), [frame.with_fields(pose=None) for frame in frames]) == [None] * 4
    fisheye = Camera(FIRST.K, WIDTH, HEIGHT, model="fisheye")
    estimator = ParallaxDepth()
    assert [estimator.estimate(frame, fisheye) for frame in frames] == [None] * 4


def test_still_scope_gets_no_depth() -> None:
    still = [frame.with_fields(pose=np.eye(4)) for frame in stream(5, (0.0, 0.0, 0.0))]
    assert answers(ParallaxDepth(), still) == [None] * 5


def test_depth_by_wrong_poses_is_doubted() -> None:
    def across(pose: NDArray[np.float64] | None) -> NDArray[np.float64]:
        assert pose is not None
        turned = pose.copy()
        turned[:3, 3] = pose[[1, 0, 2], 3]
        return turned

    found = answers(ParallaxDepth(), [frame.with_fields(pose=across(frame.pose)) for frame in stream(8)])
    assert any(each is not None for each in found)
    assert all(each is None or each.doubt is not None for each in found)


def test_same_stream_gives_same_bytes() -> None:
    first, again = (answers(ParallaxDepth(), stream(8)) for _ in range(2))
    assert [each and each.depth.tobytes() for each in first] == [each and each.depth.tobytes() for each in again]
