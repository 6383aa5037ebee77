"""Files and functions stay small enough to be read in one go."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("gsplat_core", "operators", "services")
MOST_LINES = 300
MOST_FUNCTION_LINES = 60
MOST_PARAMETERS = 10
SOURCES = {".py", ".cpp", ".cu", ".cuh", ".h"}

GSPLATS = {
    "rasterization", "fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels",
    "spherical_harmonics", "quat_scale_to_covar_preci",
}  # fmt: skip
"""Functions whose names and parameters are gsplat's."""


def sources(*folders: str) -> list[Path]:
    found = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in SOURCES]
    assert len(found) > 10
    return sorted(found)


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def test_no_source_is_longer_than_it_should_be():
    long = {
        str(path.relative_to(ROOT)): lines
        for path in sources(*PACKAGES, "tests", "benchmarks", "examples")
        if (lines := path.read_text(encoding="utf-8").count("\n")) > MOST_LINES
    }
    assert not long, f"over {MOST_LINES} lines: {long}"


@pytest.mark.parametrize("package", PACKAGES)
def test_functions_are_short_and_take_few_parameters(package):
    wrong = []
    for path in sources(package):
        if path.suffix != ".py":
            continue
        for node in functions(path):
            arguments = node.args
            parameters = len(arguments.posonlyargs + arguments.args + arguments.kwonlyargs)
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            where = f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
            if node.name == "rasterization":
                continue
            if lines > MOST_FUNCTION_LINES:
                wrong.append(f"{where}: {lines} lines")
            if parameters > MOST_PARAMETERS and node.name not in GSPLATS:
                wrong.append(f"{where}: {parameters} parameters")
    assert not wrong, "\n".join(wrong)
