"""Table output of the service commands: headings, aligned columns, readable sizes and times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from services.cli.streams import printable

WIDEST = 60
"""Widest cell in characters, except in the last column."""
Columns = Mapping[str, str]
"""Headings by field name; a dot selects a nested field (`figures.age_ms`)."""
KEY_COLUMNS: Columns = {
    "id": "ID", "role": "ROLE", "created_at": "CREATED", "expires_at": "EXPIRES", "expired": "EXPIRED",
    "last_used_at": "LAST USED", "streams": "STREAMS", "name": "NAME",
}  # fmt: skip
_EMPTY = {"expires_at": "never", "last_used_at": "never", "streams": "all"}


def table(columns: Columns, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format a table as lines. Columns without values are omitted, except the first.

    Args:
        columns: headings by field.
        rows: one mapping per line; missing fields give empty cells.

    Returns:
        The headings, then one line per row.
    """
    cells = [[_text(field, _value(row, field)) for field in columns] for row in rows]
    first = next(iter(columns))
    kept = [
        index for index, field in enumerate(columns) if not rows or field == first or any(line[index] for line in cells)
    ]
    lines = [[list(columns.values())[index] for index in kept], *([line[index] for index in kept] for line in cells)]
    lines = [[*(_cut(text) for text in line[:-1]), line[-1]] for line in lines]
    widths = [max(len(line[place]) for line in lines) for place in range(len(kept))]
    return ["  ".join(f"{text:{width}}" for text, width in zip(line, widths, strict=True)).rstrip() for line in lines]


def _cut(text: str) -> str:
    return text if len(text) <= WIDEST else f"{text[: WIDEST - 1]}…"


def _value(row: Mapping[str, Any], field: str) -> Any:
    found: Any = row
    for part in field.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _text(field: str, value: Any) -> str:
    """Format a cell on one line: times to the second with their zone, sizes in binary units."""
    if value is None or value == "":
        return _EMPTY.get(field, "")
    if field.endswith("_at") or field == "at":
        return _time(str(value))
    if field.endswith("_bytes") and isinstance(value, int | float):
        return size(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.1f}" if math.isfinite(value) else ""
    if isinstance(value, Mapping):
        return printable(", ".join(f"{name} {each}" for name, each in value.items()))
    if isinstance(value, list | tuple):
        return printable(", ".join(map(str, value)))
    return printable(str(value))


def _time(text: str) -> str:
    try:
        return datetime.fromisoformat(text).astimezone().strftime("%Y-%m-%d %H:%M:%S %z")
    except (ValueError, OverflowError, OSError):  # the server's text may be no time
        return printable(text)


def size(count: float) -> str:
    """Format a number of bytes in binary units."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
