"""Audit logging of changes: the entry is written before the caller gets the answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from starlette.requests import ClientDisconnect, Request

from services.audit.files import Detail, Outcome
from services.control.auth.roles import Caller
from services.control.problems import Problem
from services.control.state import control_of


@asynccontextmanager
async def recorded(
    request: Request, caller: Caller, event: str, subject: str, detail: Detail | None = None
) -> AsyncIterator[Detail]:
    """Append an audit entry with the outcome when the block ends.

    Exceptions of the block are recorded as refused (status below 500) or failed, and re-raised.
    Values added to the yielded dictionary become part of the entry.

    Args:
        request: request that causes the change.
        caller: authenticated caller.
        event: event name, such as `key.create`.
        subject: name of the changed resource.
        detail: initial values of the entry's detail.

    Yields:
        The detail of the entry.

    Raises:
        AuditUnwritable: if the entry cannot be written, although the change may already be made.
    """
    said: Detail = dict(detail or {})
    outcome: Outcome = "failed"
    try:
        yield said
        outcome = "done"
    except Exception as error:
        outcome = "failed" if _status_of(request, error) >= 500 else "refused"
        said["error"] = type(error).__name__
        raise
    finally:
        await _write(request, caller, event, subject, outcome, said)


async def _write(request: Request, caller: Caller, event: str, subject: str, outcome: Outcome, detail: Detail) -> None:
    control = control_of(request)

    def append() -> None:
        control.audit.append(
            event, actor=str(caller), role=caller.role, subject=subject, outcome=outcome,
            request_id=request.state.request_id, detail=detail,
        )  # fmt: skip

    # The entry is written even if the caller disconnects now.
    await asyncio.shield(asyncio.to_thread(append))


def _status_of(request: Request, error: Exception) -> int:
    if isinstance(error, Problem):
        return error.status
    if isinstance(error, ClientDisconnect):
        return 400
    known = control_of(request).parts.errors
    return next((known[each].status for each in type(error).__mro__ if each in known), 500)
