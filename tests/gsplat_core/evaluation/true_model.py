"""A model of a synthetic scene that is right by construction: a Gaussian on each pixel's material point, moved as the tissue moves."""

from __future__ import annotations

import numpy as np
import torch

from gsplat_core.deformation.field import DeformationField
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.models import Model
from gsplat_core.scene.gaussians import SH_C0, Gaussians


class TrueMotion(DeformationField):
    """Moves each Gaussian with its material point; lengths are divided by `shrink`."""

    kind = "true-motion"

    def __init__(self, scene: SyntheticScene, u: np.ndarray, v: np.ndarray, end_s: float, shrink: float) -> None:
        super().__init__((0.0, end_s))
        self._scene, self._u, self._v, self._shrink = scene, u, v, shrink

    def means(self, time_s: float) -> torch.Tensor:
        points = self._scene.tissue.points(self._u, self._v, time_s, self._scene.tug(time_s))
        return torch.from_numpy(np.stack(points.position, axis=1).astype(np.float32)) / self._shrink

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        return Gaussians(**{**gaussians.tensors(), "means": self.means(self.clamp_time(time_s))})


def true_model(scene: SyntheticScene, end_s: float, shrink: float = 1.0, moves: bool = True) -> Model:
    """The scene as its left camera sees it at time 0; `shrink` makes all lengths smaller, without `moves` it stays as it is then."""
    eye = scene.render(0.0)
    u, v = eye.u.ravel(), eye.v.ravel()
    field = TrueMotion(scene, u, v, end_s, shrink)
    means = field.means(0.0)
    count = len(means)
    spacing = means[:, 2] / float(scene.camera.K[0, 0])
    colour = torch.from_numpy(eye.image.reshape(-1, 3).astype(np.float32) / 255)
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scales=(0.45 * spacing).log()[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), 4.0),
        sh=((colour - 0.5) / SH_C0)[:, None],
    )
    return Model(1, gaussians, field if moves else None, scene.camera, (0.0, end_s))
