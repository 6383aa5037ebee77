"""Section of `report.html` that plays the run's video from a file next to the page."""

from __future__ import annotations

from html import escape
from urllib.parse import quote

from services.reports.schema import RunReport


def video_section(report: RunReport) -> str:
    """Return a video player; empty if the run wrote no video."""
    name = report.outputs.get("video")
    if name is None:
        return ""
    return (
        '<section><h2>Video</h2><p class="lead">Raw beside reconstruction, with frame number and model version.</p>'
        f'<video controls muted loop playsinline preload="auto"><source src="{escape(quote(name))}" type="video/mp4">'
        f"This browser plays no video; open <code>{escape(name)}</code>.</video></section>"
    )
