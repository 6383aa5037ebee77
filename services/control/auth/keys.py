"""API keys. Only their digests are kept: a key is 256 random bits, so that one SHA-256 is as good as a slow hash is for a password."""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import json
import os
import re
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from gsplat_core.errors import UserError
from gsplat_core.io.regular_files import read_regular
from services.control.auth.roles import Role

PREFIX = "intrasplat"
MOST_LIVE = 2
"""Of one name: the old key and the new one, while callers change over."""
MOST_KEYS = 1000
_NOBODY = 64 * "0"
_SHA256 = re.compile("[0-9a-f]{64}")
MOST_BYTES = 1 << 24
MOST_TOKEN_BYTES = 4096
_MEND = "put back a copy of it from a backup, or move it away to begin without keys"


class KeyConflict(UserError):
    """Keys cannot be changed in this way now; says why."""


class KeysUnreadable(UserError, ValueError):
    """The file of the keys is damaged, or cannot be read."""


@dataclass(frozen=True)
class ApiKey:
    """What is kept of a key."""

    id: str
    name: str
    role: Role
    sha256: str
    created_at: str


class KeyStore:
    """The keys in a file, which several processes may change: it is read again whenever it has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._on_change: Callable[[str, ApiKey], None] | None = None
        self._lock = threading.Lock()
        self._read: tuple[int, int, int] | None = None
        self._keys: dict[str, ApiKey] = {}

    def watch(self, on_change: Callable[[str, ApiKey], None]) -> None:
        """From now on, call `on_change` with `key.create` or `key.revoke` and the key for each change by another process, when it is seen."""
        self._current()
        self._on_change = on_change

    def find(self, token: str) -> ApiKey | None:
        """The key that a token is; takes the same time for a wrong token as for an unknown one."""
        prefix, _, rest = token.partition("_")
        key_id, _, secret = rest.partition("_")
        key = self._current().get(key_id)
        same = hmac.compare_digest(_digest(secret), key.sha256 if key is not None else _NOBODY)
        return key if same and key is not None and prefix == PREFIX else None

    def is_revoked(self, key_id: str) -> bool:
        """Whether a key that was there is no longer."""
        return key_id not in self._current()

    def all(self) -> list[ApiKey]:
        """Every key, the oldest first."""
        return list(self._current().values())

    def create(self, name: str, role: Role) -> tuple[ApiKey, str]:
        """A new key and its token, which is shown once. Raises KeyConflict where the name has two already."""
        token = f"{PREFIX}_{secrets.token_hex(4)}_{secrets.token_urlsafe(32)}"
        return self.add(name, role, token), token

    def add(self, name: str, role: Role, token: str) -> ApiKey:
        """Keep the digest of a token as a key."""
        if role is Role.PUBLIC:
            raise KeyConflict("no key has the role public; give viewer, operator or admin")
        prefix, key_id, secret = (*token.split("_", 2), "", "")[:3]
        if prefix != PREFIX or len(key_id) < 8 or not key_id.isalnum() or len(secret) < 32:
            raise KeyConflict(f"a key looks like {PREFIX}_ID_SECRET, its secret 32 characters at least")
        with self._changing() as keys:
            live = [key for key in keys.values() if key.name == name]
            if len(live) >= MOST_LIVE or len(keys) >= MOST_KEYS:
                raise KeyConflict(f"{name} has {len(live)} keys; revoke one before making another")
            if any(key.role is not role for key in live):
                raise KeyConflict(f"{name} has a key with the role {live[0].role}; take another name for another role")
            if key_id in keys:
                raise KeyConflict("there is a key with this number already; make another one")
            keys[key_id] = ApiKey(key_id, name, role, _digest(secret), datetime.now(UTC).isoformat(timespec="seconds"))
            return keys[key_id]

    def revoke(self, key_id: str) -> ApiKey:
        """End a key at once. Raises KeyError for one that is not there, KeyConflict for the last administrator's."""
        with self._changing() as keys:
            key = keys[key_id]
            admins = [each for each in keys.values() if each.role is Role.ADMIN]
            if admins == [key]:
                raise KeyConflict("this is the only administrator's key; make another one first")
            return keys.pop(key_id)

    def _current(self) -> dict[str, ApiKey]:
        with self._lock:
            before, stamp = self._keys, self._stamp()
            if stamp != self._read:
                self._keys = _read_keys(self._path) if stamp is not None else {}
                self._read = stamp
            keys = self._keys
        if self._on_change is not None and keys is not before:
            for event, changed in (
                ("key.create", keys.keys() - before.keys()),
                ("key.revoke", before.keys() - keys.keys()),
            ):
                for key_id in sorted(changed):
                    self._on_change(event, {**before, **keys}[key_id])
        return keys

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            status = os.stat(self._path)
        except FileNotFoundError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_size

    @contextmanager
    def _changing(self) -> Iterator[dict[str, ApiKey]]:
        """The keys to change; written when the block ends without an error."""
        self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with open(self._path.with_suffix(".lock"), "a", opener=_private) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            keys = dict(self._current())
            yield keys
            _write(self._path, keys)
            with self._lock:  # what this process changes itself it knows
                self._keys, self._read = keys, self._stamp()


def first_admin_key(store: KeyStore, file: Path) -> bool:
    """At the first start, when there is no key: take the administrator's from `file`, or make one and put it there. Whether one was made."""
    if store.all():
        return False
    if os.path.lexists(file):
        try:
            token = read_regular(file, MOST_TOKEN_BYTES).decode("ascii").strip()
        except OSError as error:
            raise KeysUnreadable(
                f"{file} cannot be read: {error.strerror or error}; give another auth.admin_key_file"
            ) from error
        except UnicodeDecodeError as error:
            raise KeysUnreadable(f"{file} holds no API key: it has bytes that are not ASCII; make it anew") from error
        try:
            store.add("admin", Role.ADMIN, token)
        except KeyConflict as error:
            raise KeyConflict(f"{file} holds no API key: {error}") from error
        return False
    token = f"{PREFIX}_{secrets.token_hex(4)}_{secrets.token_urlsafe(32)}"
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with open(file, "x", opener=_private) as out:
        out.write(token + "\n")
        out.flush()
        os.fsync(out.fileno())
    store.add("admin", Role.ADMIN, token)
    return True


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _read_keys(path: Path) -> dict[str, ApiKey]:
    """Return the keys in a file. Raises KeysUnreadable for a file that this program has not written like that."""
    try:
        keys = _parse(path)
        for key_id, key in keys.items():
            texts = [value for name, value in asdict(key).items() if name != "streams" and value is not None]
            if not all(isinstance(value, str) for value in texts) or not _SHA256.fullmatch(key.sha256):
                raise ValueError(f"the key {key_id!r:.40} has a value that is no text, or no SHA-256")
        return keys
    except OSError as error:
        raise KeysUnreadable(f"{path} cannot be read: {error.strerror or error}; {_MEND}") from error
    except KeyError as error:
        raise KeysUnreadable(f"{path} is damaged: {error} is missing; {_MEND}") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise KeysUnreadable(f"{path} is damaged: {error!s:.200}; {_MEND}") from error


def _parse(path: Path) -> dict[str, ApiKey]:
    keys = [
        ApiKey(**{**each, "role": Role(each["role"])}) for each in json.loads(read_regular(path, MOST_BYTES))["keys"]
    ]
    return {key.id: key for key in keys}


def _write(path: Path, keys: dict[str, ApiKey]) -> None:
    unfinished = path.with_suffix(".new")
    with open(unfinished, "w", opener=_private) as file:
        json.dump({"keys": [asdict(key) for key in keys.values()]}, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    os.replace(unfinished, path)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
