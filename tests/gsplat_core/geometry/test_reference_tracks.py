"""Tracks by reference pictures: no drift, found again after being hidden, independent of brightness."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.geometry.tracks import (
    MOST_MISSES,
    Observations,
    ReferenceTracks,
    _Reference,
    _sampled,
    _usable,
    local_contrast,
)
from tests.gsplat_core.geometry.test_tracks import wide_texture

HEIGHT, WIDTH = 150, 200


def view(at: float, gain: float = 1.0, cell_px: int = 8) -> np.ndarray:
    """Return a picture of a texture, moved to the left by `at` pixels."""
    shift = np.array([[1, 0, -at - 20], [0, 1, -10]], np.float64)
    moved = cv2.warpAffine(wide_texture(0, cell_px), shift, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    return np.clip(gain * moved.astype(np.float64), 0, 255).astype(np.uint8)


def errors_of(tracks: ReferenceTracks, at: list[float]) -> np.ndarray:
    """Return the position errors of all observations relative to the first one of their point in pixels."""
    seen = tracks.observations(3)
    first = np.array([np.flatnonzero(seen.point == number)[0] for number in range(seen.point.max() + 1)])[seen.point]
    moved = -(np.array(at)[seen.frame] - np.array(at)[seen.frame[first]])
    expected = seen.pixels[first] + np.stack([moved, np.zeros_like(moved)], 1)
    return np.linalg.norm(seen.pixels - expected, axis=1)


def test_reference_tracks_do_not_drift():
    at = [12 * np.sin(0.37 * step) for step in range(60)]
    tracks = ReferenceTracks()
    for each in at:
        tracks.follow(view(each), None)
    errors = errors_of(tracks, at)
    late = tracks.observations(3).frame >= 40
    assert np.median(errors[late]) < 0.1 and np.median(errors[late]) < 3 * np.median(errors) + 0.02


def test_reference_tracks_tolerate_changing_exposure():
    at = [0.7 * step for step in range(15)]
    steady, changing = ReferenceTracks(), ReferenceTracks()
    for step, each in enumerate(at):
        steady.follow(view(each, 0.6), None)
        changing.follow(view(each, 0.6 * (1 + 0.5 * np.sin(step))), None)
    assert np.median(errors_of(changing, at)) < np.median(errors_of(steady, at)) + 0.05
    assert len(changing.observations().frame) > 0.8 * len(steady.observations().frame)


def test_reference_tracks_find_points_again_after_tool():
    tracks = ReferenceTracks()
    for step in range(9):
        mask = np.ones((HEIGHT, WIDTH), np.uint8)
        image = view(step)
        if 3 <= step < 6:
            mask[:, 60:130], image[:, 60:130] = 0, 40
        tracks.follow(image, mask)
    seen = tracks.observations(3)
    hidden = np.setdiff1d(seen.point[seen.frame == 2], seen.point[seen.frame == 4])
    assert len(hidden) > 5
    assert len(np.intersect1d(hidden, seen.point[seen.frame == 7])) > 0.7 * len(hidden)
    column = seen.pixels[seen.frame == 4][:, 0]
    assert not ((column > 60) & (column < 130)).any()


def test_reference_tracks_keep_five_references_20_pictures_apart():
    seen = followed_tracks(*[np.ascontiguousarray(view(0)[:70, :80])] * 102)
    first = np.full(seen.point.max() + 1, 999)
    np.minimum.at(first, seen.point, seen.frame)
    assert np.unique(first).tolist() == [0, 20, 40, 60, 80, 100]
    newest = seen.frame == 101
    assert np.unique(first[seen.point[newest]]).tolist() == [20, 40, 60, 80, 100]
    assert seen.frame[first[seen.point] == 0].max() == 100


def test_reference_tracks_start_new_points_in_other_scene():
    tracks = ReferenceTracks()
    other = np.ascontiguousarray(view(3)[::-1, ::-1])
    for _ in range(4):
        tracks.follow(view(0), None)
    for _ in range(MOST_MISSES + 6):
        tracks.follow(other, None)
    seen = tracks.observations(3)
    before, after = (set(seen.point[chosen]) for chosen in (seen.frame < 4, seen.frame >= 4))
    assert before and after and not before & after


def test_reference_tracks_without_texture_have_no_points():
    tracks = ReferenceTracks()
    for _ in range(3):
        tracks.follow(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), None)
    assert len(tracks.observations(3).frame) == 0


def test_local_contrast_ignores_unusable_pixels():
    grey = np.ascontiguousarray(view(0)[:, :, 0])
    usable = np.ones(grey.shape, bool)
    usable[:, 120:] = False
    changed = grey.copy()
    changed[:, 120:] = 255
    one, other = local_contrast(grey, usable), local_contrast(changed, usable)
    assert np.array_equal(one, other) and (one[:, 120:] == 128).all() and one[:, :110].std() > 20


def test_reference_tracks_positions_are_in_full_size_pixels():
    large = ReferenceTracks()
    for step in range(4):
        large.follow(cv2.resize(view(step), (WIDTH * 4, HEIGHT * 4), interpolation=cv2.INTER_CUBIC), None)
    seen = large.observations(3)
    both = np.intersect1d(seen.point[seen.frame == 0], seen.point[seen.frame == 3])
    first, last = (seen.pixels[(seen.frame == frame) & np.isin(seen.point, both)] for frame in (0, 3))
    np.testing.assert_allclose(np.median(first - last, axis=0), [12.0, 0.0], atol=0.5)


def test_reference_tracks_follow_rotation_about_axis():
    """A turn of 60 degrees moves points in all directions, by more than half of the picture's height."""
    tracks, centre = ReferenceTracks(), np.array([WIDTH / 2, HEIGHT / 2])
    turns = [
        np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for angle in np.deg2rad(np.arange(0, 61, 6))
    ]
    for turn in turns:
        shift = centre - turn @ centre + [200, 180]
        warp = cv2.WARP_INVERSE_MAP | cv2.INTER_CUBIC
        tracks.follow(cv2.warpAffine(wide_texture(0), np.c_[turn, shift], (WIDTH, HEIGHT), flags=warp), None)
    seen = tracks.observations(3)
    begin, end = (
        dict(zip(seen.point[seen.frame == k], seen.pixels[seen.frame == k] - 0.5, strict=True)) for k in (0, 10)
    )
    due = {number: turns[10].T @ (at - centre) + centre for number, at in begin.items()}
    inside = [number for number, at in due.items() if (at > 12).all() and (at < [WIDTH - 12, HEIGHT - 12]).all()]
    found = [number for number in inside if number in end]
    assert len(inside) > 100 and len(found) > 0.9 * len(inside)
    assert np.median([np.linalg.norm(end[number] - due[number]) for number in found]) < 0.25


def test_reference_tracks_avoid_masked_threads():
    """From 3 pixels beside a thread of 2 pixels on, so that the tissue between threads is not given up."""
    tracks, mask = ReferenceTracks(), np.ones((HEIGHT, WIDTH), np.uint8)
    threads = np.arange(20, WIDTH - 20, 20)
    mask[:, np.concatenate([threads, threads + 1])] = 0
    for _ in range(4):
        tracks.follow(view(0), mask)
    seen = tracks.observations(3)
    column = np.rint(seen.pixels[seen.frame == 0][:, 0] - 0.5)
    beside = np.abs(column[:, None] - threads - 0.5).min(1) - 0.5
    assert beside.min() > 2
    assert np.count_nonzero(beside <= 4) > 5


def stripes(periods_px: dict[float, float], mean: float, shape: tuple[int, int] = (60, 300)) -> np.ndarray:
    """Return a picture with vertical stripes: the standard deviation of the logarithm of brightness of each period."""
    x = np.arange(shape[1])
    bright = sum(spread * np.sqrt(2) * np.sin(2 * np.pi * x / period) for period, spread in periods_px.items())
    levels = (mean + 8) * np.exp(bright) - 8
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, shape)  # so that rounding is no pattern
    return np.clip(np.rint(levels + noise), 0, 255).astype(np.uint8)


def strength(picture: np.ndarray, period_px: float) -> float:
    """Return the standard deviation of a picture's stripes of a period in its middle two thirds."""
    x = np.arange(50, 50 + int(200 // period_px * period_px))
    rows = picture[10:-10, x].mean(0) - 128.0
    return float(np.sqrt(2) * abs((rows * np.exp(-2j * np.pi * x / period_px)).mean()))


@pytest.mark.parametrize(("spread", "share"), [(0.2, 1.0), (0.04, 2 / 5**0.5), (0.02, 0.5**0.5), (0.01, 1 / 5**0.5)])
def test_local_contrast_strength_by_texture_contrast(spread, share):
    """The squares of contrast and of noise, which is 0.02, add up."""
    contrast = local_contrast(stripes({10: spread}, 150.0), np.ones((60, 300), bool))
    assert strength(contrast, 10) == pytest.approx(40 * share, rel=0.1)


def test_local_contrast_is_reduced_for_dark_pixels():
    """Eight grey levels are added before the logarithm, so 8 and 9 contrast like 16 and 17."""
    grey = np.tile(np.repeat(np.array([8, 9], np.uint8), 5), (60, 30))
    contrast = local_contrast(grey, np.ones(grey.shape, bool)).astype(float)
    spread = np.log(17 / 16) / 2
    assert contrast[10:-10, 50:250].std() == pytest.approx(40 * spread / np.hypot(spread, 0.02), rel=0.04)


@pytest.mark.parametrize("upright", [False, True])
def test_local_contrast_removes_slow_brightness_variation(upright):
    """A Gaussian window of 10 of 300 pixels passes a period p with the factor exp(-2 (10 pi / p)^2)."""
    grey = stripes({60: 0.15, 10: 0.1}, 130.0)
    usable = np.ones(grey.shape, bool)
    contrast = local_contrast(np.ascontiguousarray(grey.T), usable.T).T if upright else local_contrast(grey, usable)
    left = 1.5 * (1 - np.exp(-2 * (10 * np.pi / 60) ** 2))
    assert strength(contrast, 60) / strength(contrast, 10) == pytest.approx(left, rel=0.15)


def followed_tracks(*pictures: np.ndarray, masks: list[np.ndarray | None] | None = None) -> Observations:
    """Return all observations of some pictures."""
    tracks = ReferenceTracks()
    for picture, mask in zip(pictures, masks or [None] * len(pictures), strict=True):
        tracks.follow(picture, mask)
    return tracks.observations(1)


def nearest(pixels: np.ndarray) -> float:
    return float((np.linalg.norm(pixels[:, None] - pixels[None], axis=2) + 999 * np.eye(len(pixels))).min())


def test_reference_corner_count_spacing_and_border():
    wide = followed_tracks(wide_texture(0)).pixels
    assert len(wide) == 250 and 16 <= nearest(wide) < 18
    small = followed_tracks(np.ascontiguousarray(view(0)[:80, :120])).pixels
    assert 4 <= nearest(small) < 5
    at = small - 0.5
    assert at.min() >= 8 and at[:, 0].max() <= 111 and at[:, 1].max() <= 71


def test_reference_tracks_halve_pictures_of_1280_pixels():
    """Corners are at the centres of pixels of the reduced picture."""
    picture = wide_texture(1)
    twice = cv2.resize(picture, (1280, 1024), interpolation=cv2.INTER_NEAREST)
    np.testing.assert_array_equal(followed_tracks(twice).pixels, 2 * followed_tracks(picture).pixels)
    assert (followed_tracks(picture).pixels % 1 == 0.5).all()


@pytest.mark.parametrize(("pictures", "found"), [(15, True), (16, False)])
def test_reference_is_dropped_after_more_than_15_misses(pictures, found):
    blank = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    seen = followed_tracks(view(0), *[blank] * pictures, view(0))
    first, last = seen.point[seen.frame == 0], seen.point[seen.frame == pictures + 1]
    assert len(last) > 50 and np.isin(last, first).all() == found
    assert found or not np.isin(last, first).any()


@pytest.mark.parametrize(("share", "new"), [(0.5, False), (0.3, True)])
def test_reference_is_renewed_below_40_percent_of_points(share, new):
    picture = view(0)
    count = followed_tracks(picture).point.max() + 1
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    columns = np.sort(followed_tracks(picture).pixels[:, 0])
    mask[:, int(columns[int(share * count)]) + 5 :] = 0
    seen = followed_tracks(picture, picture, masks=[None, mask])
    assert (seen.point.max() >= count) == new


@pytest.mark.parametrize(("side_px", "found"), [(40, False), (50, True)])
def test_reference_requires_24_corners(side_px, found):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20 : 20 + side_px, 40 : 40 + side_px] = 1
    count = len(followed_tracks(view(0), masks=[mask]).point)
    assert 24 <= count < 48 if found else count == 0


@pytest.mark.parametrize(("side_px", "found"), [(50, False), (60, True)])
def test_reference_is_found_from_24_corners(side_px, found):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20 : 20 + side_px, 40 : 40 + side_px] = 1
    seen = followed_tracks(view(0), view(0), masks=[None, mask])
    first, second = (seen.point[seen.frame == frame] for frame in (0, 1))
    count = np.isin(first, second).sum()
    assert 24 <= count < 48 if found else count == 0


def bulged(most_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture of which a place of 45 pixels is moved to the right, and the motion of each pixel."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    motion = most_px * np.exp(-((x - 100) ** 2 + (y - 75) ** 2) / (2 * 45**2))
    return cv2.remap(view(0), x - motion, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), motion


def test_reference_tracks_follow_local_motion():
    seen = followed_tracks(*(bulged(each)[0] for each in (0, 2, 4, 6)))
    first, last = (seen.of(seen.frame == frame) for frame in (0, 3))
    last = last.of(last.point < len(first.point))
    moved = last.pixels - first.pixels[last.point]
    x, y = last.pixels.astype(int).T
    assert np.abs(moved - np.stack([bulged(6)[1][y, x], np.zeros(len(x))], 1)).mean() < 0.1
    middle = np.flatnonzero(((first.pixels - [100, 75]) ** 2).sum(1) < 20**2)
    assert len(middle) >= 8 and np.isin(middle, last.point).mean() > 0.85


@pytest.mark.parametrize(("move_px", "found"), [(0.5, True), (3.0, False)])
def test_reference_tracks_drop_points_of_jumping_patch(move_px, found):
    """A tool that is not in the mask moves alone, by more than a pixel off the smooth motion of the tissue."""
    jumped = view(0).copy()
    jumped[50:100, 75:125] = view(-move_px)[50:100, 75:125]
    seen = followed_tracks(view(0), jumped)
    first, second = (seen.of(seen.frame == frame) for frame in (0, 1))
    inside = first.point[((first.pixels > [85, 60]) & (first.pixels < [115, 90])).all(1)]
    share = np.isin(inside, second.point).mean()
    assert len(inside) >= 5 and (share == 1 if found else share < 0.3)


def reference() -> _Reference:
    grey = np.ascontiguousarray(view(0)[:, :, 0])
    usable = np.ones(grey.shape, np.uint8)
    return _Reference(local_contrast(grey, usable != 0), _usable(usable), 0)


@pytest.mark.parametrize(
    "moved",
    [
        lambda x, y: (5 + 0 * x, 0 * x - 3),
        lambda x, y: (20 * x, -15 * y),
        lambda x, y: (30 * x * x, 40 * x * y),
        lambda x, y: (8 * y * y, 12 * y - 20 * x * x),
    ],
)
def test_reference_smooth_recovers_quadratic_map(moved):
    """Coordinates are shares of the longer side from its middle."""
    one = reference()
    kept = np.arange(len(one.corners)) % 3 != 0

    def there(at: np.ndarray) -> np.ndarray:
        return at + np.stack(moved(*np.moveaxis(at / WIDTH - 0.5, -1, 0)), -1)

    nodes = one._smooth(kept, there(one.corners.astype(np.float64)).astype(np.float32))
    found = one._map_of(nodes)
    assert np.abs(found - there(one._grid.astype(np.float64))).max() < 0.04
    assert _sampled(found, one.corners) == pytest.approx(one.corners + one._of_corners @ nodes, abs=1e-4)


def test_reference_corner_spacing_by_picture_size():
    for scale, apart in ((1, 5), (2, 10)):
        grey = cv2.resize(np.ascontiguousarray(view(0)[:, :, 0]), None, fx=scale, fy=scale)
        at = _Reference(grey, np.ones(grey.shape, np.uint8), 0).corners
        gaps = np.linalg.norm(at[:, None] - at[None], axis=2) + 99 * np.eye(len(at))
        assert apart <= gaps.min() < apart + 1.5
    small = np.ascontiguousarray(grey[:60, :80])
    at = _Reference(small, np.ones(small.shape, np.uint8), 0).corners
    assert 4 <= (np.linalg.norm(at[:, None] - at[None], axis=2) + 99 * np.eye(len(at))).min() < 6
