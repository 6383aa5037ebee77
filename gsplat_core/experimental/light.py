"""Relative depth for a static scope from the shading of its own light.

Brightness falls with the square of the distance and the cosine of the incidence angle, and highlights mark surfaces
that face the lamp. Brightness changes of tracked tissue depend on distance and slope alone (`shading`). The depth is never
metric, since neither the lamp's power nor the tissue's albedo is known.

The relief of tissue, which is its depth up to a factor, is estimated by shape from shading at several times. The logarithm of
depth is a sum of cosines along the picture's sides: u = Σ c_k cos_k, z = exp(u). A surface lit by a small lamp at the camera's
centre has the brightness cos θ / r². Here θ is the angle between the surface normal and the ray, and r the distance along the
ray. With x = X / z, y = Y / z and partial derivatives ∂x, ∂y this is exactly

    r² = z² (1 + x² + y²),   cos θ = 1 / (√(1 + x² + y²) |N|),   N = (-∂x u, -∂y u, 1 + x ∂x u + y ∂y u)

(Prados and Faugeras 2005). Wet tissue shows highlights where its normal points to the lamp, that is where θ is small.

The unknowns are the relief at a key time and its change at every other time. Three cues are used:

* **Brightness** of each picture, from a mixture of its channels and from the diffuse part. Remaining pigment is modelled as
  another sum of cosines, and vignetting as a power of the cosine of the angle to the axis.
* **Change of brightness of tracked tissue** since the key time, which is independent of pigment. The total light may change.
* **Highlights** on wet tissue. Their frequency falls exponentially with the surface's angle to the lamp, at an unknown rate.

The fit is a least-squares problem over all pictures. All unknowns have Gaussian priors. The widths for relief and
changes are estimated by evidence maximisation (MacKay 1992). The maximum a posteriori is found by Gauss-Newton.
Unknowns of a single cue are eliminated from the equations of the relief.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import DepthMap, Estimator, doubted
from gsplat_core.experimental.shading import Cells, Change, Follower, ShadedPicture, Shading, shaded_picture
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, LIGHT, RELATIVE_DISTANCE, Frame

SOLVED_AT = (1, 2, 4, 8, 12)
"""Numbers of pictures in a window at which all reliefs are re-estimated jointly. At other numbers only the
newest picture's change is estimated.
"""


class LightWindow:
    """Consecutive pictures of a stream (shading and texture) whose tissue can be tracked from one of them, the key."""

    def __init__(self, grid: Grid, key: ShadedPicture, before: Sequence[ShadedPicture] = ()) -> None:
        """Create a window around a key.

        Args:
            grid: cell grid.
            key: picture from which tissue is tracked.
            before: earlier pictures in temporal order. Pictures up to the last one that cannot be tracked are dropped.
        """
        self._grid = grid
        self.pictures = [key]
        self._changes: list[Change | None] = [None]
        self._ahead, back = Follower(key), Follower(key)
        for picture in reversed(before):
            if not self._take(picture, back):
                break
        self._reliefs: list[Array] = []
        self.solve()

    def add(self, picture: ShadedPicture) -> bool:
        """Add a picture that is later than all others, and estimate its relief.

        Returns:
            True if it can be tracked; otherwise the window is unchanged.
        """
        if not self._take(picture, self._ahead):
            return False
        if len(self.pictures) in SOLVED_AT:
            self.solve()
        else:
            change, key = self._changes[-1], self._reliefs[0]
            assert change is not None
            self._reliefs.append(key + find_change(self._grid, key, change))
        return True

    def solve(self) -> None:
        """Re-estimate the reliefs of all pictures of the window jointly."""
        found = find_reliefs(self._grid, [picture.shading for picture in self.pictures], self._changes)
        self._reliefs = [found.key + change for change in found.changes]

    def relief_of(self, picture: ShadedPicture) -> Array | None:
        """Return the relief coefficients of a picture, or None if the window does not contain it."""
        pairs = zip(self.pictures, self._reliefs, strict=True)
        return next((relief for each, relief in pairs if each is picture), None)

    def _take(self, picture: ShadedPicture, follower: Follower) -> bool:
        change = follower.change_to(picture)
        if change.is_followed:
            self.pictures.append(picture)
            self._changes.append(change)
        return change.is_followed


EVERY_S = 0.3
"""Time in seconds from one depth estimate to the next. Frames in between reuse the previous result."""
MOST_PICTURES = 12
"""Largest number of pictures of one window that are fitted together."""
NEWEST = 0.2
"""Smallest weight of the newest relief in its average with the earlier, tracked relief. The first few estimates are
averaged equally.
"""
LEAST_SEEN = 0.25
"""Share of grid cells with enough well-exposed tissue below which a picture gives no depth."""
ERROR = 0.05
"""Assumed standard deviation of a picture's log brightness that is caused by pigment and model errors instead of distance."""
REACH = 0.05
"""Distance from cells with usable pixels at which the confidence halves, as a share of the picture's longer side."""
UNSEEN = "too little of the picture is well exposed tissue for depth by shading"
FLAT = "brightness does not change more than pigment could explain, so depth by shading is no better than a plane"


class LightDepth(Estimator):
    """Depth estimator by shading for one stream. It tracks the tissue while the scope does not move."""

    origin = LIGHT
    evidence = "light and shade"

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._estimated_ns, self._count = 0, 0
        self._answer: DepthMap | None = None
        self._relief: Array | None = None
        self._pose: NDArray[np.float64] | None = None
        self._window: LightWindow | None = None
        self._recent: deque[ShadedPicture] = deque(maxlen=MOST_PICTURES // 2)

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Return the depth of a frame from shading; the last result if it is younger than `EVERY_S` seconds and the
        camera has not moved. A rejected map states why the relief cannot be distinguished from a plane. None without a
        pinhole camera.
        """
        if camera.model != "pinhole":
            return None
        if frame.new_scene is not None or self._resized(frame) or self._moved(camera):
            self._forget()
        if self._answer is None or frame.pts_ns - self._estimated_ns >= EVERY_S * 1e9:
            self._answer = self._estimated(frame, camera)
            self._estimated_ns, self._pose = frame.pts_ns, camera.world_to_camera.copy()
        return self._answer

    def _resized(self, frame: Frame) -> bool:
        return self._answer is not None and self._answer.depth.shape != frame.image.shape[:2]

    def _moved(self, camera: Camera) -> bool:
        return self._pose is not None and not np.array_equal(self._pose, camera.world_to_camera)

    def _estimated(self, frame: Frame, camera: Camera) -> DepthMap:
        picture = shaded_picture(frame, camera)
        grid = Grid.of(camera, picture.shading.brightness.shape)
        if not shows_enough(picture):
            return answer(grid, None, picture, frame)
        window = self._window
        if window is None or not window.add(picture):
            window = LightWindow(grid, picture)
        elif len(window.pictures) > MOST_PICTURES:
            window = LightWindow(grid, picture, list(self._recent))
        self._window, self._count = window, self._count + 1
        found = window.relief_of(picture)
        assert found is not None
        if self._relief is not None:
            before = window.relief_of(self._recent[-1])
            followed = self._relief if before is None else self._relief + found - before
            found = followed + max(1 / self._count, NEWEST) * (found - followed)
        self._recent.append(picture)
        self._relief = found
        return answer(grid, found, picture, frame)


def shows_enough(picture: ShadedPicture) -> bool:
    """Return True if a picture has enough cells of well-exposed tissue (`LEAST_SEEN`) for depth by shading."""
    return bool(picture.shading.known.mean() >= LEAST_SEEN)


def answer(grid: Grid, relief: Array | None, picture: ShadedPicture, frame: Frame) -> DepthMap:
    """Return the depth map of a frame from its relief coefficients.

    The map is rejected, with zero confidence, if there are no coefficients or if the relief explains too little of the
    brightness.

    Args:
        grid: cell grid of the picture.
        relief: coefficients, or None if too little tissue is visible.
        picture: shading of the frame.
        frame: frame that determines the size of the map.
    """
    size = frame.image.shape[0], frame.image.shape[1]
    if relief is None:
        return doubted(size, LIGHT, UNSEEN)
    share = share_of_distance(grid, relief[None])
    return doubted(size, LIGHT, FLAT) if share < BELIEVED else shown(grid, relief, share, picture, size)


def share_of_distance(grid: Grid, reliefs: Array) -> float:
    """Return the share of brightness variance that distance explains, relative to distance plus
    expected errors, 0 to 1.

    Args:
        grid: cell grid.
        reliefs: coefficients [times, cosines].
    """
    values = Places.at(grid, *grid.middles()).value @ reliefs.T
    by_distance = float(np.mean(np.var(2 * values, axis=0)))
    return by_distance / (by_distance + ERROR**2)


def shown(grid: Grid, relief: Array, share: float, picture: ShadedPicture, size: tuple[int, int]) -> DepthMap:
    """Return the depth map of height and width `size` for a relief. `share` is the confidence in the relief as a whole, 0 to 1."""
    logarithm = (Places.at(grid, *grid.middles()).value @ relief).reshape(grid.height, grid.width)
    return DepthMap(
        _enlarged(RELATIVE_DISTANCE * np.exp(logarithm), size),
        np.asarray(np.clip(_enlarged(share * _near_seen(picture.shading), size), 0, 1), np.float32),
        LIGHT,
        metric=False,
    )


def _near_seen(shading: Shading) -> Array:
    """Return confidence weights [h, w]: 1 in cells with usable pixels, decaying to 0 with the distance from them."""
    seen = shading.known.astype(np.uint8)
    away = cv2.distanceTransform(1 - seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.asarray(np.exp2(-away / (REACH * max(seen.shape))))


def _enlarged(plane: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(plane.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR))


Array = NDArray[np.float64]
HALF_WAVES = 9
"""Number of half periods along the longer side of the finest cosine of the relief's basis."""
SOFTNESS = 0.25
"""Fill light by subsurface scattering and surrounding walls: cos θ is replaced by (cos θ + SOFTNESS) / (1 + SOFTNESS).
"""
ROUND = 0.1
"""Angle between normal and ray, in radians, below which highlights hardly depend on the angle, because fine bumps keep
parts of the tissue from facing the ray.
"""


@dataclass(frozen=True)
class Grid:
    """Cell grid of a picture with the intrinsics of its rays."""

    height: int
    width: int
    focal: tuple[float, float]
    """Focal lengths along rows and columns, in cells."""
    centre: tuple[float, float]
    """Principal point, in cells."""

    @classmethod
    def of(cls, camera: Camera, shape: tuple[int, ...]) -> Grid:
        """Return the grid of `shape` [h, w] over the whole picture of a pinhole camera."""
        across, down = shape[1] / camera.width_px, shape[0] / camera.height_px
        focal = float(camera.K[0, 0]) * across, float(camera.K[1, 1]) * down
        return cls(shape[0], shape[1], focal, (float(camera.K[0, 2]) * across, float(camera.K[1, 2]) * down))

    @property
    def waves(self) -> list[tuple[int, int, float]]:
        """Frequencies of the basis cosines, without the constant.

        Each tuple has the half periods down the picture, the half periods across it, and the magnitude of both in half
        periods per longer side.
        """
        longer = max(self.height, self.width)
        all_waves = ((j, i) for j in range(HALF_WAVES) for i in range(HALF_WAVES))
        counted = [(j, i, float(np.hypot(i * longer / self.width, j * longer / self.height))) for j, i in all_waves]
        return [(j, i, count) for j, i, count in counted if 0 < count <= HALF_WAVES]

    @property
    def half_waves(self) -> Array:
        """Frequency magnitude of each cosine in half periods per longer side, float64 [cosines]."""
        return np.array([count for _, _, count in self.waves])

    def middles(self) -> tuple[Array, Array]:
        """Return the column and the row coordinates of all cell centres, both [h, w], in cells."""
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return column, row


@dataclass(frozen=True)
class Places:
    """Positions in a picture with the values and derivatives of the relief's cosine basis at them."""

    x: Array
    """Ray coordinate x / z (tangent of the horizontal angle) at each position, [places]."""
    y: Array
    value: Array
    """Value of each basis cosine at each position, [places, cosines]."""
    by_x: Array
    """Derivative of each basis cosine by the ray coordinate x at each position, [places, cosines]."""
    by_y: Array

    @classmethod
    def at(cls, grid: Grid, column: Array, row: Array) -> Places:
        """Evaluate the relief's cosine basis at `column` and `row`, arrays of any shape in units of cells."""
        column, row = column.ravel(), row.ravel()
        order = np.arange(HALF_WAVES)
        across, down = (
            np.pi * order * (each / side)[:, None] for each, side in ((column, grid.width), (row, grid.height))
        )
        j, i = (np.array(part) for part in zip(*((j, i) for j, i, _ in grid.waves), strict=True))
        cos_across, cos_down = np.cos(across)[:, i], np.cos(down)[:, j]
        by_column = -np.sin(across)[:, i] * (np.pi / grid.width * i)
        by_row = -np.sin(down)[:, j] * (np.pi / grid.height * j)
        return cls(
            (column - grid.centre[0]) / grid.focal[0],
            (row - grid.centre[1]) / grid.focal[1],
            cos_across * cos_down,
            by_column * cos_down * grid.focal[0],
            cos_across * by_row * grid.focal[1],
        )

    @property
    def axis(self) -> Array:
        """Logarithm of the cosine of the rays' angle to the optical axis, [places]."""
        return np.asarray(-0.5 * np.log1p(self.x**2 + self.y**2))


@dataclass(frozen=True)
class Appearance:
    """Appearance (brightness and highlights) of a relief and its derivatives by the coefficients [places, cosines]."""

    lit: Array
    """Logarithm of the brightness that the relief predicts at each position, [places]."""
    lit_by: Array
    angle: Array
    """Angle between normal and ray [places], approximately in radians and rounded off near zero (`ROUND`)."""
    angle_by: Array


def appearance(places: Places, coefficients: Array, slopes: float = 1.0) -> Appearance:
    """Compute the brightness and the highlights of a relief at some places, with derivatives.

    Args:
        places: positions.
        coefficients: float64 [cosines].
        slopes: weight of the cosine term in brightness, from 0 (distance only) to 1.
    """
    x, y, axis = places.x, places.y, places.axis
    u, u_x, u_y = (basis @ coefficients for basis in (places.value, places.by_x, places.by_y))
    towards = 1 + x * u_x + y * u_y
    squared = u_x**2 + u_y**2 + towards**2
    cosine = np.exp(axis) / np.sqrt(squared)
    # Derivative of log cos θ with respect to the relief's coefficients; θ is the angle between surface normal and
    # light.
    turned = ((u_x + towards * x) / squared)[:, None] * places.by_x + ((u_y + towards * y) / squared)[
        :, None
    ] * places.by_y
    gain = slopes * cosine / (cosine + SOFTNESS)
    lit = -2 * u + slopes * np.log((cosine + SOFTNESS) / (1 + SOFTNESS)) + 2 * axis
    chord = np.sqrt(np.maximum(2 - 2 * cosine, 0) + ROUND**2)
    return Appearance(
        lit, -2 * places.value - gain[:, None] * turned, chord - ROUND, (cosine / chord)[:, None] * turned
    )


RELIEF, RELIEF_COUNT = 0.05, 100
"""Prior standard deviation of the relief coefficients of coarse cosines, and the number of pseudo-observations with which this value
enters the estimate of the standard deviation.
"""
RELIEF_LIMITS = 0.025, 2.0
CHANGE, CHANGE_COUNT, CHANGE_LIMITS = 0.03, 20, (0.005, 0.3)
"""Prior standard deviation of the relief's change between two times, its pseudo-observations, and
bounds of its estimate.
"""
FINER_HALF_WAVES, FINER_POWER = 1.5, 4.0
"""Prior standard deviations of finer cosines are multiplied by (1 + (half waves /
FINER_HALF_WAVES)²) ** (-FINER_POWER / 2).
"""
PIGMENT = 0.5
"""Prior standard deviation of the coarse cosines of remaining pigment, in units of `Shading.detail`."""
PIGMENT_HALF_WAVES = 2.0
"""Number of half waves of a cosine beyond which the prior standard deviation of its pigment falls quadratically."""
FALL_OFF, FALL_OFF_DEVIATION = 1.0, 0.5
"""Prior mean and standard deviation of the vignetting exponent: the power of the cosine of a ray's angle to the axis by which
brightness falls off. 1 for a flat (Lambertian) lamp.
"""
CHANGE_ERROR = 0.02
"""Standard deviation of a cell's change of log brightness that motion does not explain."""
CHANGES_TELL = 0.3
"""Weight of brightness changes in the estimate of the relief itself. It is below 1 because errors of neighbouring cells
are correlated and carry no relief information.
"""
RARER, RARER_DEVIATION = 12.0, 0.4
"""Prior median of the rate, per radian, at which highlights become rarer with the surface's angle to the lamp, and the prior
standard deviation of the rate's logarithm.
"""
GLINT_PICTURES = 4.0
"""Effective number of independent highlight pictures; slowly moving tissue repeats highlights at the same positions."""
GLINT_CELL_SHARE = 1 / 64
"""Assumed size of one highlight as a share of a grid cell, by which shares of pixels are converted to numbers of highlights."""
FEWEST_GLINTS = 0.3
"""Value added to the variance of a cell's number of highlights, so that it is not near 0."""
BRIGHTNESS_PICTURES = 5
"""Largest number of pictures, evenly spaced in the window, whose brightness is used as a cue for the relief."""
ROUNDS = 16
ROUNDS_OF_CHANGE = 4
ROUNDS_TO_SLOPES = 4
"""Number of Gauss-Newton rounds over which the cosine of the incidence angle is faded into the brightness model. Brightness by
distance alone is linear in the unknowns, so the fit starts with it. Highlights are used after these rounds.
"""
DAMPING = 0.6
"""Factor on the Gauss-Newton steps once highlights are used, because they make the problem strongly non-linear."""


@dataclass(frozen=True)
class Reliefs:
    """Reliefs of a window: cosine coefficients of log depth at the key time (the reference), and their change at other times."""

    key: Array
    """Relief coefficients at the key time, one for each basis cosine, [cosines]."""
    changes: Array
    """Difference of the relief coefficients at each time from those at the key time, [times, cosines]."""


class Equations:
    """Normal equations of one cue (brightness, tracked tissue or highlights) for a step of the relief's coefficients.
    The cue's own unknowns, which no other cue has, are eliminated.
    """

    def __init__(
        self, own: Array, relief: Array, off: Array, weight: Array, prior: Array, away: Array, tell: float = 1.0
    ) -> None:
        """Set up the equations from a linearised cue.

        Args:
            own: derivatives by the cue's own unknowns [N, M].
            relief: derivatives by the relief's coefficients [N, cosines].
            off: residuals [N].
            weight: weights [N].
            prior: inverse prior variances of the cue's own unknowns [M].
            away: deviation of the cue's own unknowns from their prior means [M].
            tell: weight of the cue for the relief.
        """
        weighted = own * weight[:, None]
        self.inverse = np.linalg.inv(own.T @ weighted + np.diag(prior))
        self._right = weighted.T @ off - prior * away
        self._mixed = weighted.T @ relief
        gain = self._mixed.T @ self.inverse
        self.information = tell * (relief.T @ (relief * weight[:, None]) - gain @ self._mixed)
        self.pull = tell * (relief.T @ (weight * off) - gain @ self._right)

    def own_step(self, step: Array) -> Array:
        """Return the Gauss-Newton step of the cue's own unknowns [M] for a step of the relief's coefficients [cosines]."""
        return np.asarray(self.inverse @ (self._right - self._mixed @ step))


class Brightness:
    """Cue from the brightness of several pictures, which have pigment and light in common."""

    def __init__(self, grid: Grid, shadings: Sequence[Cells], times: Sequence[int], counts: float) -> None:
        """Set up the brightness cue.

        Args:
            grid: cell grid.
            shadings: brightness of each picture.
            times: time index of each picture.
            counts: weight of this kind of brightness among all kinds.
        """
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
        """Return the cue's normal equations, linearised at the current reliefs: `key` plus each of `changes`."""
        shown = [
            appearance(each, key + changes[time], slopes) for each, time in zip(self._places, self._times, strict=True)
        ]
        off = self._seen - np.concatenate([each.lit for each in shown]) - self._design @ self._own
        weight = self._weight / np.sqrt(1 + off * off * self._noise)
        by_relief = np.concatenate([each.lit_by for each in shown])
        self._last = Equations(self._design, by_relief, off, weight, self._prior, self._own - self._expected)
        return self._last

    def take(self, step: Array) -> None:
        """Update the estimates of pigment and light after a step of the relief."""
        self._own = self._own + self._last.own_step(step)


class Followed:
    """Cue from the brightness change of tracked tissue between the key time and another time."""

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
        """Return the cue's normal equations, linearised at the current relief `key` and its `change`."""
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
        """Update the estimated change of the light, in log brightness, after a step of the key relief.

        Args:
            step: step of the key relief's coefficients [cosines].

        Returns:
            Resulting step of the coefficients [cosines] of the relief's change from the key time to the other time.
        """
        own = self._last.own_step(step)
        self._light += float(own[-1])
        return own[:-1]


class Glints:
    """Cue from the number of highlights in each cell at each time."""

    def __init__(self, grid: Grid, shadings: Sequence[Shading]) -> None:
        self._places = Places.at(grid, *grid.middles())
        self._counted = np.concatenate([each.wet_share.ravel() / GLINT_CELL_SHARE for each in shadings])
        self._seen = np.concatenate([each.glints.ravel() / GLINT_CELL_SHARE for each in shadings])
        self._own, self._spread = np.array([np.log(0.05), np.log(RARER)]), 1.0
        self._prior = np.array([1e-3, RARER_DEVIATION**-2])
        self._share_used = min(GLINT_PICTURES, len(shadings)) / len(shadings)

    def equations(self, key: Array, changes: Array) -> Equations:
        """Return the cue's normal equations, linearised at the current reliefs: `key` plus each of `changes`."""
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
        weight = wide * counted * self._share_used / self._spread
        self._spread = max(1.0, float(np.sum((off * off * wide)[counted]) / max(int(counted.sum()), 1)))
        own = np.stack([np.ones_like(angle), -rarer * angle], axis=1)
        self._last = Equations(own, -rarer * by_relief, off, weight, self._prior, self._own - [0, np.log(RARER)])
        return self._last

    def take(self, step: Array) -> None:
        """Update the estimated frequency of highlights after a step of the relief."""
        self._own = self._own + np.clip(self._last.own_step(step), -1, 1)


def find_reliefs(grid: Grid, shadings: Sequence[Shading], followed: Sequence[Change | None]) -> Reliefs:
    """Estimate the most probable reliefs of several times.

    Args:
        grid: cell grid.
        shadings: shading of each time.
        followed: brightness change since the key time for each time. None at the key time, and
            where tracking failed; the relief of such a time is taken as that of the key.
    """
    times = np.unique(np.linspace(0, len(shadings) - 1, BRIGHTNESS_PICTURES).round().astype(int)).tolist()
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
    """Return the change of the coefficients [cosines] for one time, with the relief of the key time fixed."""
    followed, added = Followed(grid, change), np.zeros(len(key))
    for _ in range(ROUNDS_OF_CHANGE):
        followed.equations(key, added)
        added = added + followed.take(np.zeros(len(key)))
    return added


def _finer(grid: Grid) -> Array:
    """Return for each cosine the factor on its prior standard deviation, which is smaller for finer cosines, [cosines]."""
    return np.asarray((1 + (grid.half_waves / FINER_HALF_WAVES) ** 2) ** (-FINER_POWER / 2))


def _width(scaled: Array, undecided: Array, usual: float, count: float, limits: tuple[float, float]) -> float:
    """Return the prior standard deviation of coefficients that maximises the evidence. `undecided` is the ratio of
    posterior to prior variance of each coefficient.
    """
    decided = float(np.sum(1 - undecided))
    variance = (float(scaled @ scaled) + count * usual**2) / (decided + count)
    return float(np.clip(np.sqrt(variance), *limits))
