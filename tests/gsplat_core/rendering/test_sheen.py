"""Colours that depend on the direction half-way between light and eye."""

import numpy as np
import pytest

from gsplat_core.rendering.elsewhere import Sheen, half_directions

TIMES = np.linspace(0, 4, 20)


def turning(count=200, seed=0):
    """Directions [N, T, 2] of points that are turned to and fro, and whose normals differ."""
    random = np.random.default_rng(seed)
    normals = random.normal(0, 0.1, (count, 1, 2))
    swings = np.stack([0.12 * np.sin(2 * TIMES), 0.12 * np.cos(3 * TIMES)], axis=-1)
    return normals + swings


def glossy(halves):
    """A base colour and a highlight where the direction is (0, 0)."""
    return np.array([0.6, 0.3, 0.2]) + 0.4 * np.exp(-np.square(halves).sum(-1, keepdims=True) / 2 / 0.06**2)


def learned(halves, colours, seen=None, **given):
    seen = np.ones(halves.shape[:2], bool) if seen is None else seen
    return Sheen(halves, colours, seen, TIMES, given.get("weights", np.ones(len(halves))))


def test_highlights_are_foretold_for_directions_that_were_seen_at_other_times():
    halves = turning()
    sheen, there = learned(halves, glossy(halves)), 0.5 * (halves[:, 3] + halves[:, 4]) + 0.01
    change = glossy(there) - glossy(halves[:, 0])
    found = sheen.difference(there, halves[:, 0])
    assert sheen.skill > 0.7
    assert np.square(found - change).mean() < 0.15 * np.square(change).mean()


def test_the_same_direction_changes_nothing_at_all():
    halves = turning(5)
    sheen = learned(halves, glossy(halves))
    assert (sheen.difference(halves[:, 7], halves[:, 7]) == 0).all()


def test_far_from_what_was_seen_a_highlight_goes_away():
    halves = np.zeros((3, len(TIMES), 2)) + np.linspace(0, 0.2, len(TIMES))[:, None]
    found = learned(halves, glossy(halves)).difference(np.full((3, 2), 3.0), halves[:, 0])
    assert (found < -0.1).all()


def test_noise_has_no_skill_and_changes_next_to_nothing():
    halves = turning()
    colours = np.random.default_rng(1).uniform(0, 1, (*halves.shape[:2], 3))
    sheen = learned(halves, colours)
    assert sheen.skill < 0.1
    assert np.abs(sheen.difference(halves[:, 2] + 0.05, halves[:, 0])).mean() < 0.02


def test_what_was_not_seen_does_not_count():
    halves = turning()
    seen = np.ones(halves.shape[:2], bool)
    seen[:, 5] = seen[3] = False
    wrong = np.where(seen[..., None], glossy(halves), 77.0)
    right = np.where(seen[..., None], glossy(halves), 0.0)
    one, other = (learned(halves, colours, seen) for colours in (wrong, right))
    there = halves[:, 5] + 0.02
    np.testing.assert_array_equal(one.difference(there, halves[:, 0]), other.difference(there, halves[:, 0]))
    assert (one.difference(there, halves[:, 0])[3] == 0).all() and one.skill == other.skill


@pytest.mark.parametrize("count", [0, 7])
def test_tissue_that_never_changes_has_no_sheen(count):
    halves = turning(count)
    sheen = learned(halves, np.full((*halves.shape[:2], 3), 0.5))
    np.testing.assert_allclose(sheen.difference(halves[:, 1], halves[:, 0]), 0, atol=1e-9)


def test_the_half_direction_lies_along_the_normal_where_light_and_eye_are_at_the_mirrored_angle():
    tangents = np.eye(3)[None, :2]
    point = np.array([[0.0, 0, 50]])
    np.testing.assert_allclose(
        half_directions(tangents, point, np.array([-8.0, 0, 0]), np.array([8.0, 0, 0])), 0, atol=1e-12
    )
    aside = half_directions(tangents, point, np.zeros(3), np.array([8.0, 0, 0]))[0]
    assert aside[0] == pytest.approx(np.sin(0.5 * np.arctan(8 / 50)), abs=1e-9) and aside[1] == 0
