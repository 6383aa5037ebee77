"""Dry runs of the Makefile's targets."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.missing import missing

ROOT = Path(__file__).resolve().parents[2]


OF_MAKE = ("CUDACXX", "MAKEFLAGS", "MAKEOVERRIDES", "MAKELEVEL")
"""Variables that a make above these tests sets."""


def dry_run(*arguments: str, **environment: str) -> str:
    if shutil.which("make") is None:
        missing("there is no make")
    clean = {name: value for name, value in os.environ.items() if name not in OF_MAKE}
    done = subprocess.run(
        ["make", "--dry-run", "--always-make", *arguments],
        cwd=ROOT, env=clean | environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout


def test_make_demo_builds_cuda_only_with_gpu():
    """The recipe is read, because `make` executes lines with `$(MAKE)` even in a dry run."""
    recipe = (ROOT / "Makefile").read_text().partition("\ndemo:")[2].partition("\n\n")[0]
    assert "set -e; if $(BIN)/python -m services.cli.doctor; then" in recipe
    assert "||" not in recipe  # a build that fails ends the demo


@pytest.mark.parametrize("value", [None, "", " "])
def test_make_cuda_installs_toolkit_without_cudacxx(value):
    environment = {} if value is None else {"CUDACXX": value}
    assert "build/cuda-toolkit" in dry_run("cuda", **environment)


def test_make_cuda_uses_cudacxx():
    assert "build/cuda-toolkit" not in dry_run("cuda", CUDACXX="/usr/local/cuda/bin/nvcc")


def test_make_cuda_builds_native_architecture_by_default():
    assert '-DINTRASPLAT_CUDA_ARCHITECTURES="native"' in dry_run("cuda")
    assert '-DINTRASPLAT_CUDA_ARCHITECTURES="portable"' in dry_run("cuda", "CUDA_ARCHITECTURES=portable")


def test_ci_builds_and_requires_cuda_kernels():
    script = (ROOT / ".ci" / "run").read_text()
    assert "set -euo pipefail" in script and "INTRASPLAT_REQUIRE_CUDA_BUILD=1" in script
    built, earlier = script.index("cuda CUDA_ARCHITECTURES=90-real"), script.rindex("for_earlier_gpus")
    assert built < earlier, "files with other code for GPUs before 9.0 are compiled for these, too"
    assert '="80-real;90-real"' in dry_run("cuda", "CUDA_ARCHITECTURES=80-real;90-real")


@pytest.mark.parametrize(("target", "selected"), [("test", True), ("test-all", False)])
def test_make_test_is_fast_and_make_test_all_is_not(target, selected):
    (command,) = [line for line in dry_run(target).splitlines() if "-m tests.groups" in line]
    assert ("--fast" in command.split()) == selected


def test_ci_runs_make_test_all():
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    commands = [line.partition("||")[0].split() for line in lines if line.startswith("make ")]
    assert any("test-all" in words for words in commands) and not any("test" in words for words in commands)
