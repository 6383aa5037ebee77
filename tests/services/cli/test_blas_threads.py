"""The command uses one BLAS thread on every machine, so that sums have one order."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

DIGEST = """
import hashlib, os, sys
from services.cli import main
sys.argv = ["intrasplat", "--version"]
try:
    main()
except SystemExit as end:
    assert end.code in (0, None), end.code
import numpy as np
matrix = np.random.default_rng(0).standard_normal((300, 300))
found = [np.linalg.inv(matrix), np.linalg.solve(matrix, matrix[0]), matrix.ravel() @ matrix.ravel()]
print(hashlib.sha256(b"".join(each.tobytes() for each in found)).hexdigest())
"""


def digest_with(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", DIGEST], capture_output=True, text=True, check=True, env={**os.environ, **environment}
    )
    return done.stdout.split()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["2", "3"])
def test_results_do_not_depend_on_openblas_num_threads(threads):
    assert digest_with(OPENBLAS_NUM_THREADS=threads) == digest_with(OPENBLAS_NUM_THREADS="1")
