"""Keys that are made and revoked by `intrasplat keys` are in the audit log, as those of the API are: written by the command itself where no server
runs, else by the server, which sees that the file has changed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from services.audit import AuditLog, AuditUnwritable
from services.audit.entries import Detail
from services.control.auth.keys import ApiKey, KeyStore

log = logging.getLogger(__name__)
SHELL = "shell"
"""Who has done it: somebody who may write into the server's folder."""
AGAIN_S = 2.0


def append_key_change(audit: AuditLog, event: str, key: ApiKey) -> None:
    """Write the entry. Raises AuditUnwritable."""
    if event == "key.create":
        subject, detail = key.name, {"key_id": key.id, **limits_of(key)}
    else:
        subject, detail = key.id, {"name": key.name}
    audit.append(event, actor=SHELL, subject=subject, detail={"role": str(key.role), **detail})


def limits_of(key: ApiKey) -> Detail:
    """Return the expiry and the streams of a key for the audit log; nothing where it has none."""
    found: Detail = {}
    if key.expires_at is not None:
        found["expires_at"] = key.expires_at
    if key.streams is not None:  # an entry's values are short: the first names, and how many there are
        found["streams"] = f"{len(key.streams)}: {' '.join(key.streams)}"[:400]
    return found


def changed_outside(audit: AuditLog, event: str, key: ApiKey) -> None:
    """The key is changed already: what cannot be written to the audit log is in the log."""
    try:
        append_key_change(audit, event, key)
    except (AuditUnwritable, ValueError) as error:
        log.error("%s of %s is not in the audit log: %s", event, key.id, error)


@asynccontextmanager
async def keys_read_again(keys: KeyStore) -> AsyncIterator[None]:
    """While the block lasts, and once more at its end, look for changes of the keys, for no request may come to see them; and write the times of
    last use."""
    looking = asyncio.create_task(_look(keys), name="changes of keys")
    try:
        yield
    finally:
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        await asyncio.to_thread(_look_once, keys, ends=True)


async def _look(keys: KeyStore) -> None:
    while True:
        await asyncio.sleep(AGAIN_S)
        await asyncio.to_thread(_look_once, keys)


def _look_once(keys: KeyStore, *, ends: bool = False) -> None:
    try:
        keys.all()
        keys.save_used(now=ends)
    except (OSError, ValueError, TypeError, KeyError) as error:  # requests get an error until it can be read again
        log.error("the file of the API keys cannot be read: %s", error)
