"""Self-contained page `report.html`; only the video is a separate file next to it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path

from operators.storage import write_whole
from services.reports.hidden_sections import hidden_section
from services.reports.live_sections import live_section
from services.reports.pictures import HiddenPictures, KeyframePictures
from services.reports.schema import RunReport
from services.reports.sections import (
    baselines_section,
    facts_section,
    latency_section,
    notes_section,
    operators_section,
    pictures_section,
    quality_over_time_section,
    tiles_section,
)
from services.reports.video import video_section

# Content security policy: only the video next to the page may be loaded.
POLICY = "default-src 'none'; img-src data:; media-src 'self'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


def write_html(
    report: RunReport,
    keyframes: Sequence[KeyframePictures],
    path: Path,
    worst_seq: int | None = None,
    hidden: HiddenPictures | None = None,
) -> None:
    """Write the page atomically."""
    write_whole(path, render_html(report, keyframes, worst_seq, hidden).encode())


def render_html(
    report: RunReport,
    keyframes: Sequence[KeyframePictures],
    worst_seq: int | None = None,
    hidden: HiddenPictures | None = None,
) -> str:
    """Render the page: inline style and SVG, pictures as `data:` URIs, no script, no external
    resources."""
    recording, run = report.recording, report.run
    sections = [
        tiles_section(report),
        live_section(report),
        hidden_section(report, hidden),
        video_section(report),
        pictures_section(keyframes, worst_seq, report),
        quality_over_time_section(report),
        f'<div class="two">{baselines_section(report)}{latency_section(report)}</div>',
        f'<div class="two">{operators_section(report)}{facts_section(report)}</div>',
        notes_section(report),
    ]
    ended = (
        f'<p class="notice ended" role="alert">This run did not reach the end of the recording: {escape(run.stop_reason)}. '
        "All figures cover the frames that were displayed.</p>"
        if run.stop_reason not in ("end of recording", "end of stream", "end of the time asked for")
        else ""
    )
    title = f"{recording.name} - IntraSplat {run.command}"
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<title>{escape(title)}</title>
<style>{style()}</style>
</head>
<body>
<main>
<header><h1>{escape(recording.name)}<small>IntraSplat {run.command}</small></h1>
<div class="when"><time datetime="{escape(run.started_at)}">{escape(run.started_at.replace("T", " ").replace("+00:00", " UTC"))}</time></div></header>
<p class="notice" role="note">{escape(report.notice)}</p>{ended}
{"".join(sections)}
<footer>Written by IntraSplat {escape(run.version)}. The same figures for programs: <code>report.json</code>. {escape(report.notice)}</footer>
</main>
</body>
</html>
"""


@cache
def style() -> str:
    """Return the style sheet of all pages."""
    return files("services.reports").joinpath("style.css").read_text(encoding="utf-8")
