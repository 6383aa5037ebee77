"""Corners that are followed: where they are taken up, and when another scene is believed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.geometry import tracks as tracks_module
from gsplat_core.geometry.tracks import SURVIVORS, FeatureTracks, followed

HEIGHT, WIDTH = 96, 128


def texture(seed):
    small = np.random.default_rng(seed).uniform(40, 215, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def last(tracks):
    return tracks._seen[-1]


def test_feature_tracks_corner_margins_and_spacing():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, 64:] = 0
    tracks = FeatureTracks()
    tracks.follow(texture(0), mask)
    _, pixels = last(tracks)
    at = pixels - 0.5
    assert len(at) > 20
    assert at.min(0).tolist() >= [8, 8] and at[:, 1].max() <= HEIGHT - 9 and 45 < at[:, 0].max() <= 53
    apart = np.linalg.norm(at[:, None] - at[None], axis=2) + 99 * np.eye(len(at))
    assert 4 <= apart.min() < 6


def test_feature_tracks_follow_shift_and_keep_numbers():
    tracks, picture = FeatureTracks(), texture(1)
    tracks.follow(picture, None)
    moved = cv2.warpAffine(picture, np.float32([[1, 0, 3], [0, 1, -2]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
    tracks.follow(moved, None)
    (first, before), (second, after) = tracks._seen
    both = np.intersect1d(first, second)
    assert len(both) > 0.7 * len(first)
    shift = after[np.searchsorted(second, both)] - before[np.searchsorted(first, both)]
    np.testing.assert_allclose(np.median(shift, axis=0), [3, -2], atol=0.1)
    seen = tracks.observations(2)
    assert len(seen.point) == 2 * len(both) and seen.point.max() == len(both) - 1
    assert len(tracks.observations(3).point) == 0 and len(tracks.observations(1).point) > 2 * len(both)
    assert len(tracks.observations().point) == 0
    tracks.follow(moved, None)
    assert len(tracks.observations().point) >= 3 * 0.9 * len(both)


def test_feature_tracks_skip_15_foreign_pictures_then_restart():
    tracks = FeatureTracks()
    tracks.follow(texture(2), None)
    first = last(tracks)[0]
    for _ in range(15):
        tracks.follow(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), None)
        assert len(last(tracks)[0]) == 0
    tracks.follow(texture(2), None)
    assert np.isin(first, last(tracks)[0]).mean() > 0.9
    for _ in range(16):
        tracks.follow(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), None)
    tracks.follow(texture(2), None)
    assert not np.isin(first, last(tracks)[0]).any() and len(last(tracks)[0]) > 20


def wide_texture(seed: int, cell_px: int = 8) -> np.ndarray:
    small = np.random.default_rng(seed).uniform(20, 235, (512 // cell_px, 640 // cell_px, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, (640, 512), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def test_feature_tracks_at_most_700_points():
    tracks = FeatureTracks()
    tracks.follow(wide_texture(0), None)
    pixels = tracks.observations(1).pixels
    assert len(pixels) == 700
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2) + 999 * np.eye(len(pixels))
    assert 16 <= apart.min() < 18


def test_feature_tracks_replace_points_if_a_tenth_is_missing():
    """Covering a stripe of tissue that holds 700 points loses few points at first and then many."""
    tracks, picture = FeatureTracks(), wide_texture(0)
    tracks.follow(picture, None)
    narrow, wide = (np.ones((512, 640), np.uint8) for _ in range(2))
    narrow[:, :20], wide[:, :160] = 0, 0
    tracks.follow(picture, narrow)
    seen = tracks.observations(1)
    few = seen.of(seen.frame == 1)
    assert 630 < len(few.point) < 700 and few.point.max() < 700
    tracks.follow(picture, wide)
    seen = tracks.observations(1)
    many = seen.of(seen.frame == 2)
    assert few.pixels[:, 0].min() > 30 and many.pixels[:, 0].min() > 169
    assert many.point.max() >= 700, "new points have new numbers"
    new = many.of(many.point >= 700).pixels
    old = many.of(many.point < 700).pixels
    # Positions of tracked points are rounded to whole pixels when new ones are detected.
    assert np.linalg.norm(new[:, None] - old[None], axis=2).min() > 15


def test_feature_tracks_ignore_weak_corners_beside_strong():
    """A corner must have half a per cent of the quality of the best one, which grows with the square of its contrast."""
    image = np.full((96, 128, 3), 100, np.uint8)
    image[20:32, 20:32] = 228
    for column, levels in ((60, 30), (90, 4)):
        image[50:62, column : column + 12] = 100 + levels
    tracks = FeatureTracks()
    tracks.follow(image, None)
    x = tracks.observations(1).pixels[:, 0]
    assert ((x > 55) & (x < 78)).any() and not (x > 85).any()


def test_feature_tracks_skip_picture_below_a_fifth_of_points():
    picture = wide_texture(3)
    for share, left_out in ((0.12, True), (0.4, False)):
        tracks = FeatureTracks()
        tracks.follow(picture, None)
        other = wide_texture(4)
        other[:, : int(share * 640)] = picture[:, : int(share * 640)]
        tracks.follow(other, None)
        seen = tracks.observations(1)
        assert (len(seen.of(seen.frame == 1).point) == 0) == left_out


def test_followed_misses_of_unmatched_point():
    """A patch visible in only one picture has no match; a shifted patch is tracked back to its start."""
    first = cv2.cvtColor(wide_texture(5), cv2.COLOR_RGB2GRAY)
    second = np.roll(first, (2, 3), (0, 1))
    second[300:, 400:] = cv2.cvtColor(wide_texture(6), cv2.COLOR_RGB2GRAY)[300:, 400:]
    points = np.array([[100, 100], [200, 350], [520, 400]], np.float32)
    there, misses = followed(first, second, points, window_px=21, levels=3)
    np.testing.assert_allclose(there[:2], points[:2] + [3, 2], atol=0.05)
    assert misses[:2].max() < 0.05 and misses[2] > 0.7
    nothing, none = followed(first, second, points[:0], window_px=21, levels=3)
    assert len(nothing) == len(none) == 0


def found_at(monkeypatch, places, misses=None):
    """Return the points of a 128x96 picture that tracking keeps of positions in the next picture."""
    places = np.array(places, np.float32)
    misses = np.zeros(len(places)) if misses is None else np.array(misses)
    monkeypatch.setattr(tracks_module, "followed", lambda *_, **__: (places, misses))
    tracks = FeatureTracks()
    tracks._points, tracks._numbers = np.full((len(places), 2), 40, np.float32), np.arange(len(places))
    grey = np.zeros((HEIGHT, WIDTH), np.uint8)
    return tracks._moved(grey, grey, np.full(grey.shape, 255, np.uint8))[1].tolist()


def test_feature_tracks_keep_points_within_half_a_pixel_of_border(monkeypatch):
    places = [
        [-0.4, 50], [-0.6, 50], [50, -0.4], [50, -0.6], [WIDTH - 0.6, 50], [WIDTH - 0.4, 50], [50, HEIGHT - 0.6],
        [50, HEIGHT - 0.4], [np.nan, 50],
    ]  # fmt: skip
    assert found_at(monkeypatch, places, [0] * 8 + [np.inf]) == [0, 2, 4, 6]


@pytest.mark.parametrize(("more", "left_out"), [(0, False), (-1, True)])
def test_feature_tracks_survivor_threshold(monkeypatch, more, left_out):
    count = 100
    kept = int(SURVIVORS * count) + more
    tracks = FeatureTracks()
    tracks._before = np.zeros((HEIGHT, WIDTH), np.uint8)
    tracks._points, tracks._numbers, tracks._next = np.full((count, 2), 40, np.float32), np.arange(count), count
    monkeypatch.setattr(tracks, "_moved", lambda *_: (tracks._points[:kept], tracks._numbers[:kept]))
    tracks.follow(np.zeros((HEIGHT, WIDTH, 3), np.uint8), None)
    assert (len(last(tracks)[0]) == 0) == left_out and len(tracks._points) == (count if left_out else kept)


@pytest.mark.parametrize(("miss_px", "kept"), [(0.69, [0]), (0.71, [])])
def test_feature_tracks_drop_points_returning_off_by_0_7_px(monkeypatch, miss_px, kept):
    assert found_at(monkeypatch, [[50, 50]], [miss_px]) == kept


@pytest.mark.parametrize("there", [[np.nan, 50.0], [50.0, np.inf], [np.nan, np.nan]])
def test_followed_misses_non_finite_point(monkeypatch, there):
    """OpenCV may report such places as found."""
    calls = []

    def flow(first, second, points, guess, **_):
        calls.append(points)
        found = np.array([[50.0, 50.0], there], np.float32) if len(calls) == 1 else np.asarray(points, np.float32)
        return found, np.ones((len(points), 1), np.uint8), None

    monkeypatch.setattr(tracks_module.cv2, "calcOpticalFlowPyrLK", flow)
    grey = np.zeros((HEIGHT, WIDTH), np.uint8)
    points = np.full((2, 2), 50, np.float32)
    _, misses = followed(grey, grey, points, window_px=21, levels=3)
    assert misses[0] == 0 and misses[1] == np.inf
