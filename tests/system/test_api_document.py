"""What the API's document says holds for a real server: `make fuzz` tries more of it, for longer."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

from tests.system.api_fuzzing import fuzz
from tests.system.servers import serving

pytest.importorskip("schemathesis", reason="schemathesis comes with the development packages")


def test_no_answer_is_a_server_error_or_undocumented():
    """Every operation with its examples, values at and beyond each limit of its schema, and two at random, the same ones each time. Exports are
    left to `make fuzz`: each of another time starts a process that loads torch. So are snapshots: of a stream that is just starting they are
    503, rightly, until its engine answers."""
    with tempfile.TemporaryDirectory(prefix="isf-") as folder, serving(Path(folder)) as (url, key):
        bounded = (
            "--phases",
            "examples,coverage,fuzzing",
            "--generation-deterministic",
            "--exclude-path-regex",
            "/exports/|/snapshots$",
        )
        done = fuzz(url, key, Path(folder), 2, *bounded)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr
    tried = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
    assert tried and int(tried[1]) == int(tried[2]) > 200, done.stdout[-2000:]
