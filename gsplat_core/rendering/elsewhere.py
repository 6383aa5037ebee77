"""Relocation of highlights for cameras away from the scope.

The light moves with the scope. A model reproduces the colours seen by the scope's left eye,
including highlights, from any viewpoint; true highlights depend on the viewpoint. The dependence of
each Gaussian's colour on the half-way direction is learned from the model's own colours over time
(`sheen`), because breathing tissue and a moving scope vary that direction. The computation runs on
the host and is identical for all devices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import render
from gsplat_core.rendering.sheen import Sheen, half_directions
from gsplat_core.scene.bilinear import at_positions
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.scene.scope_path import ScopePath
from gsplat_core.scene.tangents import Tangents

if TYPE_CHECKING:
    from gsplat_core.scene.model import Model

Array = NDArray[np.floating]

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
