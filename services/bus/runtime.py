"""Runtime folder: sockets of the stream processes, and records of the processes. Only its owner has
access.

    RUNTIME/                     0700
      launcher, launcher.json    (`services.supervisor.launcher`)
      STREAM/                    0700
        capture.json  capture.spec  capture.log  capture.lock    and the same for the engine
        engine.show                                 finished model displayed in place of the live reconstruction
        engine.size                                 measured working size of the engine
        raw   capture.status   capture.ctl          sockets of the capture process
        shown engine.status    engine.ctl           sockets of the engine process
        depth confidence orbit                      additional pictures of the engine process

Files of ended processes are recognised by process id *and* start time, and deleted.
"""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from services.bus.errors import AlreadyRunning, RuntimeFolderUnusable
from services.bus.messages import packed_json, parsed_json
from services.bus.process_identity import ProcessIdentity

Role = Literal["capture", "engine"]
ROLES: tuple[Role, ...] = get_args(Role)
PICTURES: Mapping[Role, str] = {"capture": "raw", "engine": "shown"}
"""Picture socket of each process."""
Layer = Literal["depth", "confidence", "orbit"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
"""Additional pictures of the engine, one socket each, produced only while a reader is connected."""
MOST_PATH_BYTES = 100
"""Longest path of a socket in bytes (`man 7 unix`: 108, minus the suffix of libzmq)."""
_LONGEST_NAME = "capture.status"


@dataclass(frozen=True)
class ProcessRecord:
    """Record that a process writes about itself."""

    identity: ProcessIdentity
    spec_digest: str
    """Digest of the specification in use."""


def default_runtime_folder() -> Path:
    """Return the system's default runtime folder for this user."""
    own = os.environ.get("XDG_RUNTIME_DIR")
    return Path(own) / "intrasplat" if own else Path(f"/tmp/intrasplat-{os.geteuid()}")


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
        """Return the record of the running process for a role, or None. Files of an ended process
        are removed."""
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
        """Record this process as the one that serves a role."""
        identity = ProcessIdentity.of(os.getpid())
        assert identity is not None
        write_json(
            self.path / f"{role}.json",
            {"pid": identity.pid, "started": identity.started, "spec_digest": spec_digest},
        )

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
        self.path.rmdir()


def own_folder(path: Path) -> None:
    """Create a folder for this user alone, or verify an existing one.

    Raises:
        RuntimeFolderUnusable: if the folder has another owner or is accessible to other users.
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
            f"{path} may be looked into by others (mode {stat.S_IMODE(found.st_mode):04o}), and patients' pictures go through it;"
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
    with open(descriptor, "wb") as file:
        file.write(packed_json(content))
    os.replace(part, path)


def read_json(path: Path) -> dict[str, Any]:
    """Read a file of `write_json`.

    Raises:
        BadMessage: if the content is malformed.
        OSError: if the file cannot be read.
    """
    return parsed_json(path.read_bytes())
