"""Sections of `report.html` for live runs: picture ages, quality over age, skipped frames."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from itertools import pairwise
from statistics import fmean

from services.reports.charts import NARROW, Chart, Line
from services.reports.schema import FrameEntry, LiveFacts, RunReport
from services.reports.sections import against

AGE_GROUPS = 12
"""Points of the quality-over-age curve; each groups equally many frames."""


def live_section(report: RunReport) -> str:
    """Return ages, quality over age, states and counts; empty for runs without a clock."""
    live = report.live
    if live is None:
        return ""
    charts = "".join(
        f"<section><h2>{chart.title}</h2>{chart.figure()}</section>"
        for chart in (_ages_over_time(report), _quality_over_age(report))
        if chart is not None
    )
    return f'{_tiles(live)}<div class="two">{charts}</div>{_counts(live)}'


def _tiles(live: LiveFacts) -> str:
    versus = against(live.settled_psnr_tissue_db, live.previous_frame_db)
    first = "–" if live.first_picture_ms is None else f"{live.first_picture_ms:,.0f}"
    tiles = (
        (
            "Displayed frame, after the first second",
            _decibels(live.settled_psnr_tissue_db),
            "dB",
            f"training error; {versus}",
        ),
        ("Worst frame since then", _decibels(live.worst_psnr_tissue_db), "dB", "training error"),
        (
            "Age of what is shown",
            f"{live.age_p50_ms:,.1f}",
            "ms",
            f"p99 {live.age_p99_ms:,.1f}, max {live.age_max_ms:,.1f} ms",
        ),
        ("First picture", first, "ms", "after the first frame"),
    )
    items = "".join(
        f'<li><span class="name">{name}</span><b>{value}<span>{unit}</span></b><span class="more">{more}</span></li>'
        for name, value, unit, more in tiles
    )
    return f'<ul class="tiles">{items}</ul>'


def _ages_over_time(report: RunReport) -> Chart | None:
    entries = [entry for entry in report.series if entry.age_ms is not None]
    if not entries:
        return None
    times, interval_ms = [entry.time_s for entry in entries], 1000 / report.recording.fps
    lines = (
        Line("Age when shown", times, [entry.age_ms for entry in entries], "main"),
        Line("Time between two frames", [times[0], times[-1]], [interval_ms, interval_ms], "base"),
    )
    return Chart(
        title="Age over time",
        description="From a frame's arrival to its picture. Above the broken line a picture comes after the next frame."
        + _summed_up(report),
        x_label="time in the recording, s",
        y_label="age, ms",
        lines=lines,
        x_unit=" s",
        y_unit=" ms",
        width=NARROW,
    )


def _quality_over_age(report: RunReport) -> Chart | None:
    entries = [entry for entry in report.series if entry.age_ms is not None and entry.psnr_tissue_db is not None]
    if len(entries) < 2:
        return None
    groups = _by_age(entries)
    ages = [fmean(entry.age_ms or 0.0 for entry in group) for group in groups]
    lines = (
        Line(
            "On the screen when the next frame came (training error)",
            ages,
            [_mean(group, "psnr_tissue_db") for group in groups],
            "main",
        ),
        Line("Previous frame shown instead", ages, [_mean(group, "previous_frame_db") for group in groups], "base"),
    )
    return Chart(
        title="Quality over age",
        description=f"Tissue PSNR of frames in {len(groups)} groups of like age. Older pictures show less of what is there now.",
        x_label="age when shown, ms",
        y_label="tissue PSNR, dB",
        lines=lines,
        x_unit=" ms",
        y_unit=" dB",
        width=NARROW,
    )


def _by_age(entries: list[FrameEntry]) -> list[list[FrameEntry]]:
    """Split frames by age into groups of about equal size, youngest first."""
    ordered = sorted(entries, key=lambda entry: entry.age_ms or 0.0)
    count = min(AGE_GROUPS, len(ordered))
    edges = [round(k * len(ordered) / count) for k in range(count + 1)]
    return [ordered[low:high] for low, high in pairwise(edges)]


def _mean(entries: list[FrameEntry], name: str) -> float | None:
    values = [value for entry in entries if (value := getattr(entry, name)) is not None]
    return fmean(values) if values else None


def _counts(live: LiveFacts) -> str:
    per_frame = live.steps / live.frames_trained if live.frames_trained else 0.0
    ages = f"p50 {live.age_p50_ms:,.1f}, p95 {live.age_p95_ms:,.1f}, p99 {live.age_p99_ms:,.1f}, max {live.age_max_ms:,.1f} ms"
    facts = {
        "Age when shown": f"{ages}, {live.pictures:,} pictures",
        "Frames trained on": f"{live.frames_trained:,}, {per_frame:.1f} steps each before they were shown",
        "Steps on earlier frames": f"{live.rehearsed_steps:,}",
        "Not on the screen in time": f"{live.not_on_screen:,} frames",
        "States, entered": _listed(live.states),
        "Passed over": _listed(live.dropped),
        "Withheld from training": _listed(live.withheld),
        "New scenes": _listed(live.scenes),
        **{f"Found by {stage}": _listed(found) for stage, found in live.analysis.items()},
        "Too fast to be scored": f"{live.unscored:,} frames",
    }
    rows = "".join(f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in facts.items())
    return f'<section><h2>Live</h2><table class="facts"><tbody>{rows}</tbody></table></section>'


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in counts.items()) or "none"


def _summed_up(report: RunReport) -> str:
    per_entry = report.series_frames_per_entry
    return f" Each point is the first of {per_entry} frames." if per_entry > 1 else ""


def _decibels(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
