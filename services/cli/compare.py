"""Implementation of `intrasplat compare`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.mesh import mesh_of
from gsplat_core.geometry.registration import ClosestPoints, distances, from_pairs, moved_by, register
from gsplat_core.io.model_sources import load_model
from gsplat_core.io.surface_files import read_surface
from services.cli.exit_codes import BAD_INPUT, OK

INLIER_SHARE = 0.02
"""Default inlier distance as a share of the surface's extent."""
MOST_SIZE_RATIO = 20.0
"""Largest size ratio of two surfaces aligned without point pairs."""
MOST_SCALE = 1.25
"""Largest ratio of point pair distances between the mesh and a metric model."""
LEAST_INLIERS = 0.05
"""Share of inliers below which two surfaces do not match."""


def compare_command(
    model: Path, mesh: Path, time_s: float | None, pairs: str | None, inlier: float | None, *, as_json: bool
) -> int:
    """Align a model's surface to a mesh and print the distances.

    Raises:
        BundleError: if the model cannot be used.
        InvalidSetting: if the mesh or the pairs cannot be used, or the alignment is ambiguous.
    """
    if inlier is not None and not 0 < inlier < float("inf"):
        raise InvalidSetting(f"the distance of inliers is {inlier:g}; it must be positive")
    loaded = load_model(model)
    if pairs is None and not loaded.metric:
        raise InvalidSetting(
            "the model's lengths have no known unit, so that its size beside the mesh is not known; give --pairs, three or more"
        )
    time_s = loaded.time_window_s[1] if time_s is None else time_s
    loaded.check_time(time_s)
    seen = mesh_of(loaded, time_s)
    surface = ClosestPoints(*read_surface(mesh))
    points = seen.vertices.astype(np.float64)
    if pairs is None:
        initial = None
        _check_sizes(points, surface)
    else:
        model_points, mesh_points = _read_pairs(pairs)
        initial = from_pairs(model_points, mesh_points, with_scale=not loaded.metric)
        if loaded.metric:
            _check_scale(from_pairs(model_points, mesh_points, with_scale=True))
    found = register(points, surface, initial)
    _, summary = distances(moved_by(found.transform, points), surface, inlier or INLIER_SHARE * surface.extent)
    lies_apart = summary.inlier_share < LEAST_INLIERS
    said = {
        "unit": "the mesh's",
        "metric": loaded.metric,
        "time_s": time_s,
        "registration": {**asdict(found), "transform": found.transform.tolist()},
        "signed_distances": asdict(summary),
        "surfaces_match": not lies_apart,
    }
    if as_json:
        typer.echo(json.dumps(said, indent=2))
    else:
        typer.echo(
            f"{summary.points} points, in the mesh's unit: mean {summary.mean:+.3f}, RMSE {summary.rmse:.3f}, half within"
            f" {summary.absolute_p50:.3f}, 90 % within {summary.absolute_p90:.3f}, 95 % within {summary.absolute_p95:.3f};"
            f" {summary.inlier_share:.1%} are closer than {summary.inlier_distance:.3g}"
        )
    if lies_apart:
        typer.echo(
            f"error: the surfaces do not lie on each other: only {summary.inlier_share:.1%} of the points are closer than"
            f" {summary.inlier_distance:.3g}; give --pairs, or check that both have the same unit",
            err=True,
        )
        return BAD_INPUT
    return OK


def _check_sizes(points: np.ndarray, surface: ClosestPoints) -> None:
    """Check that two surfaces have similar sizes.

    Raises:
        InvalidSetting: if the sizes suggest different units.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not surface.extent / MOST_SIZE_RATIO < extent < surface.extent * MOST_SIZE_RATIO:
        raise InvalidSetting(
            f"the model's surface is {extent:.3g} mm across and the mesh {surface.extent:.3g}, a factor of {surface.extent / max(extent, 1e-300):.3g}:"
            " they cannot have the same unit; export the mesh in millimetres, or give --pairs where the model shows a small part of it"
        )


def _check_scale(with_scale: np.ndarray) -> None:
    """Check that the point pairs have similar distances in the mesh and in a metric model.

    Raises:
        InvalidSetting: if the scales differ.
    """
    scale = float(np.cbrt(np.linalg.det(with_scale[:3, :3])))
    if not 1 / MOST_SCALE < scale < MOST_SCALE:
        raise InvalidSetting(
            f"the pairs are {scale:.3g} times as far from each other in the mesh as in the model, which is in millimetres;"
            " export the mesh in millimetres, or check the pairs"
        )


def _read_pairs(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Parse point pairs "x,y,z=x,y,z; ...".

    Returns:
        Points of the model and of the mesh, float64 [N, 3] each.

    Raises:
        InvalidSetting: if the text is malformed.
    """
    try:
        values = np.array([[side.split(",") for side in pair.split("=")] for pair in text.split(";")], np.float64)
    except ValueError as error:
        raise InvalidSetting(f"the pairs {text!r:.80} cannot be read; give x,y,z=x,y,z;... (model = mesh)") from error
    if values.ndim != 3 or values.shape[1:] != (2, 3) or not np.isfinite(values).all():
        raise InvalidSetting(f"the pairs {text!r:.80} cannot be read; give x,y,z=x,y,z;... (model = mesh)")
    return values[:, 0], values[:, 1]
