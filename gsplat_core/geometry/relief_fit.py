"""The relief of tissue that one eye sees, by all that the scope's light tells about it at several times (shape from shading, and more).

What is looked for is the relief at a key time, and how it differs at each other time. Three things are held against it:

* **Brightness** of each picture, by a mixture of its channels and by what is not mirrored. Pigment that is left in it is another sum of cosines; lamp
  and lens darken towards the border by a power of the cosine of the angle to the axis.
* **Change of brightness of tissue that is followed** from the key time on: pigment plays no part in it. How much light there is may change.
* **Glints** on wet tissue: the rarer, the more the surface turns away from the lamp, exponentially. How rare is not known.

All unknowns have Gaussian priors. The widths of those of relief and changes are estimated from the pictures (evidence maximisation, MacKay 1992). The
maximum a posteriori is found by Gauss-Newton; what belongs to one kind of evidence alone is eliminated from the equations of the relief.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsplat_core.geometry.light_change import Change
from gsplat_core.geometry.relief import Appearance, Array, Grid, Places, appearance
from gsplat_core.geometry.shading import Cells, Shading

RELIEF, RELIEF_COUNT = 0.05, 100
"""Prior standard deviation of the coefficients of coarse cosines, and the weight of that value while it is estimated: as if so many had shown it."""
RELIEF_LIMITS = 0.025, 2.0
CHANGE, CHANGE_COUNT, CHANGE_LIMITS = 0.03, 20, (0.005, 0.3)
"""The same for the change of the relief from one time to another."""
FINER_HALF_WAVES, FINER_POWER = 1.5, 4.0
"""Prior standard deviations fall with finer cosines as (1 + (half waves / FINER_HALF_WAVES)²) to the power of -FINER_POWER / 2."""
PIGMENT = 0.5
"""Prior standard deviation of the coefficients of coarse cosines of the pigment that is left, in units of `Shading.detail` ..."""
PIGMENT_HALF_WAVES = 2.0
"""... and from how many half waves on it falls, with their square."""
FALL_OFF, FALL_OFF_DEVIATION = 1.0, 0.5
"""Prior of the power of the cosine to the axis by which it darkens towards the border: 1 for a flat lamp."""
CHANGE_ERROR = 0.02
"""Standard deviation of a cell's change of log brightness."""
CHANGES_TELL = 0.3
"""How much changes count for the relief itself: neighbouring cells err alike, and what they err by is no relief."""
RARER, RARER_DEVIATION = 12.0, 0.4
"""Prior of how fast glints become rarer with the angle, by radian, and of the logarithm of that."""
GLINT_LOOKS = 4.0
"""Glints of all times together count as those of so many: tissue that moves little glints at the same places again."""
GLINT_CELL_SHARE = 1 / 64
"""Of a cell: one glint's size."""
FEWEST_GLINTS = 0.3
"""A cell's expected number of glints is uncertain by so much at least."""
BRIGHTNESS_LOOKS = 5
"""The brightness of so many pictures is looked at, spread evenly."""
ROUNDS = 16
ROUNDS_OF_CHANGE = 4
ROUNDS_TO_SLOPES = 4
"""Over these the cosine term is faded in: by distance alone brightness is linear in the unknowns. Only then are glints looked at."""
DAMPING = 0.6
"""Share of each step, where glints are looked at: with them the problem is far from linear."""


@dataclass(frozen=True)
class Reliefs:
    """What was found."""

    key: Array
    """Coefficients [cosines] at the key time."""
    changes: Array
    """What is added to them at each time [times, cosines]."""


class Equations:
    """Linear equations for a step of the relief, from least squares in which the evidence's own unknowns were eliminated."""

    def __init__(
        self, own: Array, relief: Array, off: Array, weight: Array, prior: Array, away: Array, tell: float = 1.0
    ) -> None:
        """Derivatives by the own unknowns [N, M] and by the relief [N, cosines], what is unexplained [N], weights [N]; the inverse variances of the
        own unknowns [M] and how far these are from what is expected [M]; tell: how much the whole counts for the relief."""
        weighted = own * weight[:, None]
        self.inverse = np.linalg.inv(own.T @ weighted + np.diag(prior))
        self._right = weighted.T @ off - prior * away
        self._mixed = weighted.T @ relief
        gain = self._mixed.T @ self.inverse
        self.information = tell * (relief.T @ (relief * weight[:, None]) - gain @ self._mixed)
        self.pull = tell * (relief.T @ (weight * off) - gain @ self._right)

    def own_step(self, step: Array) -> Array:
        """That of the own unknowns, where the relief makes this step."""
        return np.asarray(self.inverse @ (self._right - self._mixed @ step))


class Brightness:
    """That of several pictures, with the pigment and the light that they share."""

    def __init__(self, grid: Grid, shadings: Sequence[Cells], times: Sequence[int], counts: float) -> None:
        """times: of the pictures. counts: what share of the pictures' brightness this is."""
        self._known = [shading.known.ravel() for shading in shadings]
        self._times = times
        column, row = grid.middles()
        self._places = [Places.at(grid, column.ravel()[known], row.ravel()[known]) for known in self._known]
        pairs = list(zip(shadings, self._known, strict=True))
        self._seen = np.concatenate([each.brightness.ravel()[known] for each, known in pairs])
        detail = float(np.median([each.detail for each in shadings]))
        self._noise = 2 / detail**2
        self._weight = np.concatenate([each.share.ravel()[known] for each, known in pairs]) * (
            counts * self._noise / len(shadings)
        )
        pigment = PIGMENT * detail / (1 + grid.half_waves / PIGMENT_HALF_WAVES) ** 2
        self._prior = np.concatenate([pigment**-2, [1e-6, FALL_OFF_DEVIATION**-2]])
        self._expected = np.concatenate([np.zeros(len(pigment) + 1), [FALL_OFF]])
        self._own = np.concatenate([np.zeros(len(pigment)), [np.median(self._seen)], [FALL_OFF]])
        self._design = np.concatenate([
            np.concatenate([each.value, np.ones((len(each.x), 1)), each.axis[:, None]], axis=1) for each in self._places
        ])  # fmt: skip

    def equations(self, key: Array, changes: Array, slopes: float) -> Equations:
        """At this relief."""
        shown = [
            appearance(each, key + changes[time], slopes) for each, time in zip(self._places, self._times, strict=True)
        ]
        off = self._seen - np.concatenate([each.lit for each in shown]) - self._design @ self._own
        weight = self._weight / np.sqrt(1 + off * off * self._noise)
        by_relief = np.concatenate([each.lit_by for each in shown])
        self._last = Equations(self._design, by_relief, off, weight, self._prior, self._own - self._expected)
        return self._last

    def take(self, step: Array) -> None:
        """Go on with what the relief's step means for pigment and light."""
        self._own = self._own + self._last.own_step(step)


class Followed:
    """How the brightness of tissue changed from the key time to another."""

    def __init__(self, grid: Grid, change: Change) -> None:
        known = change.known.ravel()
        column, row = (each.ravel()[known] for each in grid.middles())
        moved = change.moved.reshape(-1, 2)[known]
        self._before, self._after = (
            Places.at(grid, column, row),
            Places.at(grid, column + moved[:, 0], row + moved[:, 1]),
        )
        self._brighter, self._weight = change.brighter.ravel()[known], change.share.ravel()[known] / CHANGE_ERROR**2
        self._finer, self._width, self._light = _finer(grid), CHANGE, 0.0

    def equations(self, key: Array, change: Array, slopes: float = 1.0) -> Equations:
        """At this relief and this change of it."""
        before, after = appearance(self._before, key, slopes), appearance(self._after, key + change, slopes)
        off = self._brighter - (after.lit - before.lit) - self._light
        weight = self._weight / np.sqrt(1 + (off / CHANGE_ERROR) ** 2)
        own = np.concatenate([after.lit_by, np.ones((len(off), 1))], axis=1)
        prior = np.append((self._width * self._finer) ** -2, 1e-6)
        away = np.append(change, self._light)
        self._last = Equations(own, after.lit_by - before.lit_by, off, weight, prior, away, CHANGES_TELL)
        undecided = self._last.inverse.diagonal()[:-1] * prior[:-1]
        self._width = _width(change / self._finer, undecided, CHANGE, CHANGE_COUNT, CHANGE_LIMITS)
        return self._last

    def take(self, step: Array) -> Array:
        """What the relief's step means for the change."""
        own = self._last.own_step(step)
        self._light += float(own[-1])
        return own[:-1]


class Glints:
    """How many of them each cell shows at each time."""

    def __init__(self, grid: Grid, shadings: Sequence[Shading]) -> None:
        self._places = Places.at(grid, *grid.middles())
        self._counted = np.concatenate([each.wet_share.ravel() / GLINT_CELL_SHARE for each in shadings])
        self._seen = np.concatenate([each.glints.ravel() / GLINT_CELL_SHARE for each in shadings])
        self._own, self._spread = np.array([np.log(0.05), np.log(RARER)]), 1.0
        self._prior = np.array([1e-3, RARER_DEVIATION**-2])
        self._looks = min(GLINT_LOOKS, len(shadings)) / len(shadings)

    def equations(self, key: Array, changes: Array) -> Equations:
        """At this relief."""
        shown: list[Appearance] = [appearance(self._places, key + change) for change in changes]
        angle, by_relief = (
            np.concatenate([each.angle for each in shown]),
            np.concatenate([each.angle_by for each in shown]),
        )
        rarer = np.exp(self._own[1])
        expected = self._counted * np.exp(np.clip(self._own[0] - rarer * angle, -12, -0.5))
        wide = expected + FEWEST_GLINTS
        off = (self._seen - expected) / wide
        counted = self._counted > 0.5 / GLINT_CELL_SHARE
        weight = wide * counted * self._looks / self._spread
        self._spread = max(1.0, float(np.sum((off * off * wide)[counted]) / max(int(counted.sum()), 1)))
        own = np.stack([np.ones_like(angle), -rarer * angle], axis=1)
        self._last = Equations(own, -rarer * by_relief, off, weight, self._prior, self._own - [0, np.log(RARER)])
        return self._last

    def take(self, step: Array) -> None:
        """Go on with what the relief's step means for how rare glints are."""
        self._own = self._own + np.clip(self._last.own_step(step), -1, 1)


def find_reliefs(grid: Grid, shadings: Sequence[Shading], followed: Sequence[Change | None]) -> Reliefs:
    """The most probable reliefs of several times, of which each has a `Shading`, and how brightness changed since the key time; None at that time
    and where nothing could be followed: the relief is taken to be as at the key time."""
    times = np.unique(np.linspace(0, len(shadings) - 1, BRIGHTNESS_LOOKS).round().astype(int)).tolist()
    kinds: list[list[Cells]] = [[shadings[k] for k in times]]
    diffuse = [each for k in times if (each := shadings[k].diffuse) is not None]
    kinds += [diffuse] if len(diffuse) == len(times) else []
    brightness, glints = [Brightness(grid, each, times, 1 / len(kinds)) for each in kinds], Glints(grid, shadings)
    changing = {time: Followed(grid, change) for time, change in enumerate(followed) if change is not None}
    finer, width = _finer(grid), RELIEF
    key, changes = np.zeros(len(finer)), np.zeros((len(shadings), len(finer)))
    for number in range(ROUNDS):
        slopes, with_glints = min(1.0, number / ROUNDS_TO_SLOPES), number >= ROUNDS_TO_SLOPES
        prior = (width * finer) ** -2
        parts = [each.equations(key, changes, slopes) for each in brightness]
        parts += [each.equations(key, changes[time], slopes) for time, each in changing.items()]
        parts += [glints.equations(key, changes)] if with_glints else []
        information = np.diag(prior) + sum(each.information for each in parts)
        step = np.asarray(np.linalg.solve(information, sum(each.pull for each in parts) - prior * key), np.float64)
        step = step * (DAMPING if with_glints else 1.0)
        key = key + step
        for kind in brightness:
            kind.take(step)
        for time, each in changing.items():
            changes[time] += each.take(step)
        if with_glints:
            glints.take(step)
        if number > 0:
            undecided = np.linalg.inv(information).diagonal() * prior
            width = _width(key / finer, undecided, RELIEF, RELIEF_COUNT, RELIEF_LIMITS)
    return Reliefs(key, changes)


def find_change(grid: Grid, key: Array, change: Change) -> Array:
    """What is to be added to the coefficients of a relief that is known at the key time, for the time of the change."""
    followed, added = Followed(grid, change), np.zeros(len(key))
    for _ in range(ROUNDS_OF_CHANGE):
        followed.equations(key, added)
        added = added + followed.take(np.zeros(len(key)))
    return added


def _finer(grid: Grid) -> Array:
    """How prior standard deviations fall with finer cosines."""
    return np.asarray((1 + (grid.half_waves / FINER_HALF_WAVES) ** 2) ** (-FINER_POWER / 2))


def _width(scaled: Array, undecided: Array, usual: float, count: float, limits: tuple[float, float]) -> float:
    """The prior's width that makes what was found most probable; `undecided`: posterior over prior variance of each coefficient."""
    decided = float(np.sum(1 - undecided))
    variance = (float(scaled @ scaled) + count * usual**2) / (decided + count)
    return float(np.clip(np.sqrt(variance), *limits))
