"""Limits of the odometry of a stream, with exact tracks of a flat scene in place of pictures."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.geometry.tracks import SmallPictures, StreamTracks
from gsplat_core.poses import live_odometry
from gsplat_core.poses.live_odometry import LiveOdometry, LocalMap, seen_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, RELATIVE_DISTANCE, Frame

CAMERA = Camera(np.array([[200.0, 0, 160], [0, 200, 128], [0, 0, 1]]), 320, 256)
GREY = np.full((256, 320, 3), 90, np.uint8)


class Stream:
    """Stream of a scope that slides along a plane with the unmeasured distance. Corners are at random pixels.

    Attributes:
        shift_px: by how far the scope has moved the scene in the current frame.
        off_px: errors [N, 2] of the tracks in the current frame.
        found: mask [N] of the corners that are found in it.
        guessed: start positions of the last tracking.
    """

    def __init__(self, count: int, patch: pytest.MonkeyPatch) -> None:
        self.at = np.random.default_rng(0).uniform([20, 20], [300, 236], (count, 2))
        self.shift_px, self.off_px, self.found = 0.0, np.zeros((count, 2)), np.ones(count, bool)
        self.guessed = self.at
        self.odometry, self.frames = LiveOdometry(CAMERA), 0

        def take_up(tracks):
            new = np.arange(0 if tracks._next else count)
            tracks._next = count
            tracks._add(new, self.at[new].astype(np.float32))
            return new

        def follow(tracks, picture, guess):
            kept = self.found[tracks.numbers]
            numbers = tracks.numbers[kept]
            self.guessed = guess
            return numbers, (self.at[numbers] + self.off_px[numbers] + [self.shift_px, 0]).astype(np.float32)

        patch.setattr(StreamTracks, "take_up", take_up)
        patch.setattr(StreamTracks, "follow", follow)

    def place(self, shift_px: float = 0.0) -> np.ndarray:
        self.shift_px = shift_px
        self.frames += 1
        return self.odometry.place(Frame(self.frames, 0, GREY))

    @property
    def keys(self) -> int:
        return len(self.odometry.map.keys)


def round_about(count: int, far_px: float) -> np.ndarray:
    """Return offsets to all sides [N, 2], which no motion of the scope explains."""
    angle = 2.399963 * np.arange(count)  # the golden angle
    return far_px * np.stack([np.cos(angle), np.sin(angle)], 1)


@pytest.mark.parametrize(("count", "begun"), [(19, 0), (20, 1)])
def test_live_odometry_starts_map_from_20_corners(count, begun, monkeypatch):
    stream = Stream(count, monkeypatch)
    stream.place()
    assert (stream.odometry.begun, stream.odometry.not_placed) == (begun, 1 - begun)


@pytest.mark.parametrize(("lost", "placed"), [(10, True), (11, False)])
def test_live_odometry_places_frame_from_20_points(lost, placed, monkeypatch):
    stream = Stream(30, monkeypatch)
    stream.place()
    stream.found[:lost] = False
    pose = stream.place(3.0)
    assert stream.odometry.not_placed == (not placed)
    assert pose[0, 3] == pytest.approx(3 / 200 * RELATIVE_DISTANCE if placed else 0, abs=1e-4)


@pytest.mark.parametrize(
    ("count", "wrong", "placed"), [(30, 10, True), (30, 11, False), (100, 58, True), (100, 63, False)]
)
def test_live_odometry_requires_20_points_and_40_percent_within_4_px(count, wrong, placed, monkeypatch):
    stream = Stream(count, monkeypatch)
    stream.place()
    stream.off_px[:wrong] = round_about(wrong, 6.0)
    stream.place()
    assert stream.odometry.not_placed == (not placed)


def test_live_odometry_drops_points_off_by_8_px(monkeypatch):
    stream = Stream(60, monkeypatch)
    stream.place()
    stream.off_px[:12] = np.repeat([3.7, 4.3, 7.6, 8.4], 3)[:, None] * round_about(12, 1.0)
    stream.place()
    assert stream.odometry.not_placed == 0
    assert np.array_equal(stream.odometry._tracks.numbers, np.r_[0:9, 12:60])
    few = Stream(23, monkeypatch)
    few.place()
    few.off_px[:3] = round_about(3, 3.7)
    few.place()
    assert few.odometry.not_placed == 0
    few.off_px[:4] = round_about(4, 4.4)
    few.place()
    assert few.odometry.not_placed == 1


def test_live_odometry_key_frame_spacing(monkeypatch):
    """Bundles are adjusted with every frame at first, and then in the two frames from a key frame on."""
    adjusted, grown = [], []
    stream = Stream(60, monkeypatch)
    monkeypatch.setattr(LocalMap, "adjust", lambda places: adjusted.append(number))
    way = [0.3 * number for number in range(11)] + [3.0 + 1.9 * number for number in range(1, 22)]
    for number, shift_px in enumerate(way):
        before = stream.keys
        pose = stream.place(shift_px)
        grown += [number] * (stream.keys - before)
        assert pose[0, 3] == pytest.approx(shift_px / 200 * RELATIVE_DISTANCE, abs=1e-3)
    assert grown == [0, 2, 4, 6, 8, 10, 19, 28]
    assert adjusted == [*range(1, 21), 28, 29]
    assert stream.odometry.explained > 0.999 and stream.odometry.not_placed == 0


@pytest.mark.parametrize(("left", "keys"), [(71, 1), (69, 2)])
def test_key_frame_is_added_below_70_percent_of_points(left, keys, monkeypatch):
    stream = Stream(100, monkeypatch)
    stream.place()
    stream.found[left:] = False
    stream.place()
    assert stream.keys == keys


@pytest.mark.parametrize(("off_px", "keys"), [(0.35, []), (0.45, [5, 10])])
def test_key_frame_is_added_every_five_frames_for_errors_above_0_4_px(off_px, keys, monkeypatch):
    stream, grown = Stream(100, monkeypatch), []
    monkeypatch.setattr(LocalMap, "adjust", lambda places: None)
    stream.place()
    stream.off_px[:] = round_about(100, off_px)
    for number in range(1, 12):
        before = stream.keys
        stream.place()
        grown += [number] * (stream.keys - before)
    assert grown == keys


def test_live_odometry_predicts_points_by_constant_motion(monkeypatch):
    stream = Stream(60, monkeypatch)
    for shift_px in (0.0, 3.0, 6.0):
        stream.place(shift_px)
    np.testing.assert_allclose(stream.guessed, stream.at + [6, 0], atol=0.05)
    stream.found[:] = False
    stream.place()
    stream.found[:] = True
    stream.place(6.0)
    np.testing.assert_allclose(stream.guessed, stream.at + [6, 0], atol=0.05, err_msg="the scope may have stopped")
    stream.place(8.0)
    np.testing.assert_allclose(stream.guessed, stream.at + [6, 0], atol=0.05, err_msg="the way before is unknown")


def test_live_odometry_explained_is_share_of_squared_motion(monkeypatch):
    """Points are off by 0.3 pixels to all sides, and the scope moves them by 2 pixels from where they were first."""
    stream = Stream(100, monkeypatch)
    monkeypatch.setattr(LocalMap, "adjust", lambda places: None)
    stream.place()
    stream.off_px[:] = round_about(100, 0.3)
    for _ in range(4):
        stream.place(2.0)
    assert stream.odometry.explained == pytest.approx(1 - (0.3 / 2) ** 2, abs=0.003)


def test_seen_depth_ignores_invalid_and_unconfident_depth():
    depth = np.full((256, 320), 50.0, np.float32)
    depth[10, 10:14] = [np.nan, np.inf, 0, -3]
    sure = np.full((256, 320), BELIEVED, np.float32)
    sure[20, 20] = BELIEVED - 0.01
    frame = Frame(0, 0, GREY, depth=depth, depth_confidence=sure)
    at = np.array([[10, 10], [11, 10], [12, 10], [13, 10], [20, 20], [21, 20]], np.float32)
    picture = SmallPictures(CAMERA).of(frame)
    assert seen_depth(frame, picture, at).tolist() == [0, 0, 0, 0, 0, 50]
    assert seen_depth(frame.with_fields(depth_confidence=None), picture, at)[4] == 50
    assert seen_depth(Frame(0, 0, GREY), picture, at).tolist() == [0] * 6


@pytest.mark.parametrize("size", [1, 2])
def test_seen_depth_of_right_eye_requires_same_row_and_return(monkeypatch, size):
    """A point 20 away is shifted by 40 pixels for a baseline of 4 and a focal length of 200 pixels."""
    misses = np.array([0.0, 0.45, 0.55, 0, 0, 0, 0, 0, 0], np.float32)
    shifts = np.array([[40, 0], [40, 0], [40, 0], [20, 1.4], [20, 1.6], [20, -1.6], [0.6, 0], [0.4, 0], [-9, 0]])
    at = np.full((9, 2), 100, np.float32)
    monkeypatch.setattr(live_odometry, "followed", lambda *_, **__: ((at - shifts).astype(np.float32), misses))
    pose = np.eye(4)
    pose[0, 3] = -4
    image = GREY.repeat(size, 0).repeat(size, 1)
    camera = CAMERA.scaled(size)
    frame = Frame(0, 0, image, right_image=image, right_camera=camera.with_pose(pose))
    depth = seen_depth(frame, SmallPictures(camera).of(frame), at)
    np.testing.assert_allclose(depth, [20, 20, 0, 40, 0, 0, 4 * 200 / 0.6, 0, 0], rtol=1e-4)
