"""Rows of 3D accuracy: measurement, unit and trivial baselines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

from services.reports.evaluation_rows import decibels
from services.reports.evaluation_schema import EndPointFacts, EvaluationReport, GeometryFacts

RELATIVE_FROM = 0.05
"""Scale error above which a model is reported as having no scale."""


@dataclass(frozen=True)
class GeometryRow:
    """Formatted measurement."""

    what: str
    value: str
    baselines: str
    """Trivial baselines with their values."""
    relative: bool = False
    """True if a scale factor was removed first, so the value does not assess lengths."""


def geometry_rows(geometry: GeometryFacts) -> list[GeometryRow]:
    """Return all measured rows, in page order."""
    motion = [*_tracking(geometry), *_flow(geometry), *_trajectory(geometry)]
    return [*_depth(geometry), *_views(geometry), *motion, *_parts(geometry)]


def scale_sentence(geometry: GeometryFacts) -> str | None:
    """Describe the model's length scale relative to the true depth; None without true depth."""
    if geometry.depth is None:
        return None
    scale = geometry.depth.scale
    if abs(scale - 1) > RELATIVE_FROM:
        return f"the model's lengths must be multiplied by {scale:.3g}: it is uncalibrated, and only the relative figures say something about it"
    return f"the model's lengths must be multiplied by {scale:.3f}"


def _depth(geometry: GeometryFacts) -> Iterator[GeometryRow]:
    depth, normals = geometry.depth, geometry.normals
    if depth is not None:
        baselines = f"level plane {_percent(depth.level_rmse_share)}, best-fit plane {_percent(depth.plane_rmse_share)}"
        unit = "root mean squared error, share of the median depth"
        yield GeometryRow(f"Depth, {unit}", _percent(depth.rmse_share), baselines)
        yield GeometryRow(f"Depth after one scale, {unit}", _percent(depth.scaled_rmse_share), baselines, True)
    if normals is not None:
        baselines = f"best-fit plane {_degrees(normals.plane_mean_deg)}"
        if normals.level_mean_deg is not None:
            baselines = f"level plane {_degrees(normals.level_mean_deg)}, {baselines}"
        yield GeometryRow("Normals, mean angle", _degrees(normals.mean_deg), baselines, True)


def _views(geometry: GeometryFacts) -> Iterator[GeometryRow]:
    found = [(geometry.views, "", False)]
    if geometry.scaled_views != geometry.views:
        found.append((geometry.scaled_views, " after one scale", True))
    for views, after, relative in found:
        for view in views:
            left, shifted = decibels(view.left.psnr_tissue_db), decibels(view.shifted.psnr_tissue_db)
            ssim = "" if view.model.ssim is None else f", SSIM {view.model.ssim:.4f}"
            yield GeometryRow(
                f"View of the {view.name} camera{after}",
                f"{decibels(view.model.psnr_tissue_db)} dB{ssim}",
                f"left picture {left} dB, shifted {shifted} dB",
                relative,
            )


def _tracking(geometry: GeometryFacts) -> Iterator[GeometryRow]:
    tracking = geometry.tracking
    if tracking is None:
        return
    still = tracking.still
    for found, after, relative in ((tracking.model, "", False), (tracking.scaled, " after one scale", True)):
        yield GeometryRow(
            f"Followed points{after}, median and mean error",
            f"{found.median_mm:.2f} mm, {found.mean_mm:.2f} mm",
            f"no motion {still.median_mm:.2f} mm, {still.mean_mm:.2f} mm",
            relative,
        )
    yield GeometryRow(
        "Followed points, median and mean error in the picture",
        f"{tracking.model.median_px:.2f} px, {tracking.model.mean_px:.2f} px",
        f"no motion {still.median_px:.2f} px, {still.mean_px:.2f} px",
        True,
    )


def _flow(geometry: GeometryFacts) -> Iterator[GeometryRow]:
    flow = geometry.flow
    if flow is None:
        return
    what, still = "from frame to frame, median and mean error", flow.still
    yield GeometryRow(
        f"Flow {what}",
        f"{flow.model.median_px:.3f} px, {flow.model.mean_px:.3f} px",
        f"no motion {still.median_px:.3f} px, {still.mean_px:.3f} px",
        True,
    )
    for found, after, relative in ((flow.model, "", False), (flow.scaled, " after one scale", True)):
        if found.median_mm is not None:
            yield GeometryRow(f"Scene flow{after} {what}", _lengths(found), f"no motion {_lengths(still)}", relative)


def _trajectory(geometry: GeometryFacts) -> Iterator[GeometryRow]:
    way = geometry.trajectory
    if way is None:
        return
    still = f"no motion {_percent(way.still_share)}"
    yield GeometryRow("Trajectory (ATE), share of the path", _percent(way.rigid_share), still)
    yield GeometryRow(
        "Trajectory (ATE) after one scale, share of the path", _percent(way.similarity_share), still, True
    )


def _parts(geometry: GeometryFacts) -> Iterator[GeometryRow]:
    parts = geometry.parts
    if parts is not None:
        whole = f"all parts together {_percent(parts.explained)}"
        for name, share in (("motion", parts.motion), ("colour", parts.colour), ("size and opacity", parts.size)):
            yield GeometryRow(f"Change of the pictures explained by {name}", _percent(share), whole, True)


def _lengths(errors: EndPointFacts) -> str:
    return f"{errors.median_mm:.3f} mm, {errors.mean_mm:.3f} mm"


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %"


def _degrees(angle: float) -> str:
    return f"{angle:.1f}°"


def geometry_section(report: EvaluationReport) -> str:
    """Return the rows as a table of `evaluation.html`."""
    geometry = report.geometry
    rows = [] if geometry is None else geometry_rows(geometry)
    if geometry is None or not rows:
        return ""
    body = "".join(
        f'<tr><th scope="row">{escape(row.what)}</th><td class="n">{escape(row.value)}</td><td>{escape(row.baselines)}</td>'
        f"<td>{'relative' if row.relative else 'absolute'}</td></tr>"
        for row in rows
    )
    scale = scale_sentence(geometry)
    note = "" if scale is None else f'<p class="note">To be true in length, {escape(scale)}.</p>'
    return (
        f'<section><h2>In three dimensions</h2><p class="lead">{geometry.frames:,} frames, spread evenly; relative figures say nothing'
        ' about lengths.</p><table><thead><tr><th scope="col">What</th><th scope="col" class="n">the model</th>'
        f'<th scope="col">compare with</th><th scope="col"></th></tr></thead><tbody>{body}</tbody></table>{note}</section>'
    )


def geometry_lines(report: EvaluationReport) -> list[str]:
    """Return the rows as lines for a terminal."""
    geometry = report.geometry
    rows = [] if geometry is None else geometry_rows(geometry)
    if geometry is None or not rows:
        return []
    what, value = max(len(row.what) for row in rows), max(len(row.value) for row in rows)
    lines = [f"{row.what:<{what}}  {row.value:<{value}}  {row.baselines}" for row in rows]
    scale = scale_sentence(geometry)
    return [*lines, *([f"to be true in length, {scale}"] if scale else [])]
