"""Relocation of highlights for cameras away from the scope.

Wet tissue's colour depends on the half-way direction between light and eye. Training saw the tissue only with the light next to the camera.

Dependence of wet tissue's colour on the half-way direction between light and eye.

A highlight appears where the half-way direction equals the normal of the microscopically rough surface. Directions
are expressed in the surface's tangent frame. Colours observed while the tissue or the scope moved therefore predict
the colours seen from elsewhere. Each point's colour over time is modelled by Gaussian process regression (Rasmussen
and Williams 2006, chapters 2 and 5) as the sum of a function of direction, a slow function of time, and noise.

The light moves with the scope. A model reproduces the colours seen by the scope's left eye, including highlights,
from any viewpoint; true highlights depend on the viewpoint. The dependence of each Gaussian's colour on the half-way
direction is learned from the model's own colours over time, because breathing tissue and a moving scope
vary that direction. The computation runs on the host and is identical for all devices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.scene.scope_path import ScopePath
from gsplat_core.scene.tangents import Tangents, at_positions

if TYPE_CHECKING:
    from gsplat_core.scene.model import Model


Array = NDArray[np.floating]
LOBES = ((1.0, 0.06), (1.5, 0.15))
"""Prior variances and length scales (sine of the angle) of glints and of the broad sheen."""
SLOW, SLOW_S = 0.5, 0.6
"""Variance and correlation time in seconds of the slow component: shadows and drifting points."""
NOISE = 0.3
UNKNOWN = 1e4
"""Noise variance at times at which a point was not visible."""
CONSTANT = 10.0
"""Prior variance of a point's mean colour around the mean of the observations."""
ROWS_AT_ONCE = 4096
"""Number of points processed at once, to bound memory."""


class Sheen:
    """Colour model learned from N points at T times."""

    def __init__(self, halves: Array, colours: Array, seen: NDArray[np.bool_], times_s: Array, weights: Array) -> None:
        """Fit the model.

        Args:
            halves: half-way directions [N, T, 2].
            colours: observed colours [N, T, 3].
            seen: validity of the observations, bool [N, T].
            times_s: times [T] in seconds.
            weights: weight [N] of each point in the skill.
        """
        self._halves = halves.astype(np.float32)
        weight = seen[..., None] / np.maximum(seen.sum(axis=1), 1)[:, None, None]
        off = (colours - (weight * colours).sum(axis=1, keepdims=True)) * seen[..., None]
        apart = (times_s[:, None] - times_s) / SLOW_S
        self._slow = SLOW * np.exp(-0.5 * apart**2) + CONSTANT
        self._strengths = np.zeros((*seen.shape, 3), np.float32)
        left = total = 0.0
        for start in range(0, len(seen), ROWS_AT_ONCE):
            rows = slice(start, start + ROWS_AT_ONCE)
            inverse = np.linalg.inv(self._covariance(halves[rows], seen[rows]))
            strengths = inverse @ off[rows]
            # Leave-one-out residual of each observation.
            missed = strengths / np.diagonal(inverse, axis1=1, axis2=2)[..., None] * seen[rows, :, None]
            left += float((weights[rows] * np.square(missed).sum(axis=(1, 2))).sum())
            total += float((weights[rows] * np.square(off[rows]).sum(axis=(1, 2))).sum())
            self._strengths[rows] = strengths * seen[rows, :, None]
        self.skill = max(0.0, 1 - left / total) if total > 0 else 0.0
        """Share of the colour variance over time that leave-one-out prediction explains, 0 to 1."""

    def difference(self, halves: Array, instead_of: Array) -> NDArray[np.float32]:
        """Return the predicted colour change [N, 3] between two half-way directions [N, 2].

        The change is scaled by `skill`.
        """
        return np.asarray(self.skill * (self._at(halves) - self._at(instead_of)), np.float32)

    def _at(self, halves: Array) -> Array:
        alike = _alike(self._halves - halves.astype(np.float32)[:, None])
        return np.asarray(np.einsum("nt,ntc->nc", alike, self._strengths))

    def _covariance(self, halves: Array, seen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the covariance of each point's observations [n, T, T]."""
        noise = np.where(seen, NOISE, UNKNOWN)[:, None] * np.eye(seen.shape[1])
        return np.asarray(_alike(halves[:, :, None] - halves[:, None]) + self._slow + noise, np.float64)


def _alike(apart: Array) -> Array:
    """Return the covariance [...] of colours whose directions differ by `apart` [..., 2]."""
    squared = np.square(apart).sum(axis=-1)
    return np.asarray(sum(variance * np.exp(squared * (-0.5 / reach**2)) for variance, reach in LOBES))


def half_directions(tangents: Array, points: Array, light: Array, eye: Array) -> Array:
    """Return the half-way directions between light and eye in the points' tangents, [N, 2].

    Args:
        tangents: unit tangents [N, 2, 3].
        points: positions [N, 3].
        light: position of the light [3].
        eye: position of the eye [3].
    """
    half = _unit(_unit(light - points) + _unit(eye - points))
    return np.asarray(np.einsum("nij,nj->ni", tangents, half))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


SAME_PLACE = 1e-3
"""Distance from the scope's eye, as a share of the tissue distance, below which views are equal."""
BEHIND = 1.1
"""Ratio of a point's depth to the rendered depth above which the point counts as occluded."""
LEAST_TIMES = 4
"""Minimum number of observation times for learning."""


@dataclass(frozen=True)
class Look:
    """Observation of each Gaussian by the scope's eye at one time."""

    halves: Array
    """[N, 2]."""
    colours: Array
    """[N, 3]."""
    seen: NDArray[np.bool_]
    """[N]."""


class SeenFromElsewhere:
    """Predictor of a model's colours for cameras away from the scope."""

    def __init__(self, model: Model, path: ScopePath) -> None:
        self._model, self._path = model, path
        first = model.at(path.times_s[0])
        pixels, z = _projected(model.camera.with_pose(path.pose(0)), _host(first.means))
        longer_px = max(model.camera.width_px, model.camera.height_px)
        opacities = _host(first.opacities)
        self._tangents = Tangents(np.where(z[:, None] > 0, pixels, np.nan), opacities, longer_px)
        looks = [self._look(number) for number in range(len(path.times_s))]
        halves, colours, seen = (
            np.stack([getattr(look, name) for look in looks], 1) for name in ("halves", "colours", "seen")
        )
        self._sheen = Sheen(halves, colours, seen, np.array(path.times_s), opacities)

    @classmethod
    def of(cls, model: Model) -> SeenFromElsewhere | None:
        """Create the predictor for a model.

        Returns:
            None without scope trajectory, without deformation, or for cameras other than pinhole.
        """
        path = model.scope_path
        if path is None or len(path.times_s) < LEAST_TIMES or model.field is None:
            return None
        return cls(model, path) if model.camera.model == "pinhole" and model.gaussians.count else None

    @property
    def skill(self) -> float:
        """Explained share of colour variance; see `Sheen`."""
        return self._sheen.skill

    def at(self, camera: Camera, time_s: float) -> Gaussians:
        """Return the Gaussians at a time with the colours that `camera` sees.

        For a camera at the position of the scope's left eye, these are the colours of that eye.
        """
        now = self._model.at(time_s)
        points, light, eye = _host(now.means), self._path.centre_at(time_s), camera.position
        if np.linalg.norm(eye - light) <= SAME_PLACE * np.median(np.linalg.norm(points - light, axis=1)):
            return now
        tangents = self._tangents(points)
        theirs, own = (half_directions(tangents, points, light, place) for place in (eye, light))
        sh = now.sh.clone()
        sh[:, 0] += torch.from_numpy(self._sheen.difference(theirs, own) / np.float32(SH_C0)).to(sh)
        return replace(now, sh=sh, right_sh=None)

    def _look(self, number: int) -> Look:
        """Render the model from the scope's pose at one time of its path and sample
        each Gaussian.
        """
        camera = self._model.camera.with_pose(self._path.pose(number))
        now = self._model.at(self._path.times_s[number])
        with torch.no_grad():
            picture = render(now, camera)
        points, eye = _host(now.means), camera.position
        pixels, z = _projected(camera, points)
        inside = (
            (z > 0)
            & (pixels >= 0.5).all(axis=1)
            & (pixels <= (camera.width_px - 0.5, camera.height_px - 0.5)).all(axis=1)
        )
        pixels = np.where(inside[:, None], pixels, 0.5)
        depth = at_positions(_host(picture.depth)[..., None], pixels)[:, 0]
        colours = at_positions(_host(picture.image).clip(0, 1), pixels)
        halves = half_directions(self._tangents(points), points, eye, eye)
        return Look(halves, colours, inside & (depth > 0) & (z <= BEHIND * depth))


def _host(tensor: torch.Tensor) -> NDArray[np.float64]:
    return np.asarray(tensor.detach().cpu().numpy(), np.float64)


def _projected(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Project points [N, 3] to pixels [N, 2] and depth [N]; pixels are valid for positive depth."""
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    z = local[:, 2]
    pixels = local[:, :2] / np.where(z > 0, z, 1.0)[:, None] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    return np.asarray(pixels), np.asarray(z)
