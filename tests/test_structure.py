"""Figures of `benchmarks/structure.py` on a small tree."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "structure.py"


@pytest.fixture(scope="module")
def structure():
    spec = importlib.util.spec_from_file_location("benchmark_structure", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TREE = {
    "gsplat_core/a.py": '''"""What it is."""
from typing import Protocol
from gsplat_core import b

LIMIT = 3 * 2
NAME = "text"

class Shape(Protocol):
    def area(self) -> float: ...

class Square:
    def area(self) -> float:
        return self._side() + b.used()

    def _side(self) -> float:
        return 1.0

def only_tested() -> None:
    helper()

def helper() -> None:
    """Help."""

def forgotten() -> None:
    forgotten()
''',
    "gsplat_core/b.py": """from dataclasses import dataclass

@dataclass(frozen=True)
class ThingSettings:
    set_here: int = 1
    set_in_tests: int = 1
    set_nowhere: int = 1

def used() -> object:
    from gsplat_core.a import Square
    return ThingSettings(set_here=2), Square().area
""",
    "operators/c.py": "from gsplat_core.b import used\nused()\n",
    "services/d.py": "",
    "tests/test_a.py": "from gsplat_core.a import only_tested\nonly_tested()\nThingSettings(set_in_tests=3)\n",
}


def test_the_figures_of_a_small_tree(structure, tmp_path):
    for name, text in TREE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    figures, places = structure.measure(tmp_path)
    assert figures["Python lines"] == sum(len(TREE[name].splitlines()) for name in TREE if "test" not in name)
    assert figures["Python lines without docstrings, comments and blank lines"] == 16 + 9 + 2
    assert figures["modules"] == 4
    assert figures["numeric module constants"] == 1
    assert places["settings fields that nothing sets"] == ["gsplat_core/b.py:7 ThingSettings.set_nowhere"]
    assert places["settings fields that only tests set"] == ["gsplat_core/b.py:6 ThingSettings.set_in_tests"]
    assert [each.split()[1] for each in places["definitions that only tests use"]] == ["only_tested"]
    assert [each.split()[1] for each in places["definitions that nothing uses"]] == ["helper", "forgotten", "Shape"]
    assert places["import circles"] == []
    assert places["import circles with imports in functions and for types"] == ["gsplat_core.a gsplat_core.b"]
    assert places["protocols with fewer than two implementers"] == ["gsplat_core/a.py:8 Shape ['Square']"]
    assert figures["docstrings that begin with What/How/Of/Whether/Which/As/By"] == 1
