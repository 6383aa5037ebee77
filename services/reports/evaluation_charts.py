"""Curves of `evaluation.html`: one chart per protocol with its baselines, and the frame-hold curve."""

from __future__ import annotations

from services.reports.charts import NARROW, Chart, Line
from services.reports.evaluation_schema import EvaluationReport

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
    """Return the charts of tissue PSNR per frame, one per protocol."""
    charts = "".join(_chart(report, name) for name in _LINES if report.series.get(name))
    return charts


def _chart(report: EvaluationReport, protocol: str) -> str:
    name, baselines = _LINES[protocol]
    own = report.series[protocol]
    first_s, last_s = own[0]["time_s"], own[-1]["time_s"]
    lines = []
    for key, label, style in baselines:
        points = [
            (entry["time_s"], entry[key])
            for entry in (own if protocol == "live" else report.series.get("baselines", []))
            if entry.get(key) is not None and first_s <= entry["time_s"] <= last_s  # type: ignore[operator]
        ]
        if points:
            lines.append(Line(label, *_columns(points), style))
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
    useful if it scores above the curve at its age."""
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
        description="Tissue PSNR of a raw frame that is shown late, against the frame that is seen by then.",
        x_label="frames late",
        y_label="tissue PSNR, dB",
        lines=tuple(lines),
        x_unit=" frames",
        y_unit=" dB",
        width=NARROW,
    )
    return f"<section><h2>Frame-hold curve</h2>{chart.figure()}</section>"
