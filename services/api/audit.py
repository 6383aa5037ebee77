"""Audit log routes: newest entries, search and download."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import Depends, Query
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.state import control_of
from services.audit import ExportFormat, Wanted, exported, search
from services.audit.log import Outcome
from services.schemas import AuditPage, EntryView, Moment

router = new_router("audit")
MEDIA_TYPES = {"csv": "text/csv; charset=utf-8", "jsonl": "application/jsonl"}
Text = Annotated[str, Query(pattern=r"^[A-Za-z0-9_ .:@/+()-]{1,100}$")]
"""Filter text. Restricted to characters of audit values, because the filter itself is recorded in the log."""


def wanted_of(
    event: Annotated[
        Text | None,
        Query(description="Event, such as `model.activate`, or a prefix such as `model` for all events of models."),
    ] = None,
    actor: Annotated[
        Text | None, Query(description="Text contained in the actor, which is the name and id of a key.")
    ] = None,
    subject: Annotated[Text | None, Query(description="Text contained in the subject.")] = None,
    outcome: Annotated[Outcome | None, Query()] = None,
    since: Annotated[Moment | None, Query(description="Start time (inclusive), with a time zone.")] = None,
    until: Annotated[Moment | None, Query(description="End time (exclusive), with a time zone.")] = None,
) -> Wanted:
    """Build the filter of audit entries from the query parameters."""
    return Wanted(event, actor, subject, outcome, since, until)


WantedOf = Annotated[Wanted, Depends(wanted_of)]


@router.get("/audit")
@requires("admin")
async def audit_entries(
    request: Request,
    caller: CallerOf,
    wanted: WantedOf,
    count: int = Query(100, ge=1, le=500),
    before: int | None = Query(None, ge=0, le=2**63 - 1),
) -> AuditPage:
    """List audit entries, newest first. Reading is recorded too, at most once a minute per key and
    filter, so that a page that polls the log does not fill it."""
    control = control_of(request)
    log = control.audit
    async with AsyncExitStack() as entry:
        if control.audit_reads.wait_s(f"{caller.key_id} {_said(wanted)}") == 0:
            await entry.enter_async_context(recorded(request, caller, "audit.read", "audit", _said(wanted)))
        page = await asyncio.to_thread(search, log.path, wanted, count, before)
    head = log.head
    return AuditPage(
        entries=[EntryView.model_validate(entry) for entry in page.entries],
        head_seq=head.seq, head_digest=head.digest, next_before=page.before,
    )  # fmt: skip


@router.get(
    "/audit/export",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {kind.partition(";")[0]: {} for kind in MEDIA_TYPES.values()}}
    },
)
@requires("admin")
async def export_audit(
    request: Request,
    caller: CallerOf,
    wanted: WantedOf,
    format: Annotated[
        ExportFormat, Query(description="`jsonl`: the original lines with their digests. `csv`: a table.")
    ] = "jsonl",
) -> Response:
    """Download the log or the filtered entries, oldest first. The download is recorded in the log."""
    log = control_of(request).audit
    async with recorded(request, caller, "audit.export", "audit", {"format": format, **_said(wanted)}):
        made = exported(log.path, wanted, format)
    name = f"audit-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.{format}"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return StreamingResponse(made, media_type=MEDIA_TYPES[format], headers=headers)


def _said(wanted: Wanted) -> dict[str, Any]:
    """Return a filter's values as the detail of the audit entry that records the search."""
    times = {name: time.isoformat() for name in ("since", "until") if (time := getattr(wanted, name)) is not None}
    names = ("event", "actor", "subject", "outcome")
    return {name: value for name in names if (value := getattr(wanted, name)) is not None} | times
