"""Corners that are followed: where they are taken up, and when another scene is believed."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.geometry.tracks import FeatureTracks

HEIGHT, WIDTH = 96, 128


def texture(seed):
    small = np.random.default_rng(seed).uniform(40, 215, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def last(tracks):
    return tracks._seen[-1]


def test_corners_keep_8_pixels_from_the_border_10_from_a_tool_and_a_fortieth_of_the_side_apart():
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


def test_points_keep_their_numbers_and_are_where_the_picture_moved():
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


def test_fifteen_pictures_of_something_else_are_left_out_and_the_next_is_another_scene():
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
