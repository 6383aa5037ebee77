"""Keys that are made and revoked by `intrasplat keys` are in the audit log, as those of the API are: written by the command itself where no server
runs, else by the server, which sees that the file has changed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from services.audit import AuditLog, AuditUnwritable
from services.control.auth.keys import ApiKey, KeyStore

log = logging.getLogger(__name__)
SHELL = "shell"
"""Who has done it: somebody who may write into the server's folder."""
AGAIN_S = 2.0


def append_key_change(audit: AuditLog, event: str, key: ApiKey) -> None:
    """Write the entry. Raises AuditUnwritable."""
    subject, detail = (key.name, {"key_id": key.id}) if event == "key.create" else (key.id, {"name": key.name})
    audit.append(event, actor=SHELL, subject=subject, detail={"role": str(key.role), **detail})


def changed_outside(audit: AuditLog, event: str, key: ApiKey) -> None:
    """The key is changed already: what cannot be written to the audit log is in the log."""
    try:
        append_key_change(audit, event, key)
    except (AuditUnwritable, ValueError) as error:
        log.error("%s of %s is not in the audit log: %s", event, key.id, error)


@asynccontextmanager
async def keys_read_again(keys: KeyStore) -> AsyncIterator[None]:
    """While the block lasts, and once more at its end, look whether the keys were changed: a request would see it, but none may come."""
    looking = asyncio.create_task(_look(keys), name="changes of keys")
    try:
        yield
    finally:
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        await asyncio.to_thread(_look_once, keys)


async def _look(keys: KeyStore) -> None:
    while True:
        await asyncio.sleep(AGAIN_S)
        await asyncio.to_thread(_look_once, keys)


def _look_once(keys: KeyStore) -> None:
    try:
        keys.all()
    except (OSError, ValueError, TypeError, KeyError) as error:  # requests get an error until it can be read again
        log.error("the file of the API keys cannot be read: %s", error)
