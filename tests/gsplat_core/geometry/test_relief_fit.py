"""Each kind of evidence for a relief, alone."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.geometry.light_change import Change
from gsplat_core.geometry.relief import Grid, Places, appearance
from gsplat_core.geometry.relief_fit import find_change, find_reliefs
from gsplat_core.geometry.shading import LEAST_DETAIL, Shading
from gsplat_core.scene.cameras import Camera

GRID = Grid.of(Camera.from_focal(140.0, 160, 128), (32, 40))
PLACES = Places.at(GRID, *GRID.middles())
ONES = np.ones((32, 40))
NOTHING = 0 * ONES


def relief(seed, size=0.12):
    return np.random.default_rng(seed).normal(0, size, len(GRID.half_waves)) / (1 + GRID.half_waves**2)


def shading_of(found, glints=NOTHING, wet=NOTHING, detail=LEAST_DETAIL):
    return Shading(
        appearance(PLACES, found).lit.reshape(32, 40) + PLACES.axis.reshape(32, 40), ONES, detail, glints, wet
    )


def glints_of(found):
    return np.clip(0.4 * np.exp(-12 * appearance(PLACES, found).angle), 0, 1).reshape(32, 40)


def change_between(before, after):
    brighter = (appearance(PLACES, after).lit - appearance(PLACES, before).lit).reshape(32, 40)
    return Change(brighter, ONES, np.zeros((32, 40, 2)), 1.0)


def left(found, true):
    """Share of the relief that was not found."""
    return np.std(PLACES.value @ (found - true)) / np.std(PLACES.value @ true)


@pytest.mark.parametrize("seed", range(3))
def test_brightness_without_pigment_shows_the_relief(seed):
    assert left(find_reliefs(GRID, [shading_of(relief(seed))], [None]).key, relief(seed)) < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_a_change_of_brightness_shows_the_change_of_the_relief(seed):
    true = relief(seed + 10, 0.03)
    found = find_change(GRID, relief(seed), change_between(relief(seed), relief(seed) + true))
    assert left(found, true) < 0.3


def test_the_key_and_each_change_are_found_together():
    key, moved = relief(1), [relief(seed, 0.03) for seed in (20, 21, 22)]
    shadings = [shading_of(key), *(shading_of(key + each) for each in moved)]
    found = find_reliefs(GRID, shadings, [None, *(change_between(key, key + each) for each in moved)])
    assert left(found.key, key) < 0.15
    assert not found.changes[0].any()
    for change, true in zip(found.changes[1:], moved, strict=True):
        assert left(change, true) < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_glints_mend_what_pigment_feigns(seed):
    key, feigned = relief(seed), appearance(PLACES, relief(seed + 30)).lit.reshape(32, 40)
    dry, wet = shading_of(key, detail=0.05), shading_of(key, glints_of(key), ONES, detail=0.05)
    errors = []
    for each in (dry, wet):
        each.brightness[...] += feigned
        errors.append(left(find_reliefs(GRID, [each], [None]).key, key))
    assert errors[1] < 0.8 * errors[0]


def test_glints_everywhere_alike_make_no_relief():
    flat = np.zeros(len(GRID.half_waves))
    glints = 0.01 * ONES
    found = find_reliefs(GRID, [shading_of(flat, glints, ONES)], [None]).key
    assert np.std(PLACES.value @ found) < 0.02


def test_a_light_that_becomes_brighter_is_no_relief():
    changed = Change(0.3 * ONES, ONES, np.zeros((32, 40, 2)), 1.0)
    assert np.std(PLACES.value @ find_change(GRID, relief(0), changed)) < 0.005
