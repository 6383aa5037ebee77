"""Process start: directly, or by the launcher for a quick start."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from services.bus.messages import MOST_BYTES, packed_json, parsed_json
from services.bus.runtime import ProcessIdentity, RuntimeFolder, read_json
from services.errors import BadMessage, NoAnswer
from services.supervisor.process_end import status_of_child

log = logging.getLogger(__name__)
SOCKET, RECORD = "launcher", "launcher.json"
FORKED = ("services.supervisor.capture", "services.supervisor.engine")
"""Modules that the launcher can fork."""
LOADS_LONG = ("services.supervisor.engine",)
"""Modules that take as long to import as the launcher itself. Waiting for a starting launcher is no
slower than importing twice at once."""
LOADING_S = 60.0
ANSWER_S = 5.0
LOOK_S = 0.05
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
        """Return a description of how a process ended, or None if unknown."""
        ...


class Direct:
    """Start in a new interpreter and a new session, so the process outlives this one."""

    async def start(
        self,
        module: str,
        arguments: Sequence[str],
        output: Path,
        environment: Mapping[str, str],
        *,
        fresh: bool = False,
    ) -> int:
        """See `Start`."""
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
        """See `Start`."""
        return status_of_child(pid)


class ByLauncher:
    """Start through the launcher, which this class starts and restarts if it dies.

    While the launcher is loading, engines wait for it and quickly loading modules are started
    directly. Streams of a runtime folder share one instance.
    """

    def __init__(self, folder: RuntimeFolder, orphan_after_s: float = 600.0) -> None:
        self._folder, self._orphan_after_s = folder, orphan_after_s
        self._direct = Direct()
        self._own_pid: int | None = None
        self._keeping: asyncio.Task[None] | None = None
        self.ready = asyncio.Event()
        """Set while the launcher accepts requests."""

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
        """See `Start`."""
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
        """See `Start`."""
        how = status_of_child(pid)
        if how is None and self.ready.is_set():
            try:
                how = (await self._ask("status", pid=pid))["status"]
            except (NoAnswer, BadMessage, OSError, KeyError):
                return None
        return how

    async def _is_there(self, module: str) -> bool:
        """Return True if the launcher is ready; for slow modules wait until it has loaded."""
        if not self.ready.is_set() and self._keeping is not None and module in LOADS_LONG:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self.ready.wait(), LOADING_S)
        return self.ready.is_set()

    async def _keep(self) -> None:
        """Keep a launcher running: start it if needed, then ping it periodically."""
        while True:
            if recorded_launcher(self._folder) is None:
                self.ready.clear()
                if self._own_pid is None or status_of_child(self._own_pid) is not None or not _runs(self._own_pid):
                    self._clean()
                    self._own_pid = await self._direct.start(
                        "services.supervisor.launcher",
                        ["--folder", os.fspath(self._folder.path), "--orphan-after-s", str(self._orphan_after_s)],
                        self._folder.path / "launcher.log",
                        {},
                    )
                await asyncio.sleep(LOOK_S)
                continue
            try:
                await self._ask("ping")
                self.ready.set()
            except (NoAnswer, BadMessage, OSError) as error:
                self.ready.clear()
                log.warning("the launcher does not answer: %s", error)
            await asyncio.sleep(PING_S)

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
    """Return the identity of the running launcher of a runtime folder, or None."""
    try:
        content = read_json(folder.path / RECORD)
    except (FileNotFoundError, BadMessage):
        return None
    identity = ProcessIdentity(int(content["pid"]), str(content["started"]))
    return identity if identity.is_alive else None


def _runs(pid: int) -> bool:
    return ProcessIdentity.of(pid) is not None
