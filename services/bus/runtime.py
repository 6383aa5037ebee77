"""Runtime folder of the service: sockets of the stream processes, and records of the processes. Only its owner has access.

`ProcessIdentity` identifies a process safely although the system reuses process ids.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from signal import pidfd_send_signal
from typing import Any, Literal, get_args

from services.bus.messages import packed_json, parsed_json
from services.errors import AlreadyRunning, RuntimeFolderUnusable

_STATE, _STARTED = 0, 19
"""Positions of process state and start time in /proc/PID/stat, counted after the process name. The name may contain
anything, so the fields are located from its closing bracket.
"""


@dataclass(frozen=True)
class ProcessIdentity:
    """Process id and start time, which together are unique."""

    pid: int
    started: str
    """Boot id of the machine, and the start time of the process in clock ticks since boot."""

    @staticmethod
    def of(pid: int) -> ProcessIdentity | None:
        """Return the identity of a process, or None if it does not exist or is a zombie."""
        try:
            fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            return None
        if fields[_STATE] in "ZX":
            return None
        return ProcessIdentity(pid, f"{_boot()} {fields[_STARTED]}")

    @staticmethod
    def own() -> ProcessIdentity:
        """Return the identity of this process."""
        identity = ProcessIdentity.of(os.getpid())
        assert identity is not None
        return identity

    @property
    def is_alive(self) -> bool:
        """True while the process with this id and start time runs."""
        return ProcessIdentity.of(self.pid) == self

    def signal(self, number: int) -> bool:
        """Send a signal to this process only.

        Returns:
            False if the process has ended.
        """
        try:
            handle = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return False
        try:
            # The pidfd refers to one process. A process id that is reused after this check therefore gets no signal.
            if not self.is_alive:
                return False
            pidfd_send_signal(handle, number)
        except ProcessLookupError:
            return False
        finally:
            os.close(handle)
        return True

    async def ended(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the process, which need not be a child.

        Returns:
            False after `timeout_s`.
        """
        try:
            handle = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        loop, over = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(handle, over.set)  # the pidfd becomes readable when the process ends
        try:
            if self.is_alive:
                await asyncio.wait_for(over.wait(), timeout_s)
            return True
        except TimeoutError:
            return False
        finally:
            loop.remove_reader(handle)
            os.close(handle)


@cache
def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


Role = Literal["capture", "engine"]
ROLES: tuple[Role, ...] = get_args(Role)
PICTURES: Mapping[Role, str] = {"capture": "raw", "engine": "shown"}
"""Name of the picture socket of each process, by role."""
Layer = Literal["depth", "confidence", "orbit"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
"""Additional pictures of the engine, one socket each, produced only while a reader is connected."""
MOST_PATH_BYTES = 100
"""Longest path of a socket in bytes (`man 7 unix`: 108, minus the suffix of libzmq)."""
_LONGEST_NAME = "capture.status"


@dataclass(frozen=True)
class ProcessRecord:
    """Identity and settings digest of a running stream process, written by the process itself."""

    identity: ProcessIdentity
    spec_digest: str
    """Digest of the specification that the process was started with."""


class RuntimeFolder:
    """Runtime folder of one service.

    Raises:
        RuntimeFolderUnusable: if the folder cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(os.path.abspath(path))
        own_folder(self.path)

    def stream(self, name: str) -> StreamFolder:
        """Return the folder of a stream, created if missing.

        Raises:
            RuntimeFolderUnusable: if the folder cannot be used.
        """
        return StreamFolder(self.path / name)

    def streams(self) -> list[str]:
        """Return the names of the streams with a folder."""
        return sorted(entry.name for entry in self.path.iterdir() if entry.is_dir() and not entry.is_symlink())


class StreamFolder:
    """Runtime folder of one stream.

    Raises:
        RuntimeFolderUnusable: if the folder cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        check_path(path / _LONGEST_NAME)
        own_folder(path)

    def endpoint(self, name: str) -> str:
        """Return the ZeroMQ address of a socket."""
        return f"ipc://{self.path / name}"

    def pictures(self, role: Role) -> str:
        """Return the address at which a process publishes pictures."""
        return self.endpoint(PICTURES[role])

    def status(self, role: Role) -> str:
        """Return the address at which a process publishes heartbeats."""
        return self.endpoint(f"{role}.status")

    def commands(self, role: Role) -> str:
        """Return the address at which a process accepts commands."""
        return self.endpoint(f"{role}.ctl")

    def spec(self, role: Role) -> Path:
        """Return the specification file of a process."""
        return self.path / f"{role}.spec"

    @property
    def engine_size(self) -> Path:
        """Return the file with the measured working size of the engine."""
        return self.path / "engine.size"

    def log(self, role: Role) -> Path:
        """Return the log file of a process."""
        return self.path / f"{role}.log"

    def record(self, role: Role) -> ProcessRecord | None:
        """Return the record of the running process for a role, or None. If the process has ended, remove its
        sockets and its record."""
        try:
            content = parsed_json((self.path / f"{role}.json").read_bytes())
            identity = ProcessIdentity(int(content["pid"]), str(content["started"]))
        except FileNotFoundError:
            return None
        if identity.is_alive:
            return ProcessRecord(identity, str(content["spec_digest"]))
        self.clean(role)
        return None

    def write_record(self, role: Role, spec_digest: str) -> None:
        """Write the record of this process, which runs as `role` with the specification of this digest."""
        write_json(self.path / f"{role}.json", {**asdict(ProcessIdentity.own()), "spec_digest": spec_digest})

    def lock(self, role: Role) -> int:
        """Lock a role for this process until it ends.

        Returns:
            The descriptor that holds the lock.

        Raises:
            AlreadyRunning: if another process holds the lock.
        """
        held = os.open(self.path / f"{role}.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            raise AlreadyRunning(
                f"another {role} process serves {self.path}; stop it, or choose another runtime folder"
            ) from None
        return held

    def clean(self, role: Role) -> None:
        """Delete the sockets and the record of an ended process."""
        layers = LAYERS if role == "engine" else ()
        for name in (PICTURES[role], *layers, f"{role}.status", f"{role}.ctl", f"{role}.json"):
            (self.path / name).unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete the stream's folder after its processes have ended."""
        for role in ROLES:
            self.clean(role)
            for path in (self.spec(role), self.log(role), self.path / f"{role}.lock", self.path / f"{role}.show"):
                path.unlink(missing_ok=True)
        self.engine_size.unlink(missing_ok=True)
        for part in self.path.glob("*.part"):  # of a process that was killed while it wrote
            part.unlink(missing_ok=True)
        if self.path.exists():
            self.path.rmdir()


def own_folder(path: Path) -> None:
    """Create a folder for this user alone, or verify an existing one.

    Raises:
        RuntimeFolderUnusable: if it cannot be created, is no folder, has another owner or is accessible to other users.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise RuntimeFolderUnusable(f"{path} cannot be made: {error.strerror}; choose another runtime folder") from None
    if not stat.S_ISDIR(found.st_mode):
        raise RuntimeFolderUnusable(f"{path} is no folder; remove it, or choose another runtime folder")
    if found.st_uid != os.geteuid():
        raise RuntimeFolderUnusable(
            f"{path} belongs to user {found.st_uid} and this process to {os.geteuid()}; choose another runtime folder"
        )
    if found.st_mode & 0o077:
        raise RuntimeFolderUnusable(
            f"{path} can be read by other users (mode {stat.S_IMODE(found.st_mode):04o}), but patients' pictures pass through it;"
            f" run `chmod 700 {path}`"
        )


def check_path(path: Path) -> None:
    """Check the length of a socket's path.

    Raises:
        RuntimeFolderUnusable: if it is too long.
    """
    length = len(os.fsencode(path))
    if length > MOST_PATH_BYTES:
        raise RuntimeFolderUnusable(
            f"{path} has {length} bytes, and a socket's path may have {MOST_PATH_BYTES}; choose a shorter runtime folder or stream name"
        )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Replace a file atomically, readable by its owner only."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    descriptor = os.open(part, os.O_CREAT | os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        with open(descriptor, "wb") as file:
            file.write(packed_json(content))
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file written by `write_json`.

    Raises:
        BadMessage: if the content is malformed.
        OSError: if the file cannot be read.
    """
    return parsed_json(path.read_bytes())
