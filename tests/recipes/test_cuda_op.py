"""CONTRIBUTING's recipe "A CUDA op": the files that it lists are those of an op that is there, and its schemas are registered."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from gsplat_core.ops import native  # noqa: F401  registers the compiled ops

ROOT = Path(__file__).resolve().parents[2]
OP = "splat_regression"


@pytest.fixture(scope="module")
def recipe() -> str:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    return text.split("### A CUDA op\n")[1].split("\n## ")[0].split("\n### ")[0]


@pytest.fixture(scope="module")
def listed(recipe) -> list[str]:
    rows = re.findall(r"^\| `([^`]+)` \|", recipe, re.MULTILINE)
    return [row.replace("<op>", OP) for row in rows]


def test_every_listed_file_is_there(listed):
    assert len(listed) >= 10
    assert [name for name in listed if not (ROOT / name).is_file()] == []


def test_the_ops_folder_has_no_other_kind_of_file(listed):
    folder = ROOT / "gsplat_core" / "ops" / OP
    names = {path.name for path in folder.iterdir() if path.is_file()}
    assert names == {Path(name).name for name in listed if f"ops/{OP}/" in name and "tests" not in name}


def test_what_the_host_file_registers_has_a_schema_and_runs_on_the_cpu():
    source = (ROOT / "gsplat_core" / "ops" / OP / f"{OP}_host.cpp").read_text(encoding="utf-8")
    registered = set(re.findall(r'\.impl\(\s*"(\w+)"', source))
    schemas = (ROOT / "gsplat_core" / "native" / "schemas.cpp").read_text(encoding="utf-8")
    assert registered
    for name in registered:
        assert re.search(rf"\b{name}\(", schemas), f"{name} has no schema"
        assert torch._C._dispatch_has_kernel_for_dispatch_key(f"gsplat_core::{name}", "CPU")
