"""Tracks by reference pictures: no drift, found again after being hidden, independent of brightness."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.geometry.reference_tracks import (
    EVERY,
    MOST_MISSES,
    MOST_REFERENCES,
    ReferenceTracks,
    local_contrast,
)
from tests.gsplat_core.geometry.test_tracks import wide_texture

HEIGHT, WIDTH = 150, 200


def view(at: float, gain: float = 1.0) -> np.ndarray:
    """Return a picture of a texture, moved to the left by `at` pixels."""
    shift = np.array([[1, 0, -at - 20], [0, 1, -10]], np.float64)
    moved = cv2.warpAffine(wide_texture(0), shift, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    return np.clip(gain * moved.astype(np.float64), 0, 255).astype(np.uint8)


def errors_of(tracks: ReferenceTracks, at: list[float]) -> np.ndarray:
    """Return the position errors of all observations relative to the first one of their point in pixels."""
    seen = tracks.observations(3)
    first = np.array([np.flatnonzero(seen.point == number)[0] for number in range(seen.point.max() + 1)])[seen.point]
    moved = -(np.array(at)[seen.frame] - np.array(at)[seen.frame[first]])
    expected = seen.pixels[first] + np.stack([moved, np.zeros_like(moved)], 1)
    return np.linalg.norm(seen.pixels - expected, axis=1)


def test_errors_do_not_accumulate():
    at = [12 * np.sin(0.37 * step) for step in range(60)]
    tracks = ReferenceTracks()
    for each in at:
        tracks.follow(view(each), None)
    errors = errors_of(tracks, at)
    late = tracks.observations(3).frame >= 40
    assert np.median(errors[late]) < 0.1 and np.median(errors[late]) < 3 * np.median(errors) + 0.02


def test_a_changing_exposure_changes_nothing():
    at = [0.7 * step for step in range(15)]
    steady, changing = ReferenceTracks(), ReferenceTracks()
    for step, each in enumerate(at):
        steady.follow(view(each, 0.6), None)
        changing.follow(view(each, 0.6 * (1 + 0.5 * np.sin(step))), None)
    assert np.median(errors_of(changing, at)) < np.median(errors_of(steady, at)) + 0.05
    assert len(changing.observations().frame) > 0.8 * len(steady.observations().frame)


def test_points_are_found_again_behind_a_tool():
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


def test_references_are_renewed_and_limited():
    tracks = ReferenceTracks()
    for _ in range(EVERY * (MOST_REFERENCES + 2)):
        tracks.follow(view(0), None)
    seen = tracks.observations(3)
    last = np.unique(seen.point[seen.frame == seen.frame.max()])
    assert 0 < len(last) < len(np.unique(seen.point))
    assert last.min() > 0, "points of the oldest reference are given up"


def test_another_scene_gets_new_points():
    tracks = ReferenceTracks()
    other = np.ascontiguousarray(view(3)[::-1, ::-1])
    for _ in range(4):
        tracks.follow(view(0), None)
    for _ in range(MOST_MISSES + 6):
        tracks.follow(other, None)
    seen = tracks.observations(3)
    before, after = (set(seen.point[chosen]) for chosen in (seen.frame < 4, seen.frame >= 4))
    assert before and after and not before & after


def test_a_picture_without_texture_has_no_points():
    tracks = ReferenceTracks()
    for _ in range(3):
        tracks.follow(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), None)
    assert len(tracks.observations(3).frame) == 0


def test_unusable_pixels_have_no_contrast_and_influence_no_other():
    grey = np.ascontiguousarray(view(0)[:, :, 0])
    usable = np.ones(grey.shape, bool)
    usable[:, 120:] = False
    changed = grey.copy()
    changed[:, 120:] = 255
    one, other = local_contrast(grey, usable), local_contrast(changed, usable)
    assert np.array_equal(one, other) and (one[:, 120:] == 128).all() and one[:, :110].std() > 20


def test_large_pictures_are_reduced_and_positions_are_not():
    large = ReferenceTracks()
    for step in range(4):
        large.follow(cv2.resize(view(step), (WIDTH * 4, HEIGHT * 4), interpolation=cv2.INTER_CUBIC), None)
    seen = large.observations(3)
    both = np.intersect1d(seen.point[seen.frame == 0], seen.point[seen.frame == 3])
    first, last = (seen.pixels[(seen.frame == frame) & np.isin(seen.point, both)] for frame in (0, 3))
    np.testing.assert_allclose(np.median(first - last, axis=0), [12.0, 0.0], atol=0.5)


def test_points_are_found_while_the_scope_turns_about_its_axis():
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


def test_points_are_found_near_a_thread_but_not_on_it():
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
