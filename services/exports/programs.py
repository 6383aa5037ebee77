"""Runner of the export program with a time limit. No content of the model is loaded into this
process."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from gsplat_core.io.exports.formats import ExportWish
from services.errors import ExportFailed, ExportRefused
from services.exports.formats import arguments_of

PROGRAM = (sys.executable, "-P", "-m", "services.exports.make")
REFUSED = 2
MOST_S = 300.0
PASSED_ON = (
    "PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TMPDIR", "HOME", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS",
)  # fmt: skip
"""Environment variables passed to the program; none holds credentials."""


class ExportPrograms:
    """Running export programs. Thread-safe."""

    def __init__(self, program: tuple[str, ...] = PROGRAM, most_s: float = MOST_S) -> None:
        self._program, self._most_s = program, most_s
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._ended = False

    def make(self, folder: Path, file: Path, wish: ExportWish) -> None:
        """Create one file from an unpacked model; blocks.

        Raises:
            ExportRefused: if the model cannot be exported to the format.
            ExportFailed: if the program fails.
        """
        command = [*self._program, str(folder), str(file), *arguments_of(wish)]
        environment = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
        with tempfile.TemporaryFile() as said:
            try:
                process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said,
                    env={**environment, "CUDA_VISIBLE_DEVICES": ""}, start_new_session=True,
                )  # fmt: skip
            except OSError as error:
                raise ExportFailed(f"the export cannot be started: {error.strerror or error}; try again") from error
            with self._counted(process):
                try:
                    code = process.wait(self._most_s)
                except subprocess.TimeoutExpired:
                    raise ExportFailed(f"the export took longer than {self._most_s:g} s; ask for fewer times") from None
                finally:
                    _kill(process)
            said.seek(max(0, said.seek(0, os.SEEK_END) - 2000))
            words = said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
        if code == REFUSED:
            raise ExportRefused(words[-1][:500])
        if code != 0:
            raise ExportFailed(f"the export ended with code {code}: {words[-1][:300]}; the server's log may say more")

    def end(self) -> None:
        """Kill running programs and every later one."""
        with self._lock:
            self._ended = True
            for process in self._running:
                _kill(process)

    @contextlib.contextmanager
    def _counted(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        with self._lock:
            self._running.add(process)
            if self._ended:
                _kill(process)
        try:
            yield
        finally:
            with self._lock:
                self._running.discard(process)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill the process group of a program that leads its own session. A reaped process is skipped,
    because its id may be reused."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
