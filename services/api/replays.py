"""Replay jobs: start, status, cancel, delete; and their results: files, live progress, and the model for the registry."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

import anyio
from fastapi import Header, Path, Query, Response
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, MalformedRangeHeader, RangeNotSatisfiable
from starlette.websockets import WebSocket, WebSocketState

from operators.options import Names
from services.api.display import REFUSED, REFUSED_WHY, ViewerStalled, in_time, until_ended
from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.models import check_soon, registry_of
from services.api.problems import Conflicting, Missing, RangeUnusable, Unavailable, problem_answer
from services.api.state import control_of, part
from services.jobs.results import FILES
from services.jobs.store import JobState
from services.schemas import BatchView, ModelTarget, ReplayRequest, ReplayView, Submitted, VersionView

if TYPE_CHECKING:
    from services.jobs.results import Replays

router = new_router("replays")
JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", examples=["1f0c9a3b5d7e8f20"])]
BatchId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", examples=["8f20c9a35d7e1f0b"])]


def jobs_of(connection: HTTPConnection) -> Replays:
    """Return the replay jobs of this server. Raises NotBuiltIn if the server has none."""
    return part(connection, lambda parts: parts.jobs, "replays")


def view_of(jobs: Replays, job_id: str) -> ReplayView:
    """Return the API record of a replay, with the names of its result files."""
    job = jobs.get(job_id)
    return ReplayView.model_validate(job).model_copy(update={"results": list(jobs.files(job))})


@router.post(
    "/replays",
    status_code=202,
    responses={404: problem_answer("No recording has this name.")},
)
@requires("operator")
async def start_replays(
    request: Request,
    response: Response,
    caller: CallerOf,
    wanted: ReplayRequest,
    idempotency_key: str | None = Header(
        None,
        min_length=1,
        max_length=200,
        description="Idempotency key. A second request with the same key starts no replay and gets the same answer.",
    ),
) -> Submitted:
    """Queue a replay of one recording, or of each recording of a list."""
    jobs = jobs_of(request)
    detail: Mapping[str, Any] = {"recordings": len(wanted.names), "recording": wanted.recording}
    async with recorded(request, caller, "replay.start", wanted.recording or "batch", {**detail}) as said:
        made = await asyncio.to_thread(jobs.submit, wanted.names, wanted.options.chosen(), str(caller), idempotency_key)
        said["batch"], said["new"] = made.batch, made.is_new
    one = made.ids[0] if wanted.recording is not None else None
    response.headers["Location"] = f"/v1/batches/{made.batch}" if one is None else f"/v1/replays/{one}"
    return Submitted(id=one, batch=made.batch, ids=list(made.ids))


@router.get("/replays")
@requires("viewer")
async def replays(
    request: Request,
    count: int = Query(100, ge=1, le=500),
    before: int | None = Query(None, ge=0, le=2**31 - 1, description="List only replays with a smaller number."),
    batch: str | None = Query(None, pattern=r"^[0-9a-f]{16}$", description="List only replays of this batch."),
    state: JobState | None = Query(None, description="List only replays in this state."),
) -> list[ReplayView]:
    """List replays, newest first."""
    jobs = jobs_of(request)

    def found() -> list[ReplayView]:
        records = jobs.newest(count, before=before, batch=batch, state=state)
        return [ReplayView.model_validate(job).model_copy(update={"results": list(jobs.files(job))}) for job in records]

    return await asyncio.to_thread(found)


@router.get("/replays/{job_id}")
@requires("viewer")
async def replay(request: Request, job_id: JobId) -> ReplayView:
    """Return one replay."""
    return await asyncio.to_thread(view_of, jobs_of(request), job_id)


@router.get("/batches/{batch}")
@requires("viewer")
async def batch(request: Request, batch: BatchId) -> BatchView:
    """Return the progress of a batch."""
    states = await asyncio.to_thread(jobs_of(request).counts, batch)
    if not any(states.values()):
        raise Missing("there is no batch with this id; POST /v1/replays answers with the id of one")
    return BatchView(batch=batch, states=dict(states))


@router.post("/replays/{job_id}/cancel")
@requires("operator")
async def cancel_replay(request: Request, caller: CallerOf, job_id: JobId) -> ReplayView:
    """Cancel a replay: a queued one at once, a running one within a second. 409 if it has ended."""
    jobs = jobs_of(request)
    async with recorded(request, caller, "replay.cancel", job_id):
        await asyncio.to_thread(jobs.cancel, job_id, str(caller))
    return await asyncio.to_thread(view_of, jobs, job_id)


@router.delete("/replays/{job_id}", status_code=204)
@requires("admin")
async def delete_replay(request: Request, caller: CallerOf, job_id: JobId) -> None:
    """Delete an ended replay with its results. 409 if it has not ended; cancel it first."""
    jobs = jobs_of(request)
    async with recorded(request, caller, "replay.delete", job_id):
        await asyncio.to_thread(jobs.delete, job_id)


POLL_S = 0.25
NORMAL, GOING_AWAY = 1000, 1001
CLOSE_S = 1.0
REPORT_POLICY = "; ".join(
    [
        "default-src 'none'",
        "img-src data:",
        "style-src 'unsafe-inline'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "sandbox",
    ]
)
"""Content security policy for reports. A report embeds its style and pictures and has no script. It
is sandboxed and may load nothing."""


class ResultAnswer(FileResponse):
    """File of a replay. A Range header that is malformed or in another unit than bytes is ignored, as RFC 9110 asks; one
    beyond the end of the file gets a problem document."""

    @classmethod
    def _parse_range_header(cls, http_range: str, file_size: int) -> list[tuple[int, int]]:
        try:
            return super()._parse_range_header(http_range, file_size)
        except MalformedRangeHeader:
            return []  # the whole file
        except RangeNotSatisfiable as error:
            raise RangeUnusable(
                f"the file has {file_size} bytes, and the Range {http_range!r:.80} selects none of them",
                headers={"Content-Range": f"bytes */{file_size}"},
            ) from error


ResultFile = Annotated[str, Names(FILES)]


@router.get(
    "/replays/{job_id}/results/{file}",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {kind.partition(";")[0]: {} for kind in FILES.values()}},
        206: {"description": "The part of the file that the `Range` header selects."},
        416: problem_answer("The `Range` header selects no byte of the file."),
    },
)
@requires("viewer", ticket=True)
async def replay_result(request: Request, caller: CallerOf, job_id: JobId, file: ResultFile) -> Response:
    """Return a result file of a replay: report, frame log, video or model."""
    path = await asyncio.to_thread(jobs_of(request).file, job_id, file)
    headers = {"Content-Security-Policy": REPORT_POLICY} if file == "report.html" else {}
    shown = file != "model.isplat"
    return ResultAnswer(
        path, media_type=FILES[file], headers=headers, filename=f"{job_id}-{file}",
        content_disposition_type="inline" if shown else "attachment",
    )  # fmt: skip


@router.post("/replays/{job_id}/keep", status_code=201)
@requires("operator")
async def keep_model(
    request: Request, response: Response, caller: CallerOf, job_id: JobId, wanted: ModelTarget
) -> VersionView:
    """Store a replay's model in the registry as the next version of a model. It is checked like an upload."""
    jobs, registry = jobs_of(request), registry_of(request)
    async with recorded(request, caller, "replay.keep", f"{wanted.model}/{job_id}") as said:
        job = await asyncio.to_thread(jobs.get, job_id)
        if job.state != JobState.DONE:
            raise Conflicting(f"the replay is {job.state} and has no model; only one that is done has")
        path = await asyncio.to_thread(jobs.file, job_id, "model.isplat")
        record = await asyncio.to_thread(registry.upload, wanted.model, path, None, str(caller))
        said["version"] = record.version
    check_soon(control_of(request), registry, record)
    response.headers["Location"] = f"/v1/models/{wanted.model}/versions/{record.version}"
    return VersionView.model_validate(record)


@router.websocket("/replays/{job_id}/progress")
@requires("viewer", ticket=True)
async def replay_progress(
    socket: WebSocket, caller: CallerOf, job_id: Annotated[str, Path(pattern=r"^[0-9a-f]{16}$")]
) -> None:
    """Send the replay as JSON on each change, until it has ended."""
    control, jobs = control_of(socket), jobs_of(socket)
    view = await asyncio.to_thread(view_of, jobs, job_id)
    if control.viewers.full:
        raise Unavailable(f"{control.settings.limits.viewers} displays are open, which is as many as may be; close one")
    with control.viewers.one_more(), suppress(ViewerStalled):
        await socket.accept()
        send, ended = in_time(socket.send_text, socket), False
        async with until_ended(socket, _left(socket), caller) as ending:
            said: ReplayView | None = None
            while not ended:
                if view != said:
                    await send(view.model_dump_json())
                    said = view
                ended = view.state not in ("queued", "running")
                if not ended:
                    await asyncio.sleep(POLL_S)
                    view = await asyncio.to_thread(view_of, jobs, job_id)
        if socket.client_state is WebSocketState.CONNECTED and socket.application_state is WebSocketState.CONNECTED:
            with anyio.move_on_after(CLOSE_S):
                if ending.refused:
                    await socket.close(REFUSED, REFUSED_WHY)
                else:
                    await socket.close(NORMAL if ended else GOING_AWAY)


async def _left(socket: WebSocket) -> None:
    """Discard messages from the client until it disconnects."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass
