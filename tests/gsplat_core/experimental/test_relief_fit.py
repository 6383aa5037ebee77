"""Each kind of evidence for a relief, alone."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental import light as light_module
from gsplat_core.experimental.light import Equations, Grid, Places, appearance, find_change, find_reliefs
from gsplat_core.experimental.shading import LEAST_DETAIL, Change, Shading
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
def test_relief_fit_from_brightness_without_pigment(seed):
    assert left(find_reliefs(GRID, [shading_of(relief(seed))], [None]).key, relief(seed)) < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_relief_fit_change_from_brightness_change(seed):
    true = relief(seed + 10, 0.03)
    found = find_change(GRID, relief(seed), change_between(relief(seed), relief(seed) + true))
    assert left(found, true) < 0.3


def test_relief_fit_finds_key_and_changes_together():
    key, moved = relief(1), [relief(seed, 0.03) for seed in (20, 21, 22)]
    shadings = [shading_of(key), *(shading_of(key + each) for each in moved)]
    found = find_reliefs(GRID, shadings, [None, *(change_between(key, key + each) for each in moved)])
    assert left(found.key, key) < 0.15
    assert not found.changes[0].any()
    for change, true in zip(found.changes[1:], moved, strict=True):
        assert left(change, true) < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_relief_fit_glints_correct_error_of_pigment(seed):
    key, feigned = relief(seed), appearance(PLACES, relief(seed + 30)).lit.reshape(32, 40)
    dry, wet = shading_of(key, detail=0.05), shading_of(key, glints_of(key), ONES, detail=0.05)
    errors = []
    for each in (dry, wet):
        each.brightness[...] += feigned
        errors.append(left(find_reliefs(GRID, [each], [None]).key, key))
    assert errors[1] < 0.8 * errors[0]


def test_relief_fit_uniform_glints_give_flat_relief():
    flat = np.zeros(len(GRID.half_waves))
    glints = 0.01 * ONES
    found = find_reliefs(GRID, [shading_of(flat, glints, ONES)], [None]).key
    assert np.std(PLACES.value @ found) < 0.02


def test_relief_fit_ignores_uniform_brightness_change():
    changed = Change(0.3 * ONES, ONES, np.zeros((32, 40, 2)), 1.0)
    assert np.std(PLACES.value @ find_change(GRID, relief(0), changed)) < 0.005


def analytic_view(seed):
    """Log brightness and log depth [32, 40] of a bumpy surface z(X, Y), by intersecting rays and the surface's own normals; nothing of `relief` is used."""
    random = np.random.default_rng(seed)
    angles = random.uniform(0, 2 * np.pi, 4)
    lengths = random.uniform(0.1, 0.16, 4)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    waves = [(k, random.uniform(0, 6.3), random.uniform(1.0, 2.0)) for k in lengths]
    column, row = np.meshgrid(np.arange(40) * 4 + 2.0, np.arange(32) * 4 + 2.0)
    slope = np.stack([(column - 80) / 140.0, (row - 64) / 140.0])
    z = np.full(column.shape, 60.0)
    for _ in range(100):
        here = z * slope
        z = 60 + sum(size * np.sin(k[0] * here[0] + k[1] * here[1] + phase) for k, phase, size in waves)
    here = z * slope
    bends = [size * np.cos(k[0] * here[0] + k[1] * here[1] + phase) for k, phase, size in waves]
    by_x, by_y = (sum(k[axis] * bend for (k, _, _), bend in zip(waves, bends, strict=True)) for axis in (0, 1))
    point = np.stack([*here, z])
    normal = np.stack([by_x, by_y, -np.ones_like(z)]) / np.sqrt(1 + by_x**2 + by_y**2)
    distance = np.sqrt((point**2).sum(0))
    cosine = -(normal * point).sum(0) / distance
    forward = np.log(z / distance)  # fall-off of the beam to the side, as the lamp of an endoscope has it
    return np.log((cosine + 0.25) / 1.25) - 2 * np.log(distance) + forward, np.log(z)


@pytest.mark.parametrize(("seed", "most"), [(0, 0.56), (1, 0.13), (2, 0.47), (4, 0.26)])
def test_relief_fit_of_analytic_surface(seed, most):
    """Measured 0.51, 0.08, 0.41 and 0.20 of the relief left; the best tilted plane leaves 0.87 to 1.00."""
    lit, true = analytic_view(seed)
    found = PLACES.value @ find_reliefs(GRID, [Shading(lit, ONES, LEAST_DETAIL, NOTHING, NOTHING)], [None]).key
    true = true.ravel() - true.mean()
    found = found - found.mean()
    assert np.std(found - true) < most * np.std(true)
    assert np.corrcoef(found, true)[0, 1] > 0.85


def test_equations_step_equals_joint_least_squares():
    """The elimination of the own unknowns, against one dense least-squares problem with the priors as rows."""
    random = np.random.default_rng(6)
    own, relief_by, off = random.normal(size=(30, 3)), random.normal(size=(30, 4)), random.normal(size=30)
    weight, prior, away = random.uniform(0.5, 2, 30), random.uniform(1, 9, 3), random.normal(0, 2, 3)
    key, key_prior = random.normal(size=4), random.uniform(1, 5, 4)
    equations = Equations(own, relief_by, off, weight, prior, away)
    step = np.linalg.solve(equations.information + np.diag(key_prior), equations.pull - key_prior * key)
    rows = np.vstack(
        [
            np.sqrt(weight)[:, None] * np.hstack([own, relief_by]),
            np.hstack([np.diag(np.sqrt(prior)), np.zeros((3, 4))]),
            np.hstack([np.zeros((4, 3)), np.diag(np.sqrt(key_prior))]),
        ]
    )
    right = np.concatenate([np.sqrt(weight) * off, -np.sqrt(prior) * away, -np.sqrt(key_prior) * key])
    together = np.linalg.lstsq(rows, right, rcond=None)[0]
    np.testing.assert_allclose(step, together[3:], rtol=1e-8)
    np.testing.assert_allclose(equations.own_step(step), together[:3], rtol=1e-8)


def test_relief_fit_of_noise_stays_small():
    """With noise far above the brightness of any relief, the prior keeps the relief near the plane."""
    noise = np.random.default_rng(9).normal(0, 1.0, (32, 40))
    found = find_reliefs(GRID, [Shading(noise, ONES, 1.0, NOTHING, NOTHING)], [None]).key
    assert np.std(PLACES.value @ found) < 0.25


@pytest.fixture
def equations(monkeypatch):
    """Record the arguments of each call of `Equations`."""
    given = []

    def record(own, relief, off, weight, prior, away, tell=1.0):
        given.append(dict(own=own, relief=relief, off=off, weight=weight, prior=prior, away=away, tell=tell))
        return Equations(own, relief, off, weight, prior, away, tell)

    monkeypatch.setattr(light_module, "Equations", record)
    return given


FLAT = np.zeros(len(GRID.half_waves))


def test_light_change_equations_weights_and_prior(equations):
    share = 0.5 * ONES
    brighter = np.where(np.arange(40) < 20, 0.0, 0.06) * ONES
    light_module.Followed(GRID, Change(brighter, share, np.zeros((32, 40, 2)), 1.0)).equations(FLAT, FLAT)
    (one,) = equations
    # An error of three deviations weighs 1 / sqrt(10) of one that is none.
    np.testing.assert_allclose(one["weight"].reshape(32, 40)[0, [0, 39]], [1250, 1250 / np.sqrt(10)])
    np.testing.assert_allclose(one["off"].reshape(32, 40)[0, [0, 39]], [0, 0.06], atol=1e-12)
    np.testing.assert_allclose(one["own"][:, -1], 1)
    assert one["tell"] == 0.3
    # 0.03 for the coarsest cosines, a quarter of it at 1.5 half waves.
    np.testing.assert_allclose(one["prior"][:-1], (0.03 / (1 + (GRID.half_waves / 1.5) ** 2) ** 2) ** -2)
    assert one["prior"][-1] == 1e-6


def test_brightness_equations_weights_and_pigment_prior(equations):
    seen = np.where(np.arange(40) < 20, 0.0, 0.2) * ONES
    seen[:, 19] = 0.0
    brightness = light_module.Brightness(GRID, [Shading(seen, ONES, 0.1, NOTHING, NOTHING)] * 2, [0, 1], 0.5)
    brightness.equations(FLAT, np.zeros((2, len(FLAT))), 0.0)
    (one,) = equations
    expected = 0.5 * (2 / 0.1**2) / 2 / np.sqrt(1 + one["off"] ** 2 * 2 / 0.1**2)
    np.testing.assert_allclose(one["weight"], expected)
    assert len(one["off"]) == 2 * 32 * 40 and one["tell"] == 1.0
    pigment = 0.5 * 0.1 / (1 + GRID.half_waves / 2.0) ** 2
    np.testing.assert_allclose(one["prior"], [*pigment**-2, 1e-6, 4.0])
    # It starts from no pigment, the median brightness and a flat lamp, of which the last is expected.
    np.testing.assert_allclose(one["away"], [*FLAT, np.median(seen), 0])


def test_glint_equations_decay_with_angle(equations):
    found = light_module.Glints(GRID, [Shading(NOTHING, ONES, 0.1, 0.1 * ONES, ONES)] * 8)
    found.equations(FLAT, np.zeros((8, len(FLAT))))
    (one,) = equations
    angle = np.tile(appearance(PLACES, FLAT).angle, 8)
    expected = 64 * np.exp(np.clip(np.log(0.05) - 12 * angle, -12, -0.5))
    np.testing.assert_allclose(one["off"], (6.4 - expected) / (expected + 0.3))
    np.testing.assert_allclose(one["weight"], (expected + 0.3) * 4 / 8)
    np.testing.assert_allclose(one["own"], np.stack([np.ones_like(angle), -12 * angle], axis=1))
    np.testing.assert_allclose(one["prior"], [1e-3, 0.4**-2])
    # What errs by more than it should counts less in the next round.
    spread = float(np.sum(one["off"] ** 2 * (expected + 0.3)) / len(angle))
    found.equations(FLAT, np.zeros((8, len(FLAT))))
    np.testing.assert_allclose(equations[1]["weight"], (expected + 0.3) * 0.5 / max(1.0, spread))


def test_glint_equations_ignore_cells_of_small_wet_share(equations):
    wet = np.where(np.arange(40) < 20, 0.4, 0.6) * ONES
    light_module.Glints(GRID, [Shading(NOTHING, ONES, 0.1, NOTHING, wet)]).equations(FLAT, FLAT[None])
    weight = equations[0]["weight"].reshape(32, 40)
    assert not weight[:, :20].any() and weight[:, 20:].all()


@pytest.mark.parametrize(
    ("scaled", "undecided", "width"),
    [
        (np.zeros(4), np.ones(4), 0.05),  # nothing is decided: as expected
        (np.ones(4), np.zeros(4), np.sqrt((4 + 100 * 0.05**2) / 104)),
        (np.zeros(400), np.zeros(400), 0.025),  # the least
        (np.full(9, 90.0), np.zeros(9), 2.0),  # the most
    ],
)
def test_prior_width_combines_found_and_expected_values(scaled, undecided, width):
    found = light_module._width(
        scaled, undecided, light_module.RELIEF, light_module.RELIEF_COUNT, light_module.RELIEF_LIMITS
    )
    assert found == pytest.approx(width)


def test_equations_without_evidence_return_to_prior_mean():
    """Without evidence a step returns the own unknowns to their prior mean."""
    none = Equations(np.zeros((3, 1)), np.zeros((3, 2)), np.zeros(3), np.ones(3), np.array([4.0]), np.array([0.5]))
    np.testing.assert_allclose(none.own_step(np.zeros(2)), [-0.5])
    assert not none.information.any() and not none.pull.any()
