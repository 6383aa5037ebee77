"""Files of an evaluation: the self-contained page `evaluation.html` with curves, tiles and tables, next to `evaluation.json`; and the rows of scores
that the terminal prints, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path

from gsplat_core.evaluation.scores import MOST_BEHIND
from operators.storage import write_whole
from services.reports.evaluation import BaselineFacts, EndPointFacts, EvaluationReport, GeometryFacts, ScoreFacts
from services.reports.figures import NARROW, Chart, Line
from services.reports.html import facts_table, notes_section, page, tile


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
        shown = "every tenth frame, the final model seen by the right eye, after a linear fit per channel"
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
"""Deviation from 1 of the factor between model lengths and true lengths above which the model is reported as uncalibrated."""


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
        return f"the factor from the model's lengths to true ones is {scale:.3g}: the model is uncalibrated, and only the relative figures apply to it"
    return f"the factor from the model's lengths to true ones is {scale:.3f}"


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
    """Return the rows of `geometry_rows` as a table of `evaluation.html`; empty without rows."""
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
    note = "" if scale is None else f'<p class="note">{escape(scale[0].upper() + scale[1:])}.</p>'
    return (
        f'<section><h2>In three dimensions</h2><p class="lead">{geometry.frames:,} frames, spread evenly; relative figures say nothing'
        ' about lengths.</p><table><thead><tr><th scope="col">What</th><th scope="col" class="n">the model</th>'
        f'<th scope="col">compare with</th><th scope="col"></th></tr></thead><tbody>{body}</tbody></table>{note}</section>'
    )


def geometry_lines(report: EvaluationReport) -> list[str]:
    """Return the rows of `geometry_rows` as lines for a terminal."""
    geometry = report.geometry
    rows = [] if geometry is None else geometry_rows(geometry)
    if geometry is None or not rows:
        return []
    what, value = max(len(row.what) for row in rows), max(len(row.value) for row in rows)
    lines = [f"{row.what:<{what}}  {row.value:<{value}}  {row.baselines}" for row in rows]
    scale = scale_sentence(geometry)
    return [*lines, *([scale] if scale else [])]


_LINES = {
    "live": ("Live", (("previous_frame_db", "Previous frame shown instead", "base"),)),
    "causal": (
        "Causal prediction",
        (
            ("psnr_tissue_db", "Previous frame shown instead", "base"),
            ("half_velocity_flow_db", "Half of a constant-velocity flow", "third"),
        ),
    ),
    "heldout": (
        "Held-out frames",
        (
            ("previous_frame_db", "Previous frame", "base"),
            ("neighbour_mean_db", "Mean of both neighbours (sees the future)", "second"),
            ("half_way_flow_db", "Half-way flow (sees the future)", "third"),
        ),
    ),
    "retention": ("Final model", ()),
}
"""Curve name per protocol, and the keys, names and styles of its baselines."""
_TITLES = {
    "live": "Live: on the screen when the next frame came (training error)",
    "causal": "Causal: predicted, then learned from",
    "heldout": "Held out",
    "retention": "Retention: the last seconds again",
}


def charts_section(report: EvaluationReport) -> str:
    """Return the HTML of the charts of tissue PSNR over time, one for each protocol that was evaluated."""
    charts = "".join(_chart(report, name) for name in _LINES if report.series.get(name))
    return charts


def _chart(report: EvaluationReport, protocol: str) -> str:
    name, baselines = _LINES[protocol]
    own = report.series[protocol]
    first_s, last_s = own[0]["time_s"], own[-1]["time_s"]
    lines = []
    for key, label, dash in baselines:
        points = [
            (entry["time_s"], entry[key])
            for entry in (own if protocol == "live" else report.series.get("baselines", []))
            if entry.get(key) is not None and first_s <= entry["time_s"] <= last_s  # type: ignore[operator]
        ]
        if points:
            lines.append(Line(label, *_columns(points), dash))
    lines.append(Line(name, *_columns([(e["time_s"], e["psnr_tissue_db"]) for e in own]), "main"))
    per_entry = report.series_frames_per_entry.get(protocol, 1)
    summed_up = f" Each point is the mean of {per_entry} frames." if per_entry > 1 else ""
    chart = Chart(
        title=f"{_TITLES[protocol]}, tissue PSNR over time",
        description="Higher is better; baselines are drawn as broken lines." + summed_up,
        x_label="time in the recording, s",
        y_label="tissue PSNR, dB",
        lines=tuple(lines),
        x_unit=" s",
        y_unit=" dB",
    )
    return f"<section><h2>{_TITLES[protocol]}</h2>{chart.figure()}</section>"


def _columns(points: list[tuple]) -> tuple[list[float], list[float | None]]:
    return [x for x, _ in points], [y for _, y in points]


def hold_section(report: EvaluationReport) -> str:
    """Return the frame-hold curve: the score of a raw frame displayed late. A live picture is
    useful if it scores above the curve at its age. Empty if fewer than two ages were scored.
    """
    copies = [each for each in report.baselines if each.age_frames is not None and each.psnr_tissue_db is not None]
    if len(copies) < 2:
        return ""
    ages = [float(each.age_frames or 0) for each in copies]
    lines = [
        Line("Raw frame, so many frames late", ages, [each.psnr_tissue_db for each in copies], "base"),
        Line("the same, over tissue in both frames", ages, [each.psnr_both_db for each in copies], "third"),
    ]
    live = report.live
    if live is not None and live.age_when_shown is not None and live.score.psnr_tissue_db is not None:
        age = live.age_when_shown.p50_ms * report.recording.fps / 1000
        lines.append(
            Line("Live, at the median age (training error)", [age], [live.score.psnr_tissue_db], "second", marks=True)
        )
    chart = Chart(
        title="Frame-hold curve",
        description="Tissue PSNR of a delayed raw frame, compared with the frame that is current when it is displayed.",
        x_label="frames late",
        y_label="tissue PSNR, dB",
        lines=tuple(lines),
        x_unit=" frames",
        y_unit=" dB",
        width=NARROW,
    )
    return f"<section><h2>Frame-hold curve</h2>{chart.figure()}</section>"


def tiles_section(report: EvaluationReport) -> str:
    """Return the tiles with the main scores of each protocol; empty without scores."""
    tiles = []
    for each in measured(report):
        more = each.what
        versus = each.versus
        if versus is not None:
            gain, baseline = versus
            more = f'<span class="{"good" if gain >= 0 else "bad"}">{gain:+.2f} dB</span> against: {escape(future(baseline).lower())}'
        tiles.append(tile(f"{each.name}, tissue", decibels(each.score.psnr_tissue_db), "dB", more))
    if report.live is not None and report.live.age_when_shown is not None:
        ages = report.live.age_when_shown
        tiles.append(
            tile("Age when shown", f"{ages.p50_ms:.1f}", "ms", f"p99 {ages.p99_ms:.1f}, max {ages.max_ms:.1f} ms")
        )
    return f'<ul class="tiles">{"".join(tiles)}</ul>' if tiles else ""


def table_section(report: EvaluationReport) -> str:
    """Return the table of the scores of protocols and baselines; empty without any."""
    found = measured(report)
    known = [value for each in report.baselines if (value := each.psnr_tissue_db) is not None]
    known += [value for each in found if (value := each.score.psnr_tissue_db) is not None]
    low, high = (min(known) - 1, max(known) + 1) if known else (0.0, 1.0)
    body = ""
    for each in found:
        body += _score_row(f"{each.name}: {each.what}", each.score, low, high)
        body += "".join(_baseline_row(baseline, low, high) for baseline in each.baselines)
    if not found:
        body = "".join(_baseline_row(baseline, low, high) for baseline in report.baselines)
    if not body:
        return ""
    return (
        '<section><h2>Against doing nothing</h2><p class="lead">PSNR in dB, mean over frames; "whole frame" divides the same error by all'
        " pixels, as many papers do.</p><table><thead><tr>"
        '<th scope="col">What is shown</th><th scope="col" class="n">frames</th><th scope="col" class="n">tissue</th>'
        '<th scope="col" class="n">whole frame</th><th scope="col" class="n">SSIM</th><th scope="col" class="n">worst frame</th>'
        f'<th scope="col" class="ends"><span>{low:.0f}</span><span>{high:.0f}</span></th></tr></thead><tbody>{body}</tbody></table>'
        f'<p class="note">{_left_out(report)}</p></section>'
    )


def _score_row(name: str, score: ScoreFacts, low: float, high: float) -> str:
    ssim = "–" if score.ssim is None else f"{score.ssim:.4f}"
    worst = "–" if score.worst_db is None else f"{score.worst_db:.2f} ({score.worst_seq})"
    cells = "".join(
        f'<td class="n">{value}</td>'
        for value in (f"{score.frames:,}", decibels(score.psnr_tissue_db), decibels(score.psnr_frame_db), ssim, worst)
    )
    return f'<tr class="ours"><th scope="row">{escape(name)}</th>{cells}{_rail(score.psnr_tissue_db, low, high)}</tr>'


def _baseline_row(baseline: BaselineFacts, low: float, high: float) -> str:
    cells = "".join(
        f'<td class="n">{value}</td>'
        for value in (
            f"{baseline.frames:,}",
            decibels(baseline.psnr_tissue_db),
            decibels(baseline.psnr_frame_db),
            "",
            "",
        )
    )
    rail = _rail(baseline.psnr_tissue_db, low, high)
    return f'<tr><th scope="row">{escape(future(baseline))}</th>{cells}{rail}</tr>'


def _rail(value: float | None, low: float, high: float) -> str:
    if value is None:
        return '<td class="track"></td>'
    share = 100 * (value - low) / (high - low)
    return f'<td class="track"><span class="rail"><span class="dot" style="left:{share:.1f}%"></span></span></td>'


def _left_out(report: EvaluationReport) -> str:
    said = [
        f"{each.name}: not scored {', '.join(f'{count:,} ({escape(reason)})' for reason, count in each.score.left_out.items())}."
        for each in measured(report)
        if each.score.left_out
    ]
    if report.left_out:
        said.append(
            f"Baselines: not scored {', '.join(f'{n:,} ({escape(why)})' for why, n in report.left_out.items())}."
        )
    return " ".join(said)


def ages_section(report: EvaluationReport) -> str:
    """Return the table of picture ages at display; empty without scores of a live run."""
    live = report.live
    if live is None:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{name}</th><td class="n">{ages.p50_ms:,.1f}</td><td class="n">{ages.p95_ms:,.1f}</td>'
        f'<td class="n">{ages.p99_ms:,.1f}</td><td class="n">{ages.max_ms:,.1f}</td></tr>'
        for name, ages in (
            ("When it was shown", live.age_when_shown),
            ("When the next frame came", live.age_on_screen),
        )
        if ages is not None
    )
    late = ", ".join(
        f"{count:,} by {k}{' or more' if k == MOST_BEHIND else ''}" for k, count in live.behind.items() if k
    )
    said = f"{live.in_time:,} frames were on the screen before the next one came" + (
        f"; late: {late} frames. " if late else ". "
    )
    if live.age_when_shown is not None:
        age_frames = live.age_when_shown.p50_ms * report.recording.fps / 1000
        hold = at_age(report, age_frames)
        if hold is not None:
            said += f"A raw frame shown {max(1.0, age_frames):.1f} frames late scores {hold:.2f} dB. "
    said += "Pictures by state: " + ", ".join(f"{escape(name)} {count:,}" for name, count in live.states.items()) + "."
    return (
        '<section><h2>Age of what was shown</h2><table><thead><tr><th scope="col"></th><th scope="col" class="n">p50 ms</th>'
        '<th scope="col" class="n">p95</th><th scope="col" class="n">p99</th><th scope="col" class="n">max</th></tr></thead>'
        f'<tbody>{rows}</tbody></table><p class="note">{said}</p></section>'
    )


def depth_section(report: EvaluationReport) -> str:
    """Return the table of depth errors on the held-out frames; empty without them."""
    depth = None if report.heldout is None else report.heldout.depth
    if depth is None:
        return ""
    facts = {
        "Mean absolute error": f"{depth.mae_mm:.3f} mm",
        "Root mean squared error": f"{depth.rmse_mm:.3f} mm",
        "Relative error": f"{100 * depth.relative:.2f} %",
        "Root mean squared error, one factor per frame": f"{depth.scaled_rmse_mm:.3f} mm",
        "Covered": f"{100 * depth.covered:.1f} % of the pixels whose depth is known",
        "Frames": f"{depth.frames:,}",
    }
    return facts_table("Depth, held-out frames", facts)


def places_section(report: EvaluationReport) -> str:
    """Return the table of scores at revisited places; empty without such places."""
    if report.retention is None or not report.retention.places:
        return ""
    heads = "".join(
        f'<th scope="col"{css}>{name}</th>'
        for css, name in (
            ("", "First stay"),
            ("", "Second stay"),
            (' class="n"', "first again, dB"),
            (' class="n"', "second again, dB"),
            ("", "First frames of the second stay, dB"),
        )
    )
    body = ""
    for place in report.retention.places:
        soon = [
            f"{escape(name)}: {', '.join(decibels(value) for value in each.first_db)}"
            for name, found in report.returns.items()
            for each in found
            if each.again_s == place.again_s
        ]
        body += (
            f"<tr><td>{place.first_s[0]:.2f} to {place.first_s[1]:.2f} s</td><td>{place.again_s[0]:.2f} to {place.again_s[1]:.2f} s</td>"
            f'<td class="n">{decibels(place.first.psnr_tissue_db)}</td><td class="n">{decibels(place.again.psnr_tissue_db)}</td>'
            f"<td>{'; '.join(soon) or '–'}</td></tr>"
        )
    return (
        '<section><h2>Places seen twice</h2><p class="lead">Both stays rendered by the final model.</p>'
        f"<table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></section>"
    )


def facts_section(report: EvaluationReport) -> str:
    """Return the facts about model, recording and machine."""
    recording, evaluated, model = report.recording, report.evaluated, report.evaluated.model
    start_s, end_s = evaluated.time_window_s
    facts = {
        "Recording": f"{recording.frames} frames, {recording.width_px} x {recording.height_px} px, {recording.fps:g} fps",
        "Evaluated": evaluated.path,
        "Made by": evaluated.command or "not known",
        "Model": f"{model.gaussians:,} Gaussians, {model.parameters:,} parameters, {start_s:.2f} to {end_s:.2f} s",
        "Device, renderer": f"{evaluated.device}, {evaluated.renderer}",
        "Time taken": f"{evaluated.wall_s:.1f} s",
        **evaluated.machine,
    }
    if report.causal is not None:
        causal = report.causal
        facts["Causal learning"] = (
            f"{causal.steps_per_frame} steps a frame, {causal.field} field, motion prior {causal.motion_prior}, seed {causal.seed}"
        )
    return facts_table("Evaluation", facts, {"Recording": recording.digest, "Model": model.sha256})


def write_evaluation(report: EvaluationReport, folder: Path) -> EvaluationReport:
    """Write `evaluation.json` and `evaluation.html`, each atomically.

    Raises:
        OutputError: if a file cannot be written, for example because the disk is full (StorageFull).
    """
    outputs = {**report.outputs, "report": "evaluation.json", "page": "evaluation.html"}
    report = report.model_copy(update={"outputs": outputs})
    report.write(folder / "evaluation.json")
    write_evaluation_html(report, folder / "evaluation.html")
    return report


def write_evaluation_html(report: EvaluationReport, path: Path) -> None:
    """Write the HTML page of an evaluation atomically."""
    write_whole(path, render_evaluation(report).encode())


def render_evaluation(report: EvaluationReport) -> str:
    """Render the page: inline style and SVG, no script, no external resources."""
    evaluated = report.evaluated
    small = [hold_section(report), ages_section(report), depth_section(report), facts_section(report)]
    sections = [
        tiles_section(report),
        table_section(report),
        geometry_section(report),
        charts_section(report),
        places_section(report),
        f'<div class="two">{"".join(small)}</div>',
        notes_section(report.notes),
    ]
    ended = (
        '<p class="notice ended" role="alert">This evaluation was interrupted. All figures cover the frames that were reached.</p>'
        if evaluated.interrupted
        else ""
    )
    return page(
        report.recording.name,
        "evaluation",
        evaluated.started_at,
        evaluated.version,
        report.notice,
        ended,
        sections,
        "evaluation.json",
    )
