"""Points of a stream are followed on small pictures, off tools, and keep their numbers."""

from __future__ import annotations

import numpy as np

from gsplat_core.geometry.stream_tracks import MOST_POINTS, SIDE_PX, SmallPictures, StreamTracks
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


def test_points_follow_a_shifted_picture_and_keep_their_numbers():
    pictures = SmallPictures(CAMERA)
    tracks = begun(pictures)
    start, numbers = tracks.pixels.copy(), tracks.numbers.copy()
    assert 20 < len(numbers) <= MOST_POINTS
    for shift in (1, 2, 3):
        picture = pictures.of(frame(shift))
        tracks.go_on(picture, *tracks.follow(picture, tracks.pixels))
    kept = np.isin(numbers, tracks.numbers)
    assert kept.mean() > 0.7
    np.testing.assert_allclose(tracks.pixels - start[kept], np.tile([6.0, 0.0], (kept.sum(), 1)), atol=0.3)
    np.testing.assert_array_equal(tracks.first, start[kept])


def test_nothing_is_followed_on_a_tool_or_a_highlight():
    mask, rehearsal_mask = np.ones((120, 160), np.uint8), np.ones((120, 160), np.uint8)
    mask[:, 100:] = 0
    rehearsal_mask[60:] = 0
    tracks = begun(SmallPictures(CAMERA), mask=mask, rehearsal_mask=rehearsal_mask)
    assert len(tracks.numbers) > 5
    assert tracks.pixels[:, 0].max() < 100 - 8 and tracks.pixels[:, 1].max() < 60 - 8


def test_large_pictures_are_followed_small_and_rays_stay():
    camera = Camera.from_focal(600.0, 640, 480)
    picture = SmallPictures(camera).of(Frame(0, 0, np.zeros((480, 640, 3), np.uint8)))
    assert picture.grey.shape == (240, SIDE_PX)
    corner = np.array([[639.5, 479.5]])
    expected = (corner - camera.K[:2, 2]) / 600
    np.testing.assert_allclose(picture.rays((corner / 2 - 0.5).astype(np.float32)), expected, rtol=1e-6)
    local = np.array([[0.1, 0.2, 2.0]])
    np.testing.assert_allclose(picture.rays(picture.pixels(local)), local[:, :2] / 2, atol=1e-5)


def test_a_picture_of_another_size_shows_none_of_the_points():
    pictures = SmallPictures(CAMERA)
    tracks = begun(pictures)
    numbers, pixels = tracks.follow(pictures.of(Frame(1, 1, textured()[:100, :100].copy())), tracks.pixels)
    assert len(numbers) == len(pixels) == 0 < len(tracks.numbers)


def test_points_that_are_known_again_take_the_place_of_those_that_are_there():
    tracks = begun(SmallPictures(CAMERA))
    count = len(tracks.numbers)
    later = tracks.numbers[5:].copy()
    tracks.keep(np.arange(count) >= 5)
    tracks.adopt(np.array([0, 2]), tracks.pixels[[3, 7]] + np.float32(1))
    assert np.array_equal(tracks.numbers, np.sort(tracks.numbers)) and {0, 2} <= set(tracks.numbers)
    assert len(tracks.numbers) == len(later) == len(tracks.pixels) == len(tracks.first)
    new = tracks.take_up()
    assert not len(new) or new.min() >= count, "numbers are not given twice"
