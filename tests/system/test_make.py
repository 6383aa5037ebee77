"""Dry runs of the Makefile's targets."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.missing import missing

ROOT = Path(__file__).resolve().parents[2]


OF_MAKE = ("CUDACXX", "MAKEFLAGS", "MAKEOVERRIDES", "MAKELEVEL", "MARKED")
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


def test_the_demo_builds_for_a_gpu_only_where_there_is_one():
    """`make` runs what is under `$(MAKE)` even in a dry run, so its line is read here."""
    recipe = (ROOT / "Makefile").read_text().partition("\ndemo:")[2].partition("\n\n")[0]
    assert "set -e; if $(BIN)/python -m services.cli.gpu_check; then" in recipe
    assert "||" not in recipe  # a build that fails ends the demo


@pytest.mark.parametrize("value", [None, "", " "])
def test_without_a_compiler_named_the_one_from_pip_is_installed(value):
    environment = {} if value is None else {"CUDACXX": value}
    assert "build/cuda-toolkit" in dry_run("cuda", **environment)


def test_a_compiler_that_is_named_is_used():
    assert "build/cuda-toolkit" not in dry_run("cuda", CUDACXX="/usr/local/cuda/bin/nvcc")


def test_make_cuda_builds_for_the_gpu_at_hand_unless_told():
    assert '-DINTRASPLAT_CUDA_ARCHITECTURES="native"' in dry_run("cuda")
    assert '-DINTRASPLAT_CUDA_ARCHITECTURES="portable"' in dry_run("cuda", "CUDA_ARCHITECTURES=portable")


def test_ci_builds_the_cuda_kernels_and_requires_them():
    script = (ROOT / ".ci" / "run").read_text()
    assert "set -euo pipefail" in script and "INTRASPLAT_REQUIRE_CUDA_BUILD=1" in script
    assert "cuda CUDA_ARCHITECTURES=portable" in script


@pytest.mark.parametrize(("target", "selected"), [("test", True), ("test-all", False)])
def test_slow_tests_are_left_out_by_the_fast_command_alone(target, selected):
    commands = [line for line in dry_run(target).splitlines() if "-m pytest " in line]
    assert len(commands) == 6
    assert all(('-m "not slow"' in line) == selected for line in commands)


def test_ci_runs_all_tests():
    script = (ROOT / ".ci" / "run").read_text().splitlines()
    assert "make test-all" in script and "make test" not in script


def test_the_groups_of_tests_are_all_of_them():
    commands = [line.partition("-m pytest ")[2] for line in dry_run("test-all").splitlines() if "-m pytest " in line]
    groups = [shlex.split(command) for command in commands]
    (rest,) = (group for group in groups if group[0].startswith("--ignore="))
    others = [path for group in groups if group is not rest for path in group]
    assert others and all((ROOT / path).exists() for path in others)
    assert sorted(rest) == sorted(f"--ignore={path}" for path in others)
