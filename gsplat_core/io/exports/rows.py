"""Gaussians as arrays of what other programs expect: unit rotations, scales and opacities after their activation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import ExportError
from gsplat_core.scene.gaussians import Gaussians

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Rows:
    """N Gaussians on the host, float32."""

    means: Array
    """[N, 3]."""
    rotations: Array
    """Unit quaternions wxyz [N, 4]; of length 0 before: no rotation."""
    scales: Array
    """Standard deviations [N, 3]."""
    opacities: Array
    """0 to 1, [N]."""
    sh: Array
    """[N, K, 3]."""


def rows_of(gaussians: Gaussians) -> Rows:
    """Raises ExportError where a value is not finite."""
    raw = {name: tensor.detach().cpu().float().numpy() for name, tensor in gaussians.tensors().items()}
    for name, values in raw.items():
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            raise ExportError(f"{name} holds {bad} values that are NaN or infinite; such a model is not exported")
    with np.errstate(over="ignore"):
        scales = np.exp(raw["log_scales"])
    if not np.isfinite(scales).all():
        raise ExportError("a Gaussian's size is beyond float32; such a model is not exported")
    opacities = gaussians.opacities.detach().cpu().float().numpy()
    return Rows(raw["means"], unit_rotations(raw["quats"]), scales, opacities, raw["sh"])


def unit_rotations(quats: Array) -> Array:
    """Quaternions wxyz of length 1."""
    # The largest part first: squares of small numbers are 0 in float32.
    largest = np.abs(quats).max(axis=1, keepdims=True)
    none = largest[:, 0] == 0
    scaled = np.where(none[:, None], np.array([1, 0, 0, 0], np.float32), quats / np.where(largest == 0, 1, largest))
    return np.asarray(scaled / np.linalg.norm(scaled, axis=1, keepdims=True), np.float32)
