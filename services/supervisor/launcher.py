"""Launcher process, `python -m services.supervisor.launcher --folder RUNTIME`: forks capture and
engine processes.

The launcher has imported everything that these processes need. Importing torch takes seconds and
forking takes milliseconds, so a crashed process is replaced quickly. The launcher computes nothing,
has one thread and uses no GPU. A forked process therefore starts in a clean state and shares the
launcher's memory.

Each connection to the launcher's socket carries one JSON request and one JSON answer:

| request | answer |
|---|---|
| `{"command": "start", "module": NAME, "arguments": [...], "log": PATH, "environment": {...}}` | `{"ok": true, "pid": N}` |
| `{"command": "status", "pid": N}` | `{"ok": true, "status": "signal 9"}`; null if it still runs or is unknown |
| `{"command": "ping"}`, `{"command": "stop"}` | `{"ok": true}` |
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import importlib
import logging
import os
import select
import signal
import socket
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gsplat_core.errors import UserError
from services.bus.messages import MOST_BYTES, packed_json, parsed_json
from services.bus.runtime import ProcessIdentity, RuntimeFolder, check_path, write_json
from services.errors import AlreadyRunning, BadMessage
from services.private_files import keep_files_private
from services.supervisor.launching import FORKED, RECORD, SOCKET, recorded_launcher
from services.supervisor.process_end import ended_how

log = logging.getLogger(__name__)
LOADED = (
    "operators.sources.process",
    "operators.sources.recording",
    "operators.sources.synthetic",
    "operators.sources.zeromq",
)
"""Source modules that capture processes are likely to import."""
LOOK_S = 0.2
REQUEST_S = 1.0
"""Timeout for reading a request, in seconds."""
MOST_REMEMBERED = 256
"""Exit statuses kept for processes whose status was not queried yet."""


class Launcher:
    """Server on the launcher's socket. Ends on `stop`, after `orphan_after_s` without requests, or
    when the socket file is removed."""

    def __init__(self, path: Path, orphan_after_s: float) -> None:
        self._path, self._orphan_after_s = path, orphan_after_s
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path.unlink(missing_ok=True)
        self._listener.bind(os.fspath(path))
        self._listener.listen(16)
        self._stopped = False
        self._ends: dict[int, str] = {}
        self._heard_s = time.monotonic()

    def stop(self, *_: Any) -> None:
        """Request the end of `serve`. Also used as signal handler."""
        self._stopped = True

    def serve(self) -> None:
        """Answer requests until the end."""
        while not self._stopped and time.monotonic() - self._heard_s < self._orphan_after_s:
            self._reap()
            if not self._path.exists():
                break
            if not select.select([self._listener], [], [], LOOK_S)[0]:
                continue
            connection, _ = self._listener.accept()
            with connection:
                connection.settimeout(REQUEST_S)
                with contextlib.suppress(OSError):  # the client has disconnected
                    connection.sendall(packed_json(self._answer(connection)))
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _answer(self, connection: socket.socket) -> dict[str, Any]:
        try:
            request = parsed_json(connection.recv(MOST_BYTES))
            self._heard_s = time.monotonic()
            command = request.get("command")
            if command == "start":
                return {"ok": True, "pid": self._start(request, connection)}
            if command == "status":
                self._reap()
                return {"ok": True, "status": self._ends.get(int(request["pid"]))}
            if command == "stop":
                self.stop()
            return {"ok": command in ("stop", "ping")}
        except (BadMessage, KeyError, TypeError, ValueError, OSError) as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}

    def _start(self, request: Mapping[str, Any], connection: socket.socket) -> int:
        arguments = [str(argument) for argument in request["arguments"]]
        module = str(request["module"])
        if module not in FORKED:
            raise ValueError(f"{module[:60]!r} is not forked, only {', '.join(FORKED)}")
        environment = {str(name): str(value) for name, value in dict(request["environment"]).items()}
        output = os.open(str(request["log"]), os.O_CREAT | os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC, 0o600)
        try:
            pid = os.fork()
            if pid == 0:
                self._listener.close()
                connection.close()
                _become(module, arguments, environment, output)
            return pid
        finally:
            os.close(output)

    def _reap(self) -> None:
        """Collect the exit statuses of ended processes."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            self._ends[pid] = ended_how(status)
            while len(self._ends) > MOST_REMEMBERED:
                del self._ends[next(iter(self._ends))]


def _become(module: str, arguments: Sequence[str], environment: Mapping[str, str], output: int) -> NoReturn:
    """Run a module's `main` in a forked process; never returns."""
    code = 1
    try:
        os.setsid()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.environ.update(environment)
        code = importlib.import_module(module).main(arguments)
    except BaseException:  # noqa: BLE001 - the forked process must never continue as the launcher
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until asked to stop.

    Returns:
        The exit code.
    """
    keep_files_private()
    parser = argparse.ArgumentParser(description="Forks the processes of streams.")
    parser.add_argument("--folder", required=True, help="runtime folder")
    parser.add_argument("--orphan-after-s", type=float, default=600.0)
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # The NVML check detects GPUs without initialising CUDA; after initialisation no forked engine
    # could use CUDA.
    os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
    try:
        folder = RuntimeFolder(Path(given.folder))
        check_path(folder.path / SOCKET)
        if recorded_launcher(folder) is not None:
            raise AlreadyRunning(f"another launcher serves {folder.path}; stop it, or choose another runtime folder")
    except UserError as error:
        log.error("%s", error)
        return 2
    for module in (*FORKED, *LOADED):
        importlib.import_module(module)
    gc.collect()
    gc.freeze()  # excludes the imported objects from garbage collection, so their pages stay shared

    identity = ProcessIdentity.of(os.getpid())
    assert identity is not None
    launcher = Launcher(folder.path / SOCKET, given.orphan_after_s)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, launcher.stop)
    write_json(folder.path / RECORD, {"pid": identity.pid, "started": identity.started})
    try:
        launcher.serve()
    finally:
        (folder.path / RECORD).unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
