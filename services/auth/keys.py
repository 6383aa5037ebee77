"""Callers and their credentials: roles, API keys, and single-use tickets for URLs.

Keys are stored as digests in a file, and changes of the file by `intrasplat keys` get audit entries. A key has 256 random bits, so one SHA-256 is as
safe as a slow password hash. A ticket stands in for a key where a browser cannot send one. It is valid for one path, once, and for a short time.
"""

from __future__ import annotations

import asyncio
import fcntl
import hashlib
import hmac
import json
import logging
import os
import re
import secrets
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from gsplat_core.errors import UserError
from gsplat_core.io.files import read_regular
from services.audit import AuditLog, AuditUnwritable
from services.audit.log import Detail

log = logging.getLogger(__name__)


class Role(StrEnum):
    """Caller role, in ascending order. Each role includes the permissions of the previous ones. `public` needs no key and no key has it."""

    PUBLIC = "public"
    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"

    def may(self, needed: Role) -> bool:
        """Return True if this role includes `needed`."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


@dataclass(frozen=True)
class Caller:
    """Authenticated caller: name and id of a key or an OpenID Connect user, and the role."""

    name: str
    key_id: str
    role: Role
    federated: bool = False
    """True for an OpenID Connect user, where `key_id` is not the id of an API key."""
    streams: frozenset[str] | None = None
    """Streams that the key is limited to; None for all."""
    expires_at: float | None = None
    """Unix time in seconds at which the user's token expires; None for an API key."""

    def may_use(self, stream: str) -> bool:
        """Return True if the key's limits include the stream, regardless of whether it exists."""
        return self.streams is None or stream in self.streams

    def __str__(self) -> str:
        return f"{self.name} ({self.key_id})" if self.key_id else self.name


ANYBODY = Caller("anybody", "", Role.PUBLIC)
MOST_TICKETS = 10_000


@dataclass(frozen=True)
class _Ticket:
    caller: Caller
    path: str
    until_s: float


class Tickets:
    """Store of unused single-use tickets for URLs. It is in memory only, so a restart of the server invalidates them."""

    def __init__(self, lifetime_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.lifetime_s = lifetime_s
        self._clock = clock
        self._waiting: dict[str, _Ticket] = {}

    def give(self, caller: Caller, path: str) -> str:
        """Create a ticket with the caller's role for one path."""
        self._forget_old()
        ticket = secrets.token_urlsafe(32)
        self._waiting[_digest(ticket)] = _Ticket(caller, path, self._clock() + self.lifetime_s)
        return ticket

    def use(self, ticket: str, path: str) -> Caller | None:
        """Consume a ticket.

        Returns:
            The caller, or None if the ticket is unknown, used, expired or for another path.
        """
        # Lookup by digest, so the lookup time reveals nothing about existing tickets.
        found = self._waiting.pop(_digest(ticket), None)
        if found is None or found.path != path or self._clock() > found.until_s:
            return None
        return found.caller

    def _forget_old(self) -> None:
        now_s = self._clock()
        for digest in [digest for digest, ticket in self._waiting.items() if ticket.until_s < now_s]:
            del self._waiting[digest]
        while len(self._waiting) >= MOST_TICKETS:
            del self._waiting[next(iter(self._waiting))]


KEYS_FILE = "keys.json"
"""Name of the key file in the data folder of the service."""
PREFIX = "intrasplat"
MOST_LIVE = 2
"""Largest number of valid keys per name: old and new key during a change-over."""
MOST_KEYS = 1000
MOST_STREAMS = 100
"""Largest number of streams that one key may be limited to."""
SAVE_USED_S = 60.0
"""Minimum seconds between two writes of the last-use file."""
_NO_DIGEST = 64 * "0"
_SHA256 = re.compile("[0-9a-f]{64}")
MOST_BYTES = 1 << 24
MOST_TOKEN_BYTES = 4096
_MEND = "put back a copy of it from a backup, or move it away to begin without keys"


class KeyConflict(UserError):
    """The requested change of keys is not permitted."""


class KeysUnwritable(UserError, OSError):
    """The key file cannot be written; the earlier file is unchanged."""

    def __init__(self, path: Path, error: OSError) -> None:
        said = error.strerror or error
        super().__init__(
            f"{path} cannot be written: {said}; no key was changed. Free space on its disk, or mend the rights of its folder"
        )
        self.errno = error.errno


class KeysUnreadable(UserError, ValueError):
    """The key file is damaged or unreadable."""


@dataclass(frozen=True)
class ApiKey:
    """Stored key, without its secret. Times are UTC in ISO 8601."""

    id: str
    name: str
    role: Role
    sha256: str
    created_at: str
    expires_at: str | None = None
    """Expiry; None if the key is valid until revoked."""
    streams: tuple[str, ...] | None = None
    """Streams that the key is limited to; None for all."""

    def has_expired(self, now: datetime | None = None) -> bool:
        """Return True if the key has expired at `now`, by default the current time."""
        return self.expires_at is not None and datetime.fromisoformat(self.expires_at) <= (now or datetime.now(UTC))


class KeyStore:
    """API keys in a file that several processes share. The file is read again when it has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._on_change: Callable[[str, ApiKey], None] | None = None
        self._lock = threading.Lock()
        self._read: tuple[int, int, int] | None = None
        self._keys: dict[str, ApiKey] = {}
        self._used: dict[str, str] | None = None
        self._saved: tuple[float, dict[str, str]] = float("-inf"), {}

    def watch(self, on_change: Callable[[str, ApiKey], None]) -> None:
        """Register a callback for later changes of the key file by other processes.

        Args:
            on_change: called with `key.create` or `key.revoke` and the key.
        """
        self._current()
        self._on_change = on_change

    def find(self, token: str) -> ApiKey | None:
        """Return the valid key of a token, or None. The time does not depend on the reason for None."""
        key = self._match(token)
        return None if key is None or key.has_expired() else key

    def expired(self, token: str) -> ApiKey | None:
        """Return the key of a token if it has expired, otherwise None; for an error message with the expiry."""
        key = self._match(token)
        return key if key is not None and key.has_expired() else None

    def get(self, key_id: str) -> ApiKey | None:
        """Return a valid key by id, or None. Cheap enough for periodic checks of open connections."""
        key = self._current().get(key_id)
        return None if key is None or key.has_expired() else key

    def all(self) -> list[ApiKey]:
        """Return every key, including expired ones, oldest first."""
        return list(self._current().values())

    def note_use(self, key_id: str) -> None:
        """Note a use of a key in memory; `save_used` writes it."""
        self._uses()[key_id] = _now()

    def last_used(self) -> Mapping[str, str]:
        """Return the time of last use by key id, in UTC. Unused keys are absent."""
        if self._used is None:  # no server in this process: another process may have written the file
            return _parse_used(self._used_path)
        return dict(self._used)

    def save_used(self, *, now: bool = False) -> None:
        """Write the times of last use if changed, at most once a minute. Errors are logged, because
        no request depends on this file.

        Args:
            now: write regardless of the interval.
        """
        saved_s, saved = self._saved
        if self._used is None or not (now or time.monotonic() - saved_s >= SAVE_USED_S):
            return
        keys = self._current()
        used = {key_id: at for key_id, at in dict(self._used).items() if key_id in keys}
        if used == saved:
            return
        self._saved = time.monotonic(), used
        try:
            _write_json(self._used_path, used)
        except OSError as error:
            log.error("%s cannot be written: %s; the times of last use are lost at the end", self._used_path, error)

    def create(
        self, name: str, role: Role, *, expires_at: datetime | None = None, streams: Sequence[str] | None = None
    ) -> tuple[ApiKey, str]:
        """Create a key.

        Args:
            name: owner; at most two valid keys share a name.
            role: permissions.
            expires_at: expiry with a time zone, or None.
            streams: streams that the key is limited to, or None for all.

        Returns:
            The key and its token. The token is not stored and cannot be shown again.

        Raises:
            KeyConflict: if the key is not permitted.
        """
        token = _new_token()
        return self.add(name, role, token, expires_at=expires_at, streams=streams), token

    def add(
        self,
        name: str,
        role: Role,
        token: str,
        *,
        expires_at: datetime | None = None,
        streams: Sequence[str] | None = None,
    ) -> ApiKey:
        """Store the digest of a token as a key; see `create` for the other arguments."""
        if role is Role.PUBLIC:
            raise KeyConflict("no key has the role public; give viewer, operator or admin")
        if expires_at is not None:
            expires_at = expires_at.replace(microsecond=0)  # stored with whole seconds
            if expires_at.tzinfo is None or expires_at <= datetime.now(UTC):
                raise KeyConflict(
                    f"a key cannot expire at {expires_at.isoformat()}; give a time to come, with its zone"
                )
        if streams is not None and role is Role.ADMIN:
            raise KeyConflict("an administrator's key is not limited to streams; take the role operator or viewer")
        if streams is not None and not 0 < len(streams) <= MOST_STREAMS:
            raise KeyConflict(
                f"a key is limited to 1 to {MOST_STREAMS} streams, and not to {len(streams)}; leave them out for all"
            )
        prefix, key_id, secret = (*token.split("_", 2), "", "")[:3]
        if prefix != PREFIX or len(key_id) < 8 or not key_id.isalnum() or len(secret) < 32:
            raise KeyConflict(f"a key looks like {PREFIX}_ID_SECRET, its secret 32 characters at least")
        with self._changing() as keys:
            live = [key for key in keys.values() if key.name == name and not key.has_expired()]
            if len(live) >= MOST_LIVE:
                raise KeyConflict(f"{name} has {len(live)} keys; revoke one before making another")
            if len(keys) >= MOST_KEYS:
                raise KeyConflict(
                    f"there are {len(keys)} keys, expired ones among them; revoke one before making another"
                )
            if any(key.role is not role for key in live):
                raise KeyConflict(f"{name} has a key with the role {live[0].role}; take another name for another role")
            if key_id in keys:
                raise KeyConflict("a key with this number already exists; make another one")
            keys[key_id] = ApiKey(
                key_id, name, role, _digest(secret), _now(),
                None if expires_at is None else expires_at.astimezone(UTC).isoformat(timespec="seconds"),
                None if streams is None else tuple(sorted(set(streams))),
            )  # fmt: skip
            return keys[key_id]

    def revoke(self, key_id: str) -> ApiKey:
        """Revoke a key at once.

        Raises:
            KeyError: if the id is unknown.
            KeyConflict: if it is the last administrator's key.
        """
        with self._changing() as keys:
            key = keys[key_id]
            admins = [each for each in keys.values() if each.role is Role.ADMIN and not each.has_expired()]
            if admins == [key]:
                raise KeyConflict("this is the only administrator's key; make another one first")
            return keys.pop(key_id)

    def _match(self, token: str) -> ApiKey | None:
        """Return the key of a token, expired or not; None for a wrong token. An unknown key id takes as long as a wrong
        secret.
        """
        prefix, _, rest = token.partition("_")
        key_id, _, secret = rest.partition("_")
        key = self._current().get(key_id)
        same = hmac.compare_digest(_digest(secret), key.sha256 if key is not None else _NO_DIGEST)
        return key if same and key is not None and prefix == PREFIX else None

    @property
    def _used_path(self) -> Path:
        return self._path.with_suffix(".used.json")

    def _uses(self) -> dict[str, str]:
        """Return the time of last use by key id, loaded from the file on first access."""
        if self._used is None:
            self._used = _parse_used(self._used_path)
            self._saved = self._saved[0], dict(self._used)
        return self._used

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
        except OSError as error:
            raise KeysUnreadable(f"{self._path} cannot be read: {error.strerror or error}; {_MEND}") from error
        return status.st_ino, status.st_mtime_ns, status.st_size

    @contextmanager
    def _changing(self) -> Iterator[dict[str, ApiKey]]:
        """Provide the keys for a change under the file lock; written if the block ends without an error."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            opened = open(self._path.with_suffix(".lock"), "a", opener=_private)  # noqa: SIM115 - closed below
        except OSError as error:
            raise KeysUnwritable(self._path.with_suffix(".lock"), error) from error
        with opened as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            keys = dict(self._current())
            yield keys
            _write(self._path, keys)
            with self._lock:  # adopt the new keys here, so that this process's own change is not reported to `watch`
                self._keys, self._read = keys, self._stamp()


def first_admin_key(store: KeyStore, file: Path) -> bool:
    """Create the administrator's key at the first start, from the token in `file` if that exists.

    Returns:
        True if a new token was created and written to `file`.
    """
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
    token = _new_token()
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with open(file, "x", opener=_private) as out:
        out.write(token + "\n")
        out.flush()
        os.fsync(out.fileno())
    store.add("admin", Role.ADMIN, token)
    return True


def _new_token() -> str:
    return f"{PREFIX}_{secrets.token_hex(4)}_{secrets.token_urlsafe(32)}"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _read_keys(path: Path) -> dict[str, ApiKey]:
    """Read the key file.

    Raises:
        KeysUnreadable: if the file does not have the expected format.
    """
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
    keys = [_key_of(each) for each in json.loads(read_regular(path, MOST_BYTES))["keys"]]
    return {key.id: key for key in keys}


def _key_of(values: Mapping[str, Any]) -> ApiKey:
    """Parse a key. Expiry and streams are optional for files of older versions. Unknown fields are
    refused, because they may restrict the key."""
    streams = values.get("streams")
    key = ApiKey(
        **{**values, "role": Role(values["role"]), "streams": None if streams is None else tuple(map(str, streams))}
    )
    if key.expires_at is not None and datetime.fromisoformat(key.expires_at).tzinfo is None:
        raise ValueError(f"the key {key.id} expires at {key.expires_at}, which has no time zone")
    return key


def _parse_used(path: Path) -> dict[str, str]:
    """Read the times of last use; empty if the file is missing or damaged, because it will be rewritten."""
    if not path.is_file():
        return {}
    try:
        found = json.loads(read_regular(path, MOST_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        log.error("%s cannot be read: %s; it is begun anew", path, error)
        return {}
    return {str(key): str(at) for key, at in found.items()} if isinstance(found, dict) else {}


def _write(path: Path, keys: dict[str, ApiKey]) -> None:
    """Write the keys. Unset fields are omitted, so older versions can read the file."""
    values = [{name: value for name, value in asdict(key).items() if value is not None} for key in keys.values()]
    _write_json(path, {"keys": values})


def _write_json(path: Path, values: object) -> None:
    """Replace a file durably.

    Raises:
        KeysUnwritable: if that fails. The earlier file is then unchanged.
    """
    unfinished = path.with_suffix(".new")
    try:
        with open(unfinished, "w", opener=_private) as file:
            json.dump(values, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except OSError as error:
        with suppress(OSError):
            unfinished.unlink()
        raise KeysUnwritable(path, error) from error


def _private(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)


SHELL = "shell"
"""Actor of changes by a user with write access to the server's folder."""
AGAIN_S = 2.0


def append_key_change(audit: AuditLog, event: str, key: ApiKey) -> None:
    """Append the audit entry of a key change.

    Raises:
        AuditUnwritable: if the entry cannot be written.
    """
    if event == "key.create":
        subject, detail = key.name, {"key_id": key.id, **limits_of(key)}
    else:
        subject, detail = key.id, {"name": key.name}
    audit.append(event, actor=SHELL, subject=subject, detail={"role": str(key.role), **detail})


def limits_of(key: ApiKey) -> Detail:
    """Return the expiry and streams of a key for the audit log, if set."""
    found: Detail = {}
    if key.expires_at is not None:
        found["expires_at"] = key.expires_at
    if key.streams is not None:  # audit values have a length limit: number of streams and first names
        found["streams"] = f"{len(key.streams)}: {' '.join(key.streams)}"[:400]
    return found


def changed_outside(audit: AuditLog, event: str, key: ApiKey) -> None:
    """Append the audit entry of a key change by another process. That change cannot be refused, so a failure is
    only logged."""
    try:
        append_key_change(audit, event, key)
    except (AuditUnwritable, ValueError) as error:
        log.error("%s of %s is not in the audit log: %s", event, key.id, error)


@asynccontextmanager
async def keys_read_again(keys: KeyStore) -> AsyncIterator[None]:
    """Poll for key changes while the block runs and once at its end, independently of requests.
    Also saves the times of last use."""
    looking = asyncio.create_task(_refresh(keys), name="changes of keys")
    try:
        yield
    finally:
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        await asyncio.to_thread(_refresh_once, keys, ends=True)


async def _refresh(keys: KeyStore) -> None:
    while True:
        await asyncio.sleep(AGAIN_S)
        await asyncio.to_thread(_refresh_once, keys)


def _refresh_once(keys: KeyStore, *, ends: bool = False) -> None:
    try:
        keys.all()
        keys.save_used(now=ends)
    # Requests are refused until the file is readable again, so the polling continues.
    except (OSError, ValueError, TypeError, KeyError) as error:
        log.error("the file of the API keys cannot be read: %s", error)
