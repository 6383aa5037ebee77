"""Points of a stream are followed on small pictures, off tools, and keep their numbers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.geometry import tracks
from gsplat_core.geometry.tracks import (
    SIDE_PX,
    STREAM_POINTS,
    SmallPicture,
    SmallPictures,
    StreamTracks,
    found_again,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

CAMERA = Camera.from_focal(150.0, 160, 120)


def textured(seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return np.kron(random.integers(30, 220, (32, 40, 3)), np.ones((7, 7, 1))).astype(np.uint8)


def frame(shift: int = 0, seed: int = 0, **fields) -> Frame:
    return Frame(shift, shift, np.ascontiguousarray(textured(seed)[10:130, 40 - 2 * shift : 200 - 2 * shift]), **fields)


def begun(pictures: SmallPictures, **fields) -> StreamTracks:
    tracks = StreamTracks()
    tracks.begin(pictures.of(frame(**fields)))
    tracks.take_up()
    return tracks


def test_stream_tracks_follow_shift_and_keep_numbers():
    pictures = SmallPictures(CAMERA)
    tracks = begun(pictures)
    start, numbers = tracks.pixels.copy(), tracks.numbers.copy()
    assert 20 < len(numbers) <= STREAM_POINTS
    for shift in (1, 2, 3):
        picture = pictures.of(frame(shift))
        tracks.go_on(picture, *tracks.follow(picture, tracks.pixels))
    kept = np.isin(numbers, tracks.numbers)
    assert kept.mean() > 0.7
    np.testing.assert_allclose(tracks.pixels - start[kept], np.tile([6.0, 0.0], (kept.sum(), 1)), atol=0.3)
    np.testing.assert_array_equal(tracks.first, start[kept])


def test_stream_tracks_exclude_tools_and_highlights():
    mask = np.ones((120, 160), np.uint8)
    mask[:, 100:] = 0
    tracks = begun(SmallPictures(CAMERA), mask=mask)
    assert len(tracks.numbers) > 5
    assert tracks.pixels[:, 0].max() < 100 - 8
    image = np.full((120, 160, 3), (150, 70, 60), np.uint8)
    image[60:66, 40:46] = 255
    usable = SmallPictures(CAMERA).of(Frame(0, 0, image)).usable
    assert not usable[60:66, 40:46].any() and usable[30:50, 30:60].all()


def test_small_pictures_keep_rays():
    camera = Camera.from_focal(600.0, 640, 480)
    picture = SmallPictures(camera).of(Frame(0, 0, np.zeros((480, 640, 3), np.uint8)))
    assert picture.grey.shape == (240, SIDE_PX)
    corner = np.array([[639.5, 479.5]])
    expected = (corner - camera.K[:2, 2]) / 600
    np.testing.assert_allclose(picture.rays((corner / 2 - 0.5).astype(np.float32)), expected, rtol=1e-6)
    local = np.array([[0.1, 0.2, 2.0]])
    np.testing.assert_allclose(picture.rays(picture.pixels(local)), local[:, :2] / 2, atol=1e-5)


def test_stream_tracks_follow_nothing_in_picture_of_other_size():
    pictures = SmallPictures(CAMERA)
    tracks = begun(pictures)
    numbers, pixels = tracks.follow(pictures.of(Frame(1, 1, textured()[:100, :100].copy())), tracks.pixels)
    assert len(numbers) == len(pixels) == 0 < len(tracks.numbers)


def test_stream_tracks_adopt_replaces_points_in_place():
    tracks = begun(SmallPictures(CAMERA))
    count = len(tracks.numbers)
    later = tracks.numbers[5:].copy()
    tracks.keep(np.arange(count) >= 5)
    tracks.adopt(np.array([0, 2]), tracks.pixels[[3, 7]] + np.float32(1))
    assert np.array_equal(tracks.numbers, np.sort(tracks.numbers)) and {0, 2} <= set(tracks.numbers)
    assert len(tracks.numbers) == len(later) == len(tracks.pixels) == len(tracks.first)
    new = tracks.take_up()
    assert not len(new) or new.min() >= count, "numbers are not given twice"


def wide(seed: int = 0) -> Frame:
    cells = np.random.default_rng(seed).uniform(20, 235, (64, 80, 3)).astype(np.float32)
    image = np.clip(cv2.resize(cells, (320, 256), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)
    return Frame(0, 0, image)


WIDE = Camera.from_focal(300.0, 320, 256)


def test_stream_tracks_point_count_spacing_and_border():
    tracks = StreamTracks()
    tracks.begin(SmallPictures(WIDE).of(wide()))
    assert len(tracks.take_up()) == len(tracks.numbers) == 220
    apart = np.linalg.norm(tracks.pixels[:, None] - tracks.pixels[None], axis=2) + 999 * np.eye(220)
    assert 10 <= apart.min() < 11.5
    assert tracks.pixels.min() >= 6 and tracks.pixels.max(0).tolist() <= [313, 249]


def test_stream_tracks_replace_points_if_a_tenth_is_missing():
    tracks = StreamTracks()
    tracks.begin(SmallPictures(WIDE).of(wide()))
    tracks.take_up()
    tracks.keep(np.arange(220) >= 21)
    assert len(tracks.take_up()) == 0 and len(tracks.numbers) == 199
    tracks.keep(np.arange(199) >= 1)
    new = tracks.take_up()
    assert len(new) > 0 and new.min() == 220
    assert np.array_equal(tracks.numbers, np.sort(tracks.numbers))


def test_stream_tracks_take_up_nothing_before_first_picture():
    tracks = StreamTracks()
    assert len(tracks.take_up()) == 0 and tracks.picture is None


def test_small_picture_shows_by_nearest_usable_pixel():
    usable = np.zeros((20, 30), np.uint8)
    usable[0, 0] = usable[19, 29] = usable[7, 11] = 255
    picture = SmallPicture(np.zeros((20, 30), np.uint8), usable, WIDE.resized(30, 20))
    pixels = np.array(
        [[0, 0], [-0.4, 0.4], [-0.6, 0], [29.4, 19.4], [29.6, 19], [29, 19.6], [11.3, 6.8], [12.6, 7], [np.nan, 0]]
    )
    shown = picture.shows(pixels.astype(np.float32))
    assert shown.tolist() == [True, True, False, True, False, False, True, False, False]


def test_small_picture_pixels_of_points_behind_camera_are_far_outside():
    picture = SmallPictures(WIDE).of(wide())
    pixels = picture.pixels(np.array([[0.0, 0.0, 5.0], [1.0, -1.0, -2.0], [0.1, 0.2, 2.0]]))
    np.testing.assert_allclose(pixels[0], [159.5, 127.5])
    np.testing.assert_allclose(pixels[1], [1e4, -1e4])
    np.testing.assert_allclose(pixels[2], [159.5 + 15, 127.5 + 30])


def test_small_picture_usable_margin_from_tools():
    mask = np.ones((256, 320), np.uint8)
    mask[:, 200:] = 0
    picture = SmallPictures(WIDE).of(wide().with_fields(mask=mask))
    assert picture.grey.shape == (256, 320)
    columns = np.flatnonzero(picture.usable[128])
    assert (columns.min(), columns.max()) == (6, 199 - 8)
    rows = np.flatnonzero(picture.usable[:, 100])
    assert (rows.min(), rows.max()) == (6, 249)


def test_found_again_trusts_points_returning_within_half_a_pixel():
    pictures = SmallPictures(WIDE)
    first = pictures.of(wide(1))
    moved = np.roll(wide(1).image, (3, 4), (0, 1))
    moved[:, 200:] = wide(2).image[:, 200:]
    second = pictures.of(Frame(1, 1, np.ascontiguousarray(moved)))
    points = np.array([[60, 60], [150, 200], [270, 100]], np.float32)
    there, trusted = found_again(first, second, points, points)
    assert trusted.tolist() == [True, True, False]
    np.testing.assert_allclose(there[:2], points[:2] + [4, 3], atol=0.05)


def test_stream_tracks_adopt_replaces_points_within_three_pixels():
    tracks = StreamTracks()
    tracks.begin(SmallPictures(WIDE).of(wide()))
    tracks.take_up()
    at = tracks.pixels[[10, 50]].copy()
    tracks.keep(np.arange(220) >= 5)
    tracks.adopt(np.array([0, 3]), (at + [[2.5, 0], [0, 3.5]]).astype(np.float32))
    assert 10 not in tracks.numbers and 50 in tracks.numbers and {0, 3} <= set(tracks.numbers)
    np.testing.assert_allclose(tracks.first[:2], at + [[2.5, 0], [0, 3.5]])


def test_stream_tracks_begin_clears_points():
    tracks = begun(SmallPictures(CAMERA))
    last = tracks.numbers.max()
    tracks.begin(SmallPictures(CAMERA).of(frame(seed=1)))
    assert len(tracks.numbers) == len(tracks.pixels) == len(tracks.first) == 0
    assert tracks.take_up().min() == last + 1


@pytest.mark.parametrize(("misses_px", "is_trusted"), [(0.49, True), (0.51, False), (np.inf, False)])
def test_found_again_threshold_is_half_a_pixel(monkeypatch, misses_px, is_trusted):
    picture = SmallPictures(WIDE).of(wide(1))
    points = np.array([[60, 60]], np.float32)
    monkeypatch.setattr(tracks, "followed", lambda *_, **__: (points + 1, np.array([misses_px])))
    there, trusted = found_again(picture, picture, points, points)
    assert trusted.tolist() == [is_trusted] and there.tolist() == [[61, 61]]
