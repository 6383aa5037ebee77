"""Loading of models by path: a bundle folder, or a static splat file (`.ply`, `.splat`, `.spz`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, BundleError
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.exports.files import ROW
from gsplat_core.io.model_files import check_memory, gaussians_of, logit_of_bytes, open_model_file, read_rows
from gsplat_core.io.ply import load_ply
from gsplat_core.io.spz import load_spz
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

WIDTH_PX, HEIGHT_PX = 640, 512
FIELD_OF_VIEW = 0.9
"""Vertical field of view of the default camera of a splat file: height of the visible area divided by its distance."""
SHOWN_SHARE = 0.9
"""Share of the Gaussians inside the sphere that determines the default camera's distance; the others are outliers. The sphere fills
the height of the picture.
"""
WINDOW_S = (0.0, 4.0)
"""Time window in seconds that a splat file, which has no time, gets as a model: the duration of one turn of an orbit."""
LEAST_RADIUS = 0.02
"""Smallest accepted radius of a splat file's scene, in the file's unit; the rasterizer's near plane would cut a smaller scene."""
MOST_PLACED = 1_000_000
"""Largest number of Gaussians from which the default camera is computed. In a larger file, only every k-th Gaussian is used."""
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
        count = size // ROW.itemsize
        check_memory(path, 4 * 14 * count)
        means, quats, log_scales = (np.empty((count, width), np.float32) for width in (3, 4, 3))
        logits, sh = np.empty(count, np.float32), np.empty((count, 1, 3), np.float32)

        def take(first: int, rows: NDArray[np.void]) -> None:
            part = slice(first, first + len(rows))
            for name in ("position", "scale"):
                is_wrong = ~np.isfinite(rows[name])
                if name == "scale":
                    is_wrong |= rows[name] < 0
                if is_wrong.any():
                    raise BundleCorrupt(
                        f"{path}: {int(is_wrong.sum())} values of {name} are NaN, infinite or negative (first:"
                        f" {rows[name][is_wrong][0]:g}); it is no .splat file"
                    )
            means[part], log_scales[part] = rows["position"], np.log(np.maximum(rows["scale"], 1e-20))
            quats[part] = (rows["rotation"].astype(np.float32) - 128) / 128
            logits[part] = logit_of_bytes(rows["colour"][:, 3])
            sh[part, 0] = (rows["colour"][:, :3] / np.float32(255) - 0.5) / SH_C0

        read_rows(file.fileno(), path, 0, ROW, count, take)
    return gaussians_of(means, quats, log_scales, logits, sh)


READERS: Mapping[str, Callable[[Path], Gaussians]] = {".ply": load_ply, ".splat": load_splat, ".spz": load_spz}
"""Function that reads the Gaussians of a splat file, by the suffix of the file name."""


def is_scene_file(path: Path) -> bool:
    """Return True if the path has the suffix of a splat file, which has Gaussians but neither camera nor time."""
    return path.suffix.lower() in READERS and not path.is_dir()


def load_model(path: Path) -> Model:
    """Load a model from a bundle or a splat file.

    Args:
        path: bundle folder, or a `.ply`, `.splat` or `.spz` file. A splat file becomes a static scene with
            a camera that shows all of it.

    Raises:
        BundleError: if no usable model is found; see `load_bundle` and `load_ply`.
    """
    if not is_scene_file(path):
        if path.exists() and not path.is_dir():
            raise BundleError(
                f"{path} is no model; give a model folder, a packed model (.isplat) where it is taken, or a {', '.join(READERS)} file"
            )
        return load_bundle(path)
    return static_model(READERS[path.suffix.lower()](path), path)


def static_model(gaussians: Gaussians, path: Path) -> Model:
    """Return a model that does not move, with a camera that shows all of it except outliers.

    Args:
        gaussians: Gaussians of the model.
        path: file of the Gaussians, for error messages.

    Raises:
        BundleCorrupt: if there are no Gaussians, or they cannot be shown.
    """
    if gaussians.count == 0:
        raise BundleCorrupt(f"{path} holds no Gaussians; there is nothing to show")
    if (wrong := wrong_extent(gaussians)) is not None:
        raise BundleCorrupt(f"{path} {wrong}; export it in another unit")
    return Model(1, gaussians, None, _camera_for(gaussians), WINDOW_S)


def wrong_extent(gaussians: Gaussians) -> str | None:
    """Return why Gaussians are too far away, too large or too close together to be shown, as a predicate; None if they
    can be shown.
    """
    for name, values, most in (
        ("position", gaussians.means, MOST_COORDINATE),
        ("scale", gaussians.log_scales, MOST_LOG_SCALE),
    ):
        found = float(values.max() if name == "scale" else max(values.max(), -values.min()))
        if found > most:
            shown = f"exp({found:.3g})" if name == "scale" else f"{found:.3g}"
            return f"holds a {name} of {shown}, beyond what can be shown"
    _, radius = _sphere_of(gaussians)
    return f"is {2 * radius:.3g} across, too small to be shown" if radius < LEAST_RADIUS else None


def _sphere_of(gaussians: Gaussians) -> tuple[NDArray[np.float64], float]:
    """Return centre and radius of a sphere around all Gaussians except outliers."""
    every = slice(None, None, -(-gaussians.count // MOST_PLACED))
    means: NDArray[np.float64] = gaussians.means[every].numpy().astype(np.float64)
    centre = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), SHOWN_SHARE))
    size = float(np.exp(np.median(gaussians.log_scales[every].numpy().astype(np.float64))))
    return centre, max(radius, 3 * size)


def _camera_for(gaussians: Gaussians) -> Camera:
    """Return a camera that looks along z at all Gaussians except outliers."""
    centre, radius = _sphere_of(gaussians)
    pose = np.eye(4)
    pose[:3, 3] = -centre + [0, 0, 2 * radius / FIELD_OF_VIEW]
    return Camera.from_focal(HEIGHT_PX / FIELD_OF_VIEW, WIDTH_PX, HEIGHT_PX).with_pose(pose)
