"""Start and end of processes: directly, or forked by the launcher for a quick start.

The launcher is a process, `python -m services.supervisor.launcher --folder RUNTIME`. It loads the heavy modules once and forks capture and engine processes
that need not load them again. `Direct` and `ByLauncher` start a process; `ended_how` and `cause_of` describe its end.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import importlib
import json
import logging
import os
import re
import select
import signal
import socket
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn, Protocol

from gsplat_core.errors import UserError
from services.bus.messages import MOST_BYTES, packed_json, parsed_json
from services.bus.runtime import ProcessIdentity, RuntimeFolder, check_path, own_folder, read_json, write_json
from services.errors import AlreadyRunning, BadMessage, NoAnswer, RuntimeFolderUnusable
from services.private_files import keep_files_private
from services.settings import masked_address
from services.supervisor.worker import ORPHAN_DRAIN_S, Parent, identity_of

FINISHED = 0
FAILED = 1
NO_USE = 2
"""Exit code of a process with an invalid specification or configuration; a restart would fail in the same way."""
_TAIL_BYTES = 4096
_LOGGED = re.compile(r"[\d-]+ [\d:,]+ (?P<level>[A-Z]+) [\w.]+: ")
"""Prefix of a line in the log of a stream process: time, level and logger."""


def ended_how(status: int) -> str:
    """Describe a wait status from `os.waitpid`."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"killed by {signal.Signals(number).name}"
    return f"exit code {os.waitstatus_to_exitcode(status)}"


def status_of_child(pid: int) -> str | None:
    """Describe the end of a child process. None if the process still runs or is not a child."""
    try:
        found, status = os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:
        return None
    return ended_how(status) if found else None


def is_of_no_use(how: str | None) -> bool:
    """Return True if a process ended with `NO_USE`, so that a restart would fail in the same way."""
    return how == f"exit code {NO_USE}"


def cause_of(how: str) -> str:
    """Reduce the description of a process's end to one of a few causes, for metric labels."""
    if how.endswith("it was killed"):
        return "hung"
    if how.startswith("killed by "):
        return how.removeprefix("killed by ")
    if is_of_no_use(how):
        return "refused"
    return how if how.startswith("exit code ") else "ended"


def last_words(log: Path) -> str:
    """Return the last error in a process's log, or its last line if it has no error; empty without a readable log."""
    try:
        with open(log, "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
            lines = [line.strip() for line in file.read().decode(errors="replace").split("\n") if line.strip()]
    except OSError:
        return ""
    errors = [index for index, line in enumerate(lines) if (match := _LOGGED.match(line)) and match["level"] == "ERROR"]
    if errors:
        more = lines[errors[-1] + 1 :]
        ends = next((index for index, line in enumerate(more) if _LOGGED.match(line)), len(more))
        lines = [" ".join([_LOGGED.sub("", lines[errors[-1]]), *more[:ends]])]
    return masked_address(_LOGGED.sub("", lines[-1]))[:500] if lines else ""


log = logging.getLogger(__name__)
SOCKET, RECORD = "launcher", "launcher.json"
FORKED = ("services.supervisor.capture", "services.supervisor.engine")
"""Modules that the launcher can fork."""
LOADS_LONG = ("services.supervisor.engine",)
"""Modules that import as long as the launcher itself. Their start waits for a launcher that is still loading, which
is no slower than a second import at the same time."""
LOADING_S = 60.0
ANSWER_S = 5.0
POLL_S = 0.05
PING_S = 1.0


class Start(Protocol):
    """Interface for starting a module of this package as a process."""

    async def start(
        self,
        module: str,
        arguments: Sequence[str],
        output: Path,
        environment: Mapping[str, str],
        *,
        fresh: bool = False,
    ) -> int:
        """Start a process.

        Args:
            module: module to run.
            arguments: command line arguments.
            output: log file for standard output and standard error.
            environment: additional environment variables.
            fresh: use a new interpreter, never a fork.

        Returns:
            The process id.

        Raises:
            OSError: if the process cannot be started.
        """
        ...

    async def how_ended(self, pid: int) -> str | None:
        """Return how a process ended, as a phrase, or None if unknown."""
        ...


class Direct:
    """Starts a process in a new interpreter and a new session, so that it survives the end of the supervisor."""

    async def start(
        self,
        module: str,
        arguments: Sequence[str],
        output: Path,
        environment: Mapping[str, str],
        *,
        fresh: bool = False,
    ) -> int:
        """Start a process in a new interpreter and return its process id."""
        flags = os.O_CREAT | os.O_WRONLY | os.O_APPEND
        return os.posix_spawn(
            sys.executable,
            [sys.executable, "-m", module, *arguments],
            {**os.environ, **environment},
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                (os.POSIX_SPAWN_OPEN, 1, os.fspath(output), flags, 0o600),
                (os.POSIX_SPAWN_DUP2, 1, 2),
            ],
            setsid=True,
            setsigdef=[signal.SIGINT, signal.SIGTERM, signal.SIGHUP],
        )

    async def how_ended(self, pid: int) -> str | None:
        """Return how a process ended, as a phrase, or None if unknown."""
        return status_of_child(pid)


class ByLauncher:
    """Starts processes by forks of the launcher, which this class starts, and restarts if it dies.

    While the launcher is loading, engines wait for it and quickly loading modules are started
    directly. Streams of a runtime folder share one instance.
    """

    def __init__(self, folder: RuntimeFolder, orphan_after_s: float = 0.0) -> None:
        self._folder, self._orphan_after_s = folder, orphan_after_s
        self._own = asdict(ProcessIdentity.own())
        self._direct = Direct()
        self._own_pid: int | None = None
        self._keeping: asyncio.Task[None] | None = None
        self._fails = False
        """True while no launcher can be started, so that nothing waits for one."""
        self.ready = asyncio.Event()
        """Event that is set while the launcher accepts requests."""

    def open(self) -> None:
        """Adopt the launcher of the runtime folder or start one. No effect if already open."""
        if self._keeping is None:
            self._keeping = asyncio.create_task(self._keep(), name="launcher")

    async def close(self, *, stop: bool) -> None:
        """Stop supervising the launcher.

        Args:
            stop: also end the launcher; otherwise it stays for the next `open`.
        """
        keeping, self._keeping = self._keeping, None
        if keeping is not None:
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
        self.ready.clear()
        identity = recorded_launcher(self._folder)
        if identity is None and self._own_pid is not None:
            identity = ProcessIdentity.of(self._own_pid)  # the launcher is still loading
        if stop and identity is not None:
            identity.signal(signal.SIGTERM)
            if not await identity.ended(ANSWER_S):
                identity.signal(signal.SIGKILL)
                await identity.ended()
        if self._own_pid is not None:
            status_of_child(self._own_pid)
        if stop:
            self._clean()

    async def start(
        self,
        module: str,
        arguments: Sequence[str],
        output: Path,
        environment: Mapping[str, str],
        *,
        fresh: bool = False,
    ) -> int:
        """Start a process by a fork of the launcher and return its process id. With `fresh`, for a module that is not in
        `FORKED`, and without a running launcher, it is started in a new interpreter.
        """
        if fresh or module not in FORKED or not await self._is_there(module):
            return await self._direct.start(module, arguments, output, environment)
        try:
            answer = await self._ask(
                "start",
                module=module,
                arguments=list(arguments),
                log=os.fspath(output),
                environment=dict(environment),
            )
            return int(answer["pid"])
        except (NoAnswer, BadMessage, OSError) as error:
            log.warning("the launcher did not start %s (%s); it is started directly", module, error)
            return await self._direct.start(module, arguments, output, environment)

    async def how_ended(self, pid: int) -> str | None:
        """Return how the process ended, from the launcher if it is the parent; None if unknown."""
        how = status_of_child(pid)
        if how is None and self.ready.is_set():
            try:
                how = (await self._ask("status", pid=pid))["status"]
            except (NoAnswer, BadMessage, OSError, KeyError):
                return None
        return how

    async def _is_there(self, module: str) -> bool:
        """Return True if the launcher accepts requests. For a module in `LOADS_LONG`, wait up to `LOADING_S` for it
        first."""
        if not self.ready.is_set() and self._keeping is not None and not self._fails and module in LOADS_LONG:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self.ready.wait(), LOADING_S)
        return self.ready.is_set()

    async def _keep(self) -> None:
        """Keep a launcher running: start it if needed, then ping it periodically."""
        while True:
            try:
                pause_s = await self._check()
                self._fails = False
            except (OSError, RuntimeFolderUnusable) as error:
                self.ready.clear()
                if not self._fails:
                    log.warning("the launcher cannot be started: %s; processes are started directly", error)
                self._fails, pause_s = True, PING_S
            await asyncio.sleep(pause_s)

    async def _check(self) -> float:
        """Start the launcher, or ping a running one, and return the time until the next check in seconds.

        The runtime folder is created if it has been removed, which also ended the launcher.
        """
        if recorded_launcher(self._folder) is None:
            self.ready.clear()
            if self._own_pid is None or status_of_child(self._own_pid) is not None or not _runs(self._own_pid):
                own_folder(self._folder.path)
                self._clean()
                self._own_pid = await self._direct.start(
                    "services.supervisor.launcher",
                    [
                        "--folder",
                        os.fspath(self._folder.path),
                        "--orphan-after-s",
                        str(self._orphan_after_s),
                        "--supervisor",
                        json.dumps(self._own),
                    ],
                    self._folder.path / "launcher.log",
                    {},
                )
            return POLL_S
        try:
            await self._ask("ping", supervisor=self._own)
            self.ready.set()
        except (NoAnswer, BadMessage, OSError) as error:
            self.ready.clear()
            log.warning("the launcher does not answer: %s", error)
        return PING_S

    async def _ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        try:
            async with asyncio.timeout(ANSWER_S):
                reader, writer = await asyncio.open_unix_connection(os.fspath(self._folder.path / SOCKET))
                try:
                    writer.write(packed_json({"command": command, **arguments}))
                    await writer.drain()
                    answer = parsed_json(await reader.read(MOST_BYTES))
                finally:
                    writer.close()
        except TimeoutError:
            raise NoAnswer(f"the launcher has not answered {command!r} within {ANSWER_S:g} s") from None
        if answer.get("ok") is not True:
            raise NoAnswer(f"the launcher refuses {command!r}: {answer.get('error')}")
        return answer

    def _clean(self) -> None:
        for name in (SOCKET, RECORD):
            (self._folder.path / name).unlink(missing_ok=True)


def recorded_launcher(folder: RuntimeFolder) -> ProcessIdentity | None:
    """Return the identity of the running launcher of a runtime folder; None if none runs."""
    try:
        content = read_json(folder.path / RECORD)
    except (FileNotFoundError, BadMessage):
        return None
    identity = ProcessIdentity(int(content["pid"]), str(content["started"]))
    return identity if identity.is_alive else None


def _runs(pid: int) -> bool:
    return ProcessIdentity.of(pid) is not None


LOADED = (
    "operators.sources.process",
    "operators.sources.recording",
    "operators.sources.zeromq",
)
"""Modules of frame sources that the launcher imports in advance, because capture processes are likely to use them."""
LAUNCHER_POLL_S = 0.2
REQUEST_S = 1.0
"""Timeout in seconds for reading a request and sending its answer."""
ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that end the launcher and its processes."""
MOST_REMEMBERED = 256
"""Maximum number of exit statuses that the launcher keeps until they are queried."""


class Launcher:
    """Server on the launcher's socket. It ends on `stop`, when its supervisor has died, or when its socket file is
    removed. After the supervisor's death it also ends its children."""

    def __init__(self, path: Path, parent: Parent) -> None:
        self._path, self._parent = path, parent
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path.unlink(missing_ok=True)
        self._listener.bind(os.fspath(path))
        self._listener.listen(16)
        self._stopped = False
        self._ends: dict[int, str] = {}
        self._children: set[int] = set()

    def stop(self, *_: Any) -> None:
        """Request the end of `serve`. Also used as signal handler."""
        self._stopped = True

    def serve(self) -> None:
        """Answer requests until `stop`, the supervisor's death or the removal of the socket file."""
        while not self._stopped:
            self._reap()
            if self._parent.lost(time.monotonic()):
                self._end_children()
                break
            if not self._path.exists():
                break
            if not select.select([self._listener], [], [], LAUNCHER_POLL_S)[0]:
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
            command = request.get("command")
            if command == "ping" and "supervisor" in request:
                self._parent.identity = identity_of(request["supervisor"])
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
        # Until the new process has no handlers of the launcher, `Launcher.stop` would take its signals.
        unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        try:
            pid = os.fork()
            if pid == 0:
                self._listener.close()
                connection.close()
                _become(module, arguments, environment, output)
            self._children.add(pid)
            return pid
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
            os.close(output)

    def _end_children(self) -> None:
        """Wait for the child processes, which end after the supervisor's death, and kill those that hang."""
        until_s = time.monotonic() + ORPHAN_DRAIN_S + LAUNCHER_POLL_S
        while self._children and time.monotonic() < until_s:
            time.sleep(POLL_S)
            self._reap()
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)  # not reaped yet, so the process id is still that of the child

    def _reap(self) -> None:
        """Collect the exit statuses of ended processes."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            self._children.discard(pid)
            self._ends[pid] = ended_how(status)
            while len(self._ends) > MOST_REMEMBERED:
                del self._ends[next(iter(self._ends))]


def _become(module: str, arguments: Sequence[str], environment: Mapping[str, str], output: int) -> NoReturn:
    """Run a module's `main` in a forked process; never returns."""
    code = 1
    try:
        os.setsid()
        for number in ENDING:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
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
    """Run the launcher until a stop is requested. Return the exit code: 0, or 2 if the folder is unusable or in use."""
    keep_files_private()
    parser = argparse.ArgumentParser(description="Forks the processes of streams.")
    parser.add_argument("--folder", required=True, help="runtime folder")
    parser.add_argument("--orphan-after-s", type=float, default=0.0, help="time to continue without a supervisor")
    parser.add_argument("--supervisor", type=json.loads, help="process id and start time of the supervisor, as JSON")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # The NVML check detects GPUs without initialising CUDA; after initialisation no forked engine could use CUDA.
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

    supervisor = None if given.supervisor is None else identity_of(given.supervisor)
    launcher = Launcher(folder.path / SOCKET, Parent(supervisor, given.orphan_after_s))
    for number in ENDING:
        signal.signal(number, launcher.stop)
    write_json(folder.path / RECORD, asdict(ProcessIdentity.own()))
    try:
        launcher.serve()
    finally:
        (folder.path / RECORD).unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
