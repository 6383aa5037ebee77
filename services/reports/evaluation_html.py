"""Self-contained page `evaluation.html`."""

from __future__ import annotations

from html import escape
from pathlib import Path

from operators.storage import write_whole
from services.reports.evaluation_charts import charts_section, hold_section
from services.reports.evaluation_geometry import geometry_section
from services.reports.evaluation_schema import EvaluationReport
from services.reports.evaluation_tables import (
    ages_section,
    depth_section,
    facts_section,
    notes_section,
    places_section,
    table_section,
    tiles_section,
)
from services.reports.html import POLICY, style


def write_evaluation_html(report: EvaluationReport, path: Path) -> None:
    """Write the page atomically."""
    write_whole(path, render_evaluation(report).encode())


def render_evaluation(report: EvaluationReport) -> str:
    """Render the page: inline style and SVG, no script, no external resources."""
    evaluated, name = report.evaluated, escape(report.recording.name)
    small = [hold_section(report), ages_section(report), depth_section(report), facts_section(report)]
    sections = [
        tiles_section(report),
        table_section(report),
        geometry_section(report),
        charts_section(report),
        places_section(report),
        f'<div class="two">{"".join(small)}</div>',
        notes_section(report),
    ]
    ended = (
        '<p class="notice ended" role="alert">This evaluation was interrupted. All figures cover the frames that were reached.</p>'
        if evaluated.interrupted
        else ""
    )
    when = escape(evaluated.started_at)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<title>{name} - IntraSplat evaluation</title>
<style>{style()}</style>
</head>
<body>
<main>
<header><h1>{name}<small>IntraSplat evaluation</small></h1>
<div class="when"><time datetime="{when}">{when.replace("T", " ").replace("+00:00", " UTC")}</time></div></header>
<p class="notice" role="note">{escape(report.notice)}</p>{ended}
{"".join(sections)}
<footer>Written by IntraSplat {escape(evaluated.version)}. The same figures for programs: <code>evaluation.json</code>. {escape(report.notice)}</footer>
</main>
</body>
</html>
"""
