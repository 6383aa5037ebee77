"""Ctrl-C during start-up: no traceback and exit code 130."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import os, signal, sys

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)
        return None

sys.meta_path.insert(0, Interrupts())
from services.cli import main
main()
"""


@pytest.mark.parametrize("module", ["services.cli.terminal", "services.cli.app", "typer"])
def test_interrupt_during_imports_exits_130_without_traceback(module):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, module], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 130
    assert "Traceback" not in done.stderr and "Error" not in done.stderr
