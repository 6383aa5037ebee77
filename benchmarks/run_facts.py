"""Provenance of a log line: command, commit, machine, date."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path


def run_facts() -> dict[str, str]:
    """Return the facts of this process. A commit with local changes ends with `+`."""
    here = Path(__file__).resolve().parent
    git = lambda *words: subprocess.run(
        ["git", *words], cwd=here, capture_output=True, text=True, check=True
    ).stdout.strip()
    changed = git(
        "status", "--porcelain", "--untracked-files=no", "--", ":/gsplat_core", ":/operators", ":/benchmarks/*.py"
    )
    script = Path(sys.argv[0]).name
    return {
        "command": shlex.join(["python", f"benchmarks/{script}", *sys.argv[1:]]),
        "commit": git("rev-parse", "--short=12", "HEAD") + ("+" if changed else ""),
        "machine": _processor(),
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%MZ"),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
