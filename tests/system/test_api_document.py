"""A real server conforms to the API document. `make fuzz` runs a longer search."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

from tests.system.api_fuzzing import fuzz
from tests.system.servers import serving

pytestmark = pytest.mark.slow

pytest.importorskip("schemathesis", reason="schemathesis comes with the development packages")


def test_api_responses_conform_to_openapi_document():
    """Calls every operation with examples, boundary values and two fixed random inputs."""
    with tempfile.TemporaryDirectory(prefix="isf-") as folder, serving(Path(folder)) as (url, key):
        runs = fuzz(url, key, Path(folder), 2, "--phases", "examples,coverage,fuzzing", "--generation-deterministic")
    for done, fewest in zip(runs, (4, 200), strict=True):
        assert done.returncode == 0, done.stdout[-8000:] + done.stderr
        tried = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
        assert tried and int(tried[1]) == int(tried[2]) >= fewest, done.stdout[-2000:]
