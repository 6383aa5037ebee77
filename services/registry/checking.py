"""Runner of the model check in a separate, limited process. No content of the model is loaded into this process."""

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

from services.errors import CheckFailed
from services.registry.records import CHECK_PASSED_S

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
"""Environment variables passed to the check; none holds credentials."""
_OF_THE_MODEL = {
    signal.SIGKILL,
    signal.SIGSEGV,
    signal.SIGBUS,
    signal.SIGABRT,
    signal.SIGILL,
    signal.SIGFPE,
    signal.SIGXCPU,
}
"""Signals attributed to the checked model: memory, processor time or a fault. Other signals come
from administrators."""


class BroughtDown(Exception):
    """The check process crashed or exceeded a limit because of the checked content. The message describes the end."""


@dataclass(frozen=True)
class Verdict:
    """Result of a check. `reason` is the reason for a rejection, or None if the version is ready."""

    reason: str | None = None
    description: dict[str, Any] = field(default_factory=dict)


class RunningChecks:
    """Set of running check processes, which `end` kills. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._processes: set[subprocess.Popen[bytes]] = set()
        self.ended = False

    @contextlib.contextmanager
    def counted(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        """Register a process for `end` while the block runs. If `end` was already called, the process is killed at
        once."""
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
        """Kill all running check processes, and every process registered later. Their `run_check` raises
        CheckFailed."""
        with self._lock:
            self.ended = True
            for process in self._processes:
                _kill(process)


def run_check(
    folder: Path,
    device: str = "cpu",
    validated: Callable[[dict[str, Any]], None] = lambda description: None,
    program: tuple[str, ...] = PROGRAM,
    running: RunningChecks | None = None,
) -> Verdict:
    """Check the model in `folder`; blocks until there is a verdict. A check that exceeds its limits of memory or CPU
    time, or crashes because of the model, is a verdict too.

    Args:
        folder: unpacked model.
        device: device for the warm-up picture, cpu or cuda.
        validated: called with the description once the contents are valid.
        program: command that runs the check.
        running: registry in which the process is listed.

    Raises:
        CheckFailed: if the check could not run, lasted longer than `CHECK_PASSED_S`, or was killed by
            `RunningChecks.end`.
    """
    command = [*program, str(folder), "--json", "--device", device]
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
        words = run_program(command, CHECK_PASSED_S, take, device=device, running=running)
    except BroughtDown as error:
        return Verdict(str(error))
    if verdict is None:
        raise CheckFailed(f"the check ended with code 0 and without a verdict: {words}; repair that and check again")
    return verdict


def run_conversion(file: Path, target: Path, program: tuple[str, ...], running: RunningChecks) -> str | None:
    """Convert a splat file to a packed model; blocks.

    Returns:
        Reason of a rejection; None if the model was written to `target`.

    Raises:
        CheckFailed: if the conversion could not run or was killed by `RunningChecks.end`.
    """
    lines: list[dict[str, Any]] = []
    try:
        words = run_program([*program, str(file), str(target), "--json"], CHECK_PASSED_S, lines.append, running=running)
    except BroughtDown as error:
        return str(error)
    stages = [line.get("stage") for line in lines]
    if "rejected" in stages:
        return str(lines[stages.index("rejected")].get("reason"))[:MOST_REASON]
    if "ready" not in stages:
        raise CheckFailed(
            f"the conversion ended with code 0 and without a result: {words}; repair that and upload again"
        )
    return None


def run_program(
    command: list[str],
    passed_s: float,
    take: Callable[[dict[str, Any]], None],
    *,
    device: str = "cpu",
    running: RunningChecks | None = None,
) -> str:
    """Run a check program and pass each printed JSON object to `take`.

    Returns:
        The last line that the program wrote to standard error.

    Raises:
        BroughtDown: if the checked content terminated the program.
        CheckFailed: if the program could not run, lasted longer than `passed_s` seconds, or was killed by
            `RunningChecks.end`.
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


@contextlib.contextmanager
def _started(command: list[str], said: Any, device: str) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process, without GPUs if `device` is cpu, and kill it at the end of the block."""
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
    """Kill the process after `seconds`; the yielded event is then set."""
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
    """Kill the process group of a check, which leads its own session. A reaped process is skipped,
    because its id may be reused."""
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _lines(process: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    """Yield the JSON objects that the check prints, until it ends."""
    assert process.stdout is not None
    while line := process.stdout.readline(MOST_LINE_BYTES):
        try:
            values = json.loads(line)
        except ValueError:
            continue  # a library's output; without a verdict line, the exit code is evaluated
        if isinstance(values, dict):
            yield values


def _raise_for_the_end(code: int, late: bool, passed_s: float, said: Any) -> NoReturn:
    """Raise the error for a check process that ended with a non-zero exit code. It depends on whether the checked model
    is the cause.

    Raises:
        BroughtDown: if the checked content is the cause.
        CheckFailed: otherwise.
    """
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
