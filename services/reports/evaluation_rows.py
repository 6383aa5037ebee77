"""Rows of an evaluation for the page and the terminal: scores of protocols and 3D accuracy, next to trivial baselines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from itertools import pairwise

from services.reports.evaluation_schema import BaselineFacts, EndPointFacts, EvaluationReport, GeometryFacts, ScoreFacts


@dataclass(frozen=True)
class Measured:
    """Scores of one evaluation protocol and of its trivial baselines, the primary baseline first."""

    key: str
    name: str
    what: str
    """Short description of the displayed pictures."""
    score: ScoreFacts
    baselines: tuple[BaselineFacts, ...]

    @property
    def versus(self) -> tuple[float, BaselineFacts] | None:
        """Return the gain in dB over the first baseline that has a score, and that baseline; None without a score."""
        for baseline in self.baselines:
            if baseline.psnr_tissue_db is not None and self.score.psnr_tissue_db is not None:
                return self.score.psnr_tissue_db - baseline.psnr_tissue_db, baseline
        return None


def measured(report: EvaluationReport) -> list[Measured]:
    """Return the protocols that have scores, in the order of the page."""

    def named(frames_of: str, *names: str) -> tuple[BaselineFacts, ...]:
        by_name = {each.name: each for each in report.baselines if each.frames_of == frames_of}
        return tuple(by_name[name] for name in names if name in by_name)

    found: list[Measured] = []

    def add(key: str, name: str, what: str, score: ScoreFacts, baselines: tuple[BaselineFacts, ...]) -> None:
        found.append(Measured(key, name, what, score, baselines))

    if (live := report.live) is not None:
        shown = "what was on the screen when the next frame came (training error)"
        add("live", "Live", shown, live.score, named("live", "previous_frame"))
        add(
            "settled",
            "Live, settled",
            "the same without the first second (training error)",
            live.settled,
            named("settled", "previous_frame"),
        )
    if report.causal is not None:
        against = named("every", "half_velocity_flow", "previous_frame")
        add("causal", "Causal", "the next frame, predicted before it was seen", report.causal.score, against)
    if report.heldout is not None:
        against = named("heldout", "half_way_flow", "neighbour_mean", "previous_frame", "train_mean")
        add("heldout", "Held out", "frames that training never saw", report.heldout.score, against)
    if report.second_eye is not None:
        against = named("second_eye", "semi_global_matching", "previous_right", "left_shifted")
        shown = "every tenth frame as the right eye sees the final model, a straight line per channel fitted"
        add("second_eye", "Right eye", shown, report.second_eye.score, against)
    if report.retention is not None:
        start_s, end_s = report.retention.last_range_s
        shown = f"the last {end_s - start_s:.3g} s again, by the final model (training error)"
        add("retention", "Retention", shown, report.retention.last, named("last", "last_frame"))
    return found


def future(baseline: BaselineFacts) -> str:
    """Return the baseline's label, with a mark if the baseline uses future frames."""
    return f"{baseline.label} (sees the future)" if baseline.sees_future else baseline.label


def decibels(value: float | None) -> str:
    """Format a PSNR in dB with two decimals; a dash for None."""
    return "–" if value is None else f"{value:.2f}"


def at_age(report: EvaluationReport, age_frames: float) -> float | None:
    """Interpolate the frame-hold curve linearly at an age in frames; None outside the measured ages.

    Ages below one frame count as one: a picture that stays until the next frame equals a copy of the previous frame.
    """
    copies = sorted(
        (each.age_frames, each.psnr_tissue_db)
        for each in report.baselines
        if each.age_frames is not None and each.psnr_tissue_db is not None
    )
    age_frames = max(1.0, age_frames)
    for (low, low_db), (high, high_db) in pairwise(copies):
        if low <= age_frames <= high:
            return low_db + (high_db - low_db) * (age_frames - low) / (high - low)
    return copies[0][1] if copies and age_frames == copies[0][0] else None


RELATIVE_FROM = 0.05
"""Deviation of the length scale from 1 above which the model is reported as uncalibrated."""


@dataclass(frozen=True)
class GeometryRow:
    """Measurement of 3D accuracy as text: description, value and baselines."""

    what: str
    value: str
    baselines: str
    """Trivial baselines with their values."""
    relative: bool = False
    """True if a scale factor was removed first, so the value does not assess lengths."""


def geometry_rows(geometry: GeometryFacts) -> list[GeometryRow]:
    """Return a row for each available measurement of 3D accuracy, in the order of the page."""
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
    for what, depth in (("Depth", geometry.depth), ("Ray depth", geometry.ray_depth)):
        if depth is None:
            continue
        baselines = f"level plane {_percent(depth.level_rmse_share)}, best-fit plane {_percent(depth.plane_rmse_share)}"
        unit = "root mean squared error, share of the median depth"
        yield GeometryRow(f"{what}, {unit}", _percent(depth.rmse_share), baselines)
        yield GeometryRow(f"{what} after one scale, {unit}", _percent(depth.scaled_rmse_share), baselines, True)
    for what, normals in (("Normals", geometry.normals), ("Normals of ray depth", geometry.ray_normals)):
        if normals is None:
            continue
        baselines = f"best-fit plane {_degrees(normals.plane_mean_deg)}"
        if normals.level_mean_deg is not None:
            baselines = f"level plane {_degrees(normals.level_mean_deg)}, {baselines}"
        yield GeometryRow(f"{what}, mean angle", _degrees(normals.mean_deg), baselines, True)


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
