"""Each hazard has a control, and each control names tests that exist (docs/hazards.md)."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def rows() -> dict[str, list[str]]:
    """The cells of each hazard's row, by its number."""
    text = (ROOT / "docs" / "hazards.md").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if re.match(r"\| H\d+ \|", line)]
    return {cells[0]: cells[1:] for cells in ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)}


def functions_of(file: Path) -> list[str]:
    return re.findall(r"^\s*(?:async )?def (\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)


def test_hazards_are_numbered_and_each_has_a_control_and_a_test():
    assert list(rows()) == [f"H{number}" for number in range(1, len(rows()) + 1)] and len(rows()) >= 10
    for number, cells in rows().items():
        assert len(cells) == 4 and all(cells), number
        assert re.fullmatch(r"`[^`]+`(<br>`[^`]+`)*", cells[-1]), number


def test_every_test_that_is_named_exists():
    named = [name for cells in rows().values() for name in re.findall(r"`([^`]+)`", cells[-1])]
    assert len(named) > 30
    for name in named:
        file, _, function = name.partition("::")
        assert file.startswith("tests/") and Path(file).name.startswith("test_") and (ROOT / file).is_file(), name
        assert not function or function in functions_of(ROOT / file), name
