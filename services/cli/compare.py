"""`intrasplat compare`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.closest import ClosestPoints
from gsplat_core.geometry.mesh import mesh_of
from gsplat_core.geometry.registration import distances, from_pairs, moved_by, register
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.surface_files import read_surface
from services.cli.exit_codes import OK

INLIER_SHARE = 0.02
"""Of the surface's extent: an inlier's distance unless it is given."""


def compare_command(
    model: Path, mesh: Path, time_s: float | None, pairs: str | None, inlier: float | None, *, as_json: bool
) -> int:
    """Lay a model's surface onto a mesh and print how far apart they are.

    Raises BundleError where the model cannot be used, InvalidSetting for a mesh or pairs that cannot, and where the surfaces decide nothing.
    """
    if inlier is not None and not 0 < inlier < float("inf"):
        raise InvalidSetting(f"the distance of inliers is {inlier:g}; it must be positive")
    loaded = load_bundle(model)
    if pairs is None and not loaded.metric:
        raise InvalidSetting(
            "the model's lengths have no known unit, so that its size beside the mesh is not known; give --pairs, three or more"
        )
    time_s = loaded.time_window_s[1] if time_s is None else time_s
    seen = mesh_of(loaded, time_s)
    surface = ClosestPoints(*read_surface(mesh))
    initial = None if pairs is None else from_pairs(*_read_pairs(pairs), with_scale=not loaded.metric)
    points = seen.vertices.astype(np.float64)
    found = register(points, surface, initial)
    _, summary = distances(moved_by(found.transform, points), surface, inlier or INLIER_SHARE * surface.extent)
    said = {
        "unit": "the mesh's",
        "metric": loaded.metric,
        "time_s": time_s,
        "registration": {**asdict(found), "transform": found.transform.tolist()},
        "signed_distances": asdict(summary),
    }
    if as_json:
        typer.echo(json.dumps(said, indent=2))
    else:
        typer.echo(
            f"{summary.points} points, in the mesh's unit: mean {summary.mean:+.3f}, RMSE {summary.rmse:.3f}, half within"
            f" {summary.absolute_p50:.3f}, 90 % within {summary.absolute_p90:.3f}, 95 % within {summary.absolute_p95:.3f};"
            f" {summary.inlier_share:.1%} are closer than {summary.inlier_distance:.3g}"
        )
    return OK


def _read_pairs(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Points of the model and of the mesh from "x,y,z=x,y,z; ...". Raises InvalidSetting."""
    try:
        values = np.array([[side.split(",") for side in pair.split("=")] for pair in text.split(";")], np.float64)
    except ValueError as error:
        raise InvalidSetting(f"the pairs {text!r:.80} cannot be read; give x,y,z=x,y,z;... (model = mesh)") from error
    if values.ndim != 3 or values.shape[1:] != (2, 3) or not np.isfinite(values).all():
        raise InvalidSetting(f"the pairs {text!r:.80} cannot be read; give x,y,z=x,y,z;... (model = mesh)")
    return values[:, 0], values[:, 1]
