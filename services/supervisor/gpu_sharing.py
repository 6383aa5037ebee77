"""NVIDIA's Multi-Process Service (MPS) for the engines of a service.

The processes of several streams take turns on a GPU: while the GPU computes for one, the others wait for their time slice, and their pictures become late.
With MPS they compute at the same time. In return, an error of one process on the GPU ends all engines on that GPU
(https://docs.nvidia.com/deploy/mps/). They restart, and their models begin anew.
"""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from services.bus.runtime import RuntimeFolder, check_path, own_folder
from services.errors import CannotServe
from services.supervisor.launcher import Start

log = logging.getLogger(__name__)

CONTROL = "nvidia-cuda-mps-control"
FOLDER = ".mps"
"""Folder in the runtime folder for the daemon's sockets and logs. Its name is not that of a stream."""
OUTPUT = "control.txt"
"""File in that folder with the output of the control program. It exists from the start of a daemon to its end."""
LONGEST_NAME = "control_privileged"
"""Longest name of a socket in that folder."""
SHARED = "services.supervisor.engine"
"""Module whose processes use MPS."""
ANSWER_S = 10.0
ALREADY_RUNS = "already running"
"""Part of the message of a second daemon for the same folder."""


def check_mps() -> None:
    """Check that this machine has MPS.

    Raises:
        CannotServe: if it does not.
    """
    if shutil.which(CONTROL) is None:
        raise CannotServe(
            f"gpu.mps is set, but there is no program {CONTROL}: it comes with NVIDIA's driver, and in a container with"
            " NVIDIA's Container Toolkit; install it, or set gpu.mps: false"
        )


class WithMps:
    """Starts processes through another `Start`, and engines as clients of an MPS daemon that runs in the runtime folder.

    The daemon outlives the death of this process, like the streams. The next instance uses it. `end_mps` ends it.
    """

    def __init__(self, inner: Start, runtime: RuntimeFolder) -> None:
        """Create the folder of the daemon, which is started before the first engine.

        Raises:
            RuntimeFolderUnusable: if the folder cannot be used.
        """
        self._inner, self._folder = inner, runtime.path / FOLDER
        self._starting = asyncio.Lock()
        check_path(self._folder / LONGEST_NAME)
        own_folder(self._folder)

    async def start(
        self,
        module: str,
        arguments: Sequence[str],
        output: Path,
        environment: Mapping[str, str],
        *,
        fresh: bool = False,
    ) -> int:
        """Start a process and return its process id. Starts the daemon before an engine, if it does not run.

        Raises:
            OSError: if the process or the daemon cannot be started.
        """
        if module == SHARED:
            async with self._starting:
                await self._ensure()
            environment = {**environment, **variables(self._folder)}
        return await self._inner.start(module, arguments, output, environment, fresh=fresh)

    async def how_ended(self, pid: int) -> str | None:
        """Return how a process ended, as a phrase, or None if unknown."""
        return await self._inner.how_ended(pid)

    async def _ensure(self) -> None:
        code, said = await _control(self._folder, ["-d"])
        if code != 0 and ALREADY_RUNS not in said:
            (self._folder / OUTPUT).unlink(missing_ok=True)
            raise OSError(f"NVIDIA's Multi-Process Service (gpu.mps) does not start: {said or f'exit code {code}'}")


async def end_mps(runtime: RuntimeFolder) -> None:
    """End the MPS daemon of this service, or of one that died, after its last client has ended. No effect if none was started."""
    folder = runtime.path / FOLDER
    if not (folder / OUTPUT).exists():
        return
    code, said = await _control(folder, [], "quit\n")
    if code != 0:
        log.warning("NVIDIA's Multi-Process Service in %s does not end: %s", folder, said or f"exit code {code}")
    (folder / OUTPUT).unlink(missing_ok=True)


def variables(folder: Path) -> dict[str, str]:
    """Return the environment variables of the daemon in `folder` and of its clients."""
    return {name: os.fspath(folder) for name in ("CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY")}


async def _control(folder: Path, arguments: Sequence[str], commands: str = "") -> tuple[int, str]:
    """Run the control program; return its exit code and output, or code 1 and the reason why it does not run."""
    environment = {**os.environ, **variables(folder)}
    # The clients' CUDA_VISIBLE_DEVICES counts the daemon's GPUs, which must therefore be all.
    environment.pop("CUDA_VISIBLE_DEVICES", None)
    output = folder / OUTPUT
    try:
        # A file instead of a pipe, which the daemon would hold open.
        with output.open("w") as said:
            process = await asyncio.create_subprocess_exec(
                CONTROL, *arguments, env=environment, start_new_session=True,
                stdin=asyncio.subprocess.PIPE, stdout=said, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
    except OSError as error:
        return 1, f"{CONTROL}: {error.strerror}"
    try:
        async with asyncio.timeout(ANSWER_S):
            await process.communicate(commands.encode())
    except TimeoutError:
        process.kill()
        await process.wait()
        return 1, f"{CONTROL} did not end within {ANSWER_S:g} s"
    return process.returncode or 0, output.read_text(errors="replace").strip()
