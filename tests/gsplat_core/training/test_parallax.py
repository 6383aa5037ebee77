"""Selection of frames that get depth from the camera's motion, and of recordings that get none."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth import multiview
from gsplat_core.depth.multiview import ParallaxDepth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, DEPTH_ORIGINS
from gsplat_core.training.observations import Observation
from gsplat_core.training.offline import to_fit
from tests.gsplat_core.geometry.moving_scope import (
    FIRST,
    HEIGHT,
    SIDEWAYS,
    WIDTH,
    camera_at,
    depth_of_surface,
    video,
)


@pytest.mark.slow
def test_every_frame_of_short_recording_gets_parallax_depth() -> None:
    frames, cameras = video(6, SIDEWAYS)
    given, doubts, at_rest = ParallaxDepth().of_recording(frames, cameras)
    assert not doubts
    assert at_rest
    for frame in given:
        assert frame.depth is not None
        assert frame.depth_confidence is not None
        assert frame.depth_origin is DEPTH_ORIGINS["parallax"]
        # Also where it is not believed there is something to start from.
        assert (frame.depth > 0).all()
    assert np.median(np.abs(given[0].depth / depth_of_surface() - 1)) < 0.02


@pytest.mark.slow
def test_depth_loss_uses_confident_depth_only() -> None:
    frames, cameras = video(6, SIDEWAYS)
    frame = ParallaxDepth().of_recording(frames, cameras).frames[0]
    assert frame.depth is not None
    assert frame.depth_confidence is not None
    learned = Observation.of(frame, cameras[0]).depth
    assert learned is not None
    np.testing.assert_array_equal(learned.numpy() > 0, frame.depth_confidence >= BELIEVED)
    assert 0 < int((learned == 0).sum()) < learned.numel()


@pytest.mark.slow
def test_key_frames_are_spread_over_long_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multiview, "MOST_OFFLINE", 3)
    frames, cameras = video(9, SIDEWAYS)
    given = ParallaxDepth().of_recording(frames, cameras).frames
    assert [number for number, frame in enumerate(given) if frame.depth is not None] == [0, 4, 8]


def test_frames_more_than_longest_s_apart_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multiview, "LONGEST_S", 0.05)
    frames, cameras = video(6, SIDEWAYS)
    apart = [frame.with_fields(pts_ns=number * 100_000_000) for number, frame in enumerate(frames)]
    given, doubts, _ = ParallaxDepth().of_recording(apart, cameras)
    assert doubts == {"the scope does not move": 6}
    assert all(frame.depth is None for frame in given)


def test_wrong_poses_are_counted_as_doubts() -> None:
    frames, _ = video(6, SIDEWAYS)
    given, doubts, _ = ParallaxDepth().of_recording(
        frames, [camera_at((0.0, 0.02 * number, 0.0)) for number in range(6)]
    )
    assert all(frame.depth is None for frame in given)
    assert sum(doubts.values()) == 6
    assert any("poses" in doubt for doubt in doubts)


def test_frames_with_static_camera_depth_or_other_projection_stay_unchanged() -> None:
    frames, cameras = video(4, SIDEWAYS)
    assert ParallaxDepth().of_recording(frames, [FIRST] * 4) == (frames, {}, False)
    known = [frames[0].with_fields(depth=depth_of_surface()), *frames[1:]]
    assert ParallaxDepth().of_recording(known, cameras) == (known, {}, False)
    for model in ("fisheye", "ortho"):
        others = [Camera(each.K, WIDTH, HEIGHT, each.world_to_camera, model) for each in cameras]  # type: ignore[arg-type]
        assert ParallaxDepth().of_recording(frames, others) == (frames, {}, False)


def test_stereo_depth_is_smoothed_to_surface_before_training() -> None:
    frames, cameras = video(2, SIDEWAYS)
    true = depth_of_surface()
    noise_px = 0.1 * np.random.default_rng(0).standard_normal(true.shape)
    focal_px = float(cameras[0].K[0, 0])  # without a calibration the eyes are one unit apart
    sure = np.full(true.shape, 0.8, np.float32)
    depth = (focal_px / (focal_px / true + noise_px)).astype(np.float32)
    frames = [
        frame.with_fields(depth=depth, depth_confidence=sure, depth_origin=DEPTH_ORIGINS["stereo"]) for frame in frames
    ]
    found = to_fit(list(frames), lambda frame: Observation.of(frame, cameras[0]), depth=None)
    for frame, one in zip(found.frames, found.seen, strict=True):
        assert frame.depth is not None and one.depth is not None
        learned = one.depth.numpy()
        assert np.array_equal(learned, np.where(learned > 0, frame.depth, 0)) and (learned > 0).mean() > 0.8
        off, before = np.std(frame.depth / true - 1), np.std(depth / true - 1)
        assert off < 0.5 * before
    measured = [frame.with_fields(depth_origin=DEPTH_ORIGINS["measured"]) for frame in frames]
    as_it_was = to_fit(list(measured), lambda frame: Observation.of(frame, cameras[0]), depth=None)
    assert all(frame.depth is depth for frame in as_it_was.frames)
