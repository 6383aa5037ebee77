"""Web console, served unchanged from `page/`. No build step and no external resources."""

from __future__ import annotations

from pathlib import Path

PAGE = Path(__file__).parent / "page"
MODULES = "main api viewer plot table models streams audit badge layers legend orbit options exports recordings replays sha256 dialogs times keys health"
FILES = {
    "style.css": "text/css",
    "icon.svg": "image/svg+xml",
    **{f"{name}.js": "text/javascript" for name in MODULES.split()},
}
"""Public files and their content types."""
