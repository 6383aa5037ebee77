"""Running the check of a model in a process of its own, within bounds, and reading its verdict. Nothing of the model enters this process."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from services.registry.errors import CheckFailed
from services.registry.limits import RegistryLimits

PROGRAM = (sys.executable, "-P", "-m", "services.registry.check")
MOST_LINE_BYTES = 1 << 16
MOST_REASON = 500

_PASSED_ON = (
    "PATH",
    "PYTHONPATH",
    "LD_LIBRARY_PATH",
    "LANG",
    "LC_ALL",
    "TMPDIR",
    "HOME",
    "OMP_NUM_THREADS",
    "INTRASPLAT_ISA",
)
"""What the check gets of the environment: no credentials are among it."""
_OF_THE_MODEL = {
    signal.SIGKILL,
    signal.SIGSEGV,
    signal.SIGBUS,
    signal.SIGABRT,
    signal.SIGILL,
    signal.SIGFPE,
    signal.SIGXCPU,
}
"""Signals that end a check because of what it checked: too much memory or time, or a fault. Others come from people."""


@dataclass(frozen=True)
class Verdict:
    """What a check came to. `reason` says why a version is rejected; None: it is ready."""

    reason: str | None = None
    description: dict[str, Any] = field(default_factory=dict)


class RunningChecks:
    """The processes of the checks that run now. Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._processes: set[subprocess.Popen[bytes]] = set()
        self.ended = False

    @contextlib.contextmanager
    def counted(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        """While entered, `end` ends this process. One that comes after `end` is ended at once."""
        with self._lock:
            self._processes.add(process)
            if self.ended:
                _kill(process)
        try:
            yield
        finally:
            with self._lock:
                self._processes.discard(process)

    def end(self) -> None:
        """End every check that runs, and every one that is begun from now on; each raises CheckFailed."""
        with self._lock:
            self.ended = True
            for process in self._processes:
                _kill(process)


def run_check(
    folder: Path,
    limits: RegistryLimits,
    device: str = "cpu",
    validated: Callable[[dict[str, Any]], None] = lambda description: None,
    program: tuple[str, ...] = PROGRAM,
    running: RunningChecks | None = None,
) -> Verdict:
    """Check the model in `folder`; blocks until there is a verdict.

    A check that takes too much processor time or memory, or that a model brings down, is a verdict too. validated: called once the contents are in order.
    running: where the process is counted while it runs. Raises CheckFailed where the check could not be run at all, or was ended with the others.
    """
    running = running or RunningChecks()
    command = [*program, str(folder), "--json", "--device", device, *_budgets(limits)]
    verdict, description = None, dict[str, Any]()
    with tempfile.TemporaryFile() as said, _started(command, said, device) as process, running.counted(process):
        with _time_limit(process, limits.check_passed_s) as late:
            for line in _lines(process):
                stage = line.pop("stage", None)
                if stage == "rejected":
                    verdict = Verdict(str(line.get("reason"))[:MOST_REASON], description)
                elif stage in ("validated", "ready"):
                    description |= line
                    verdict = Verdict(None, description) if stage == "ready" else verdict
                    if stage == "validated":
                        validated(description)
            code = process.wait()
        if code == 0 and verdict is not None:
            return verdict
        if running.ended:
            raise CheckFailed("the check was ended because the service stops; the version waits for another one")
        return _of_the_end(code, late.is_set(), limits, said)


def _budgets(limits: RegistryLimits) -> list[str]:
    return [
        f"--gaussians={limits.gaussians}",
        f"--model-bytes={limits.model_bytes}",
        f"--pixels={limits.pixels}",
        f"--memory-bytes={limits.check_memory_bytes}",
        f"--seconds={limits.check_s}",
    ]


@contextlib.contextmanager
def _started(command: list[str], said: Any, device: str) -> Iterator[subprocess.Popen[bytes]]:
    """The running process; it does not outlive this context."""
    environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    if device == "cpu":
        environment["CUDA_VISIBLE_DEVICES"] = ""
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=said,
            env=environment,
            start_new_session=True,
        )
    except OSError as error:
        raise CheckFailed(
            f"the check cannot be started: {error.strerror or error}; free memory or processes, and check again"
        ) from error
    try:
        yield process
    finally:
        _kill(process)
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


@contextlib.contextmanager
def _time_limit(process: subprocess.Popen[bytes], seconds: float) -> Iterator[threading.Event]:
    """Ends the process when the time is over; the event says that it came to that."""
    late = threading.Event()

    def end() -> None:
        late.set()
        _kill(process)

    timer = threading.Timer(seconds, end)
    timer.start()
    try:
        yield late
    finally:
        timer.cancel()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End the process and what it started; it leads a session of its own. One that was waited for is gone, and its number may be another's."""
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _lines(process: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    """The objects that the check prints, until it ends."""
    assert process.stdout is not None
    while line := process.stdout.readline(MOST_LINE_BYTES):
        try:
            values = json.loads(line)
        except ValueError:
            continue  # a library's own words; without a verdict the exit code speaks
        if isinstance(values, dict):
            yield values


def _of_the_end(code: int, late: bool, limits: RegistryLimits, said: Any) -> Verdict:
    """The verdict on a check that ended without one. Raises CheckFailed where that says nothing about the model."""
    if late:
        raise CheckFailed(
            f"the check lasted longer than {limits.check_passed_s:g} s; check again when this machine is less busy"
        )
    if code < 0 and -code in _OF_THE_MODEL:
        return Verdict(
            f"its check was ended by {signal.Signals(-code).name}, as one is that takes too much memory or time"
        )
    said.seek(max(0, said.seek(0, os.SEEK_END) - 2000))
    words = said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
    raise CheckFailed(
        f"the check ended with code {code} and without a verdict: {words[-1][:300]}; repair that and check again"
    )
