"""The tests that compute-sanitizer runs are named in a file: none of them may have gone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent


def test_every_named_test_is_there():
    named = (ROOT / "benchmarks" / "sanitized_tests.txt").read_text().splitlines()
    assert len(named) == len(set(named)) > 50
    command = [sys.executable, "-m", "pytest", "--collect-only", "--quiet", "--no-header", *named]
    collected = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert collected.returncode == 0, collected.stdout + collected.stderr
