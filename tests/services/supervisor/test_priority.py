"""Niceness of processes."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import os
from services.supervisor.worker import step_back
began = os.nice(0)
step_back(began + 3)
step_back(began)
print(os.nice(0) - began)
"""


def test_step_back_only_raises_niceness():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, start_new_session=True
    )
    assert done.stdout == "3\n"
