"""The audit log, read."""

from __future__ import annotations

import asyncio

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.recorded import recorded
from services.control.state import control_of

router = new_router("audit")


class EntryView(BaseModel):
    """An entry."""

    model_config = ConfigDict(from_attributes=True)
    seq: int
    at: str
    event: str = Field(examples=["model.activate"])
    actor: str = Field(examples=["console (1f0c9a3b)"])
    role: str
    subject: str = Field(examples=["liver/3"])
    outcome: str = Field(examples=["done"])
    request_id: str
    detail: dict[str, str | int | float | bool | None]


class AuditPage(BaseModel):
    """Entries, the newest first, and the digest of the newest of all: note it elsewhere, and nobody can shorten the log unseen."""

    entries: list[EntryView]
    head_seq: int
    head_digest: str
    next_before: int | None = Field(description="Give this as `before` for the next page; null on the last one.")


@router.get("/audit")
@requires("admin")
async def audit_entries(
    request: Request, caller: CallerOf, count: int = Query(100, ge=1, le=500), before: int | None = Query(None, ge=0)
) -> AuditPage:
    """What was done, the newest first. That it was read is an entry, too."""
    log = control_of(request).audit
    async with recorded(request, caller, "audit.read", "audit"):
        entries = await asyncio.to_thread(log.newest, count, before)
    head = log.head
    more = entries[-1].seq if entries and entries[-1].seq > 0 else None
    return AuditPage(
        entries=[EntryView.model_validate(entry) for entry in entries],
        head_seq=head.seq, head_digest=head.digest, next_before=more,
    )  # fmt: skip
