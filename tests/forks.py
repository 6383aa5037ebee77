"""Run functions and pytest in forks of a process that has imported the large libraries."""

from __future__ import annotations

import importlib
import math
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("gsplat_core", "operators", "services")
LIBRARIES = (
    "torch", "numpy", "cv2", "pydantic", "fastapi", "uvicorn", "zmq", "httpx2", "typer", "onnx", "sqlalchemy", "alembic", "av",
    "hypothesis",
)  # fmt: skip
"""Libraries that take long to import. None of them imports the project."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Environment variables that limit the threads of numeric libraries."""
RAISED = 70
"""Exit code of a fork whose function raised an exception."""
OPTIONS = [
    "-p", "no:terminal", "-p", "no:cacheprovider", "-o", "addopts=--strict-markers --import-mode=importlib", "-m", "not slow",
    "-W", "ignore::pytest.PytestAssertRewriteWarning",  # plugins that the libraries imported before pytest
]  # fmt: skip
"""Options for pytest in forks: the fast tests, without a report."""


def import_libraries() -> None:
    """Import the large libraries once. Forks of this process do not import them again.

    Numeric libraries get one thread unless the environment sets another number, because most arrays in tests are too small for several.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as in the Makefile: idle threads of OpenMP do not spin
    for name in LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(name)


def import_libraries_alone() -> None:
    """Import the large libraries without the project, for forks that execute a changed project. No bytecode is kept."""
    os.environ.update({name: "1" for name in ("PYTHONDONTWRITEBYTECODE", *THREADS)})
    sys.dont_write_bytecode = True
    import_libraries()
    loaded = [name for name in sys.modules if name.split(".")[0] in PACKAGES]
    if loaded:
        sys.exit(f"the libraries imported {loaded[0]}: it would not be loaded again")


class Fork:
    """Fork of this process that executes a function and ends. It leads a process group of its own.

    Args:
        function: returns the exit code.
        output: file for standard output and errors, with those of processes that the function starts.
        limit_s: time limit in seconds.
    """

    def __init__(self, function: Callable[[], int], output: Path, limit_s: float = math.inf) -> None:
        sys.stdout.flush()
        self.output, self._deadline = output, time.monotonic() + limit_s
        self._pid = os.fork()
        if self._pid:
            return
        code = RAISED
        try:
            os.setsid()
            file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(file, 1)
            os.dup2(file, 2)
            code = function()
        finally:
            if sys.exc_info()[0] is not None:
                traceback.print_exc()
            sys.stdout.flush()
            os._exit(code)

    def interrupt(self) -> None:
        """Send SIGINT to the fork and to the processes in its group."""
        with suppress(ProcessLookupError):
            os.killpg(self._pid, signal.SIGINT)

    def ended(self) -> bool:
        """Return whether the fork has ended; it is killed after the time limit, with the processes that it left running."""
        done, status = os.waitpid(self._pid, os.WNOHANG)
        if not done and time.monotonic() < self._deadline:
            return False
        with suppress(ProcessLookupError):
            os.killpg(self._pid, signal.SIGKILL)
        self.code = os.waitstatus_to_exitcode(status if done else os.waitpid(self._pid, 0)[1])
        self.timed_out = not done
        return True

    def wait(self) -> int:
        """Wait for the end and return the exit code, negative after a signal."""
        while not self.ended():
            time.sleep(0.02)
        return self.code


def pytest_fork(
    tests: Sequence[str], folder: Path, plugin: object, hook: str = "", limit_s: float = math.inf,
    after: Callable[[int], None] = lambda code: None,
) -> Fork:  # fmt: skip
    """Run pytest in a fork.

    Args:
        tests: test files and tests.
        folder: folder for the output and for `sitecustomize.py`.
        plugin: plugin for pytest.
        hook: code to execute before pytest and in each process that tests start.
        limit_s: time limit in seconds.
        after: called in the fork with pytest's exit code.
    """

    def run() -> int:
        if hook:
            execute_everywhere(hook, folder)
        code = int(pytest.main([*OPTIONS, *tests], plugins=[plugin]))
        after(code)
        return code

    return Fork(run, folder / "output.txt", limit_s)


def execute_everywhere(hook: str, folder: Path) -> None:
    """Execute code in this process and at the start of each Python process that it starts."""
    (folder / "sitecustomize.py").write_text(hook, encoding="utf-8")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    exec(compile(hook, "sitecustomize.py", "exec"), {})
