"""Recordings: upload as request body, list, delete. A separate process checks an upload after the answer."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from fastapi import Header, Response
from starlette.requests import Request

from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.state import ControlState, control_of, is_missing, known_problem, part
from services.api.uploads import incoming_file, stated_sha256
from services.schemas import RecordingView
from services.settings import ResourceName

if TYPE_CHECKING:
    from services.recordings.store import RecordingStore

log = logging.getLogger(__name__)
router = new_router("recordings")
OCTETS = "application/octet-stream"
BODY = {
    "requestBody": {
        "required": True,
        "description": "A video (MP4, AVI, Matroska), or a zip archive of a recording's folder, at most limits.recording_bytes "
        "long.",
        "content": {OCTETS: {"schema": {"type": "string", "format": "binary"}}},
    }
}


def recordings_of(request: Request) -> RecordingStore:
    """Return the recording store of this server."""
    return part(request, lambda parts: parts.recordings, "recordings")


@router.get("/recordings")
@requires("viewer")
async def recordings(request: Request) -> list[RecordingView]:
    """List every recording."""
    found = await asyncio.to_thread(recordings_of(request).all)
    return [RecordingView.model_validate(each) for each in found]


@router.get("/recordings/{name}")
@requires("viewer")
async def recording(request: Request, name: ResourceName) -> RecordingView:
    """Return one recording."""
    return RecordingView.model_validate(await asyncio.to_thread(recordings_of(request).get, name))


@router.put(
    "/recordings/{name}",
    status_code=201,
    openapi_extra=BODY,
    responses={200: {"model": RecordingView, "description": "The same file is already stored under this name."}},
)
@requires("operator", takes=OCTETS, most="recording_bytes")
async def upload_recording(
    request: Request,
    response: Response,
    caller: CallerOf,
    name: ResourceName,
    content_digest: str | None = Header(
        None, max_length=1000, description="`sha-256=:BASE64:` of the file (RFC 9530).",
        examples=["sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:"],
    ),
) -> RecordingView:  # fmt: skip
    """Upload a recording. It is `uploaded` at first; a check makes it `ready`, or `rejected` with a
    reason. 409 if a different recording has this name."""
    control = control_of(request)
    kept = recordings_of(request)
    expected = stated_sha256(content_digest)
    async with recorded(request, caller, "recording.upload", name, {"sha256": expected.hex()}) as said:
        async with incoming_file(request, control, expected) as file:
            record, is_new = await asyncio.to_thread(kept.add, name, file.path, file.sha256, str(caller))
        said["size_bytes"] = file.size_bytes
    if is_new:
        checking = asyncio.create_task(_check(control, kept, name))
        control.tasks.add(checking)
        checking.add_done_callback(control.tasks.discard)
    else:
        response.status_code = 200
    response.headers["Location"] = f"/v1/recordings/{name}"
    return RecordingView.model_validate(record)


@router.delete("/recordings/{name}", status_code=204)
@requires("operator")
async def delete_recording(request: Request, caller: CallerOf, name: ResourceName) -> None:
    """Delete a recording. 409 if a queued or running replay reads it."""
    kept = recordings_of(request)
    async with recorded(request, caller, "recording.delete", name):
        await asyncio.to_thread(kept.delete, name)


async def _check(control: ControlState, kept: RecordingStore, name: str) -> None:
    """Check a recording and store the result. If the check cannot run, the state is unchanged until the next start."""
    try:
        record = await asyncio.to_thread(kept.check, name)
    except Exception as error:  # background task: no caller receives the error
        kind = known_problem(control, error)
        if kind is not None and await is_missing(control, lambda: kept.get(name)):
            log.info("a recording was deleted during its check")
        else:
            log.error("the check of a recording failed: %s", error, exc_info=None if kind else error)
    else:
        log.info("a recording was checked: %s", record.state)
