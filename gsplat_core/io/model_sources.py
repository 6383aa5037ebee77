"""Loading of models by path: a bundle folder, or a static splat file (`.ply`, `.splat`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, BundleError
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.exports.files import ROW
from gsplat_core.io.model_files import check_memory, open_model_file
from gsplat_core.io.ply import load_ply
from gsplat_core.models.model import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

WIDTH_PX, HEIGHT_PX = 640, 512
FIELD_OF_VIEW = 0.9
"""Image width over distance of the default camera for a splat file."""
SHOWN_SHARE = 0.9
"""Share of the Gaussians inside the sphere that the default camera shows completely."""
WINDOW_S = (0.0, 4.0)
"""Time window in seconds of a splat file: one turn of an orbit."""
LEAST_RADIUS = 0.02
"""Smallest displayable scene radius, because of the near plane of the rasterizer."""
MOST_COORDINATE = 1e9
MOST_LOG_SCALE = 20.0


def load_splat(path: Path) -> Gaussians:
    """Load the Gaussians of a `.splat` file, which has no view-dependent colour.

    Raises:
        BundleError: if the file cannot be read.
        BundleCorrupt: if values are not finite.
    """
    with open_model_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size % ROW.itemsize:
            raise BundleCorrupt(
                f"{path} has {size} bytes, no multiple of {ROW.itemsize}: it is no .splat file, or was cut short"
            )
        check_memory(path, 8 * size)
        rows = np.frombuffer(file.read(size), ROW)
    for name in ("position", "scale"):
        bad = int(np.count_nonzero(~np.isfinite(rows[name])))
        if bad or (name == "scale" and (rows[name] < 0).any()):
            raise BundleCorrupt(
                f"{path}: {bad} values of {name} are NaN or infinite, or scales are negative; it is no .splat file"
            )
    opacity = np.clip(rows["colour"][:, 3] / 255.0, 1e-4, 1 - 1e-4)
    arrays = (
        rows["position"],
        (rows["rotation"].astype(np.float32) - 128) / 128,
        np.log(np.maximum(rows["scale"], 1e-20)),
        np.log(opacity / (1 - opacity)),
        ((rows["colour"][:, :3] / 255.0 - 0.5) / SH_C0)[:, None],
    )
    return Gaussians(*(torch.from_numpy(np.array(array, np.float32)) for array in arrays))


READERS: Mapping[str, Callable[[Path], Gaussians]] = {".ply": load_ply, ".splat": load_splat}
"""Readers of splat files by suffix."""


def is_scene_file(path: Path) -> bool:
    """Return True for the suffix of a splat file, which has neither camera nor time."""
    return path.suffix.lower() in READERS and not path.is_dir()


def load_model(path: Path) -> Model:
    """Load a model from a bundle or a splat file.

    Args:
        path: bundle folder, or a `.ply` or `.splat` file. A splat file becomes a static scene with
            a camera that shows all of it.

    Raises:
        BundleError: if no usable model is found; see `load_bundle` and `load_ply`.
    """
    if not is_scene_file(path):
        if path.exists() and not path.is_dir():
            raise BundleError(
                f"{path} is no model; give a model folder, a packed model (.isplat) where it is taken, or a {' or '.join(READERS)} file"
            )
        return load_bundle(path)
    gaussians = READERS[path.suffix.lower()](path)
    if gaussians.count == 0:
        raise BundleCorrupt(f"{path} holds no Gaussians; there is nothing to show")
    for name, values, most in (
        ("position", gaussians.means, MOST_COORDINATE),
        ("scale", gaussians.log_scales, MOST_LOG_SCALE),
    ):
        found = float(values.max() if name == "scale" else values.abs().max())
        if found > most:
            shown = f"exp({found:.3g})" if name == "scale" else f"{found:.3g}"
            raise BundleCorrupt(f"{path} holds a {name} of {shown}, beyond what can be shown; export it again")
    return Model(1, gaussians, None, _camera_for(gaussians, path), WINDOW_S)


def _camera_for(gaussians: Gaussians, path: Path) -> Camera:
    """Return a camera that looks along z at all Gaussians except outliers.

    Raises:
        BundleCorrupt: if the scene is too small for the camera's near plane.
    """
    means: NDArray[np.float64] = gaussians.means.numpy().astype(np.float64)
    centre = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), SHOWN_SHARE))
    size = float(np.exp(np.median(gaussians.log_scales.numpy().astype(np.float64))))
    radius = max(radius, 3 * size)
    if radius < LEAST_RADIUS:
        raise BundleCorrupt(f"{path} is {2 * radius:.3g} across, too small to be shown; export it in a smaller unit")
    pose = np.eye(4)
    pose[:3, 3] = -centre + [0, 0, 2 * radius / FIELD_OF_VIEW]
    return Camera.from_focal(HEIGHT_PX / FIELD_OF_VIEW, WIDTH_PX, HEIGHT_PX).with_pose(pose)
