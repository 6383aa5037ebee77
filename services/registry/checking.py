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
from typing import Any, NoReturn

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


class BroughtDown(Exception):
    """A check was ended by what it checked; the text says how."""


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
    command = [*program, str(folder), "--json", "--device", device, *_budgets(limits)]
    verdict, description = None, dict[str, Any]()

    def take(line: dict[str, Any]) -> None:
        nonlocal verdict
        stage = line.pop("stage", None)
        if stage == "rejected":
            verdict = Verdict(str(line.get("reason"))[:MOST_REASON], description)
        elif stage in ("validated", "ready"):
            description.update(line)
            verdict = Verdict(None, description) if stage == "ready" else verdict
            if stage == "validated":
                validated(description)

    try:
        words = run_program(command, limits.check_passed_s, take, device=device, running=running)
    except BroughtDown as error:
        return Verdict(str(error))
    if verdict is None:
        raise CheckFailed(f"the check ended with code 0 and without a verdict: {words}; repair that and check again")
    return verdict


def run_program(
    command: list[str],
    passed_s: float,
    take: Callable[[dict[str, Any]], None],
    *,
    device: str = "cpu",
    running: RunningChecks | None = None,
) -> str:
    """Run a check, hand each object that it prints to `take`; returns its last words when it has ended well.

    Raises BroughtDown where what it checked has ended it, CheckFailed where it could not be run at all, or was ended with the others.
    """
    running = running or RunningChecks()
    with tempfile.TemporaryFile() as said, _started(command, said, device) as process, running.counted(process):
        with _time_limit(process, passed_s) as late:
            for line in _lines(process):
                take(line)
            code = process.wait()
        if code != 0 and running.ended:
            raise CheckFailed("the check was ended because the service stops; it waits for another one")
        if code != 0:
            _raise_for_the_end(code, late.is_set(), passed_s, said)
        return _last_words(said)


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


def _raise_for_the_end(code: int, late: bool, passed_s: float, said: Any) -> NoReturn:
    """Raises BroughtDown or CheckFailed for a check that ended badly."""
    if late:
        raise CheckFailed(f"the check lasted longer than {passed_s:g} s; check again when this machine is less busy")
    if code < 0 and -code in _OF_THE_MODEL:
        raise BroughtDown(
            f"its check was ended by {signal.Signals(-code).name}, as one is that takes too much memory or time"
        )
    raise CheckFailed(
        f"the check ended with code {code} and without a verdict: {_last_words(said)}; repair that and check again"
    )


def _last_words(said: Any) -> str:
    said.seek(max(0, said.seek(0, os.SEEK_END) - 2000))
    words = said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
    return str(words[-1][:300])
