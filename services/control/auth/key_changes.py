"""Audit entries for key changes by `intrasplat keys`.

Without a running server the command writes the entry. Otherwise the server writes it when it
detects the changed file.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from services.audit import AuditLog, AuditUnwritable
from services.audit.files import Detail
from services.control.auth.keys import ApiKey, KeyStore

log = logging.getLogger(__name__)
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
    if key.streams is not None:  # audit values are short: the number of streams and the first names
        found["streams"] = f"{len(key.streams)}: {' '.join(key.streams)}"[:400]
    return found


def changed_outside(audit: AuditLog, event: str, key: ApiKey) -> None:
    """Append the audit entry of a change by another process. The change is already made, so a
    failure is only logged."""
    try:
        append_key_change(audit, event, key)
    except (AuditUnwritable, ValueError) as error:
        log.error("%s of %s is not in the audit log: %s", event, key.id, error)


@asynccontextmanager
async def keys_read_again(keys: KeyStore) -> AsyncIterator[None]:
    """Poll for key changes while the block runs and once at its end, independently of requests.
    Also saves the times of last use."""
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
    # requests are answered with an error until the file is readable again
    except (OSError, ValueError, TypeError, KeyError) as error:
        log.error("the file of the API keys cannot be read: %s", error)
