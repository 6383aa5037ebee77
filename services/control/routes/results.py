"""Results of a replay: files, live progress, and its model for the registry."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Annotated, Literal

import anyio
from fastapi import Path, Response
from pydantic import BaseModel, ConfigDict
from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.websockets import WebSocket, WebSocketState

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.problems import Conflicting, Unavailable
from services.control.recorded import recorded
from services.control.routes.jobs import JobId, ReplayView, jobs_of, view_of
from services.control.routes.models import VersionView, registry_of
from services.control.routes.uploads import check_soon
from services.control.state import control_of
from services.control.viewers import REFUSED, REFUSED_WHY, ViewerStalled, in_time, until_ended
from services.jobs.results import FILES
from services.settings import ResourceName

router = new_router("replays")
LOOK_S = 0.25
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
ResultFile = Literal["report.html", "report.json", "frames.jsonl", "reconstruction.mp4", "model.isplat"]


@router.get(
    "/replays/{job_id}/results/{file}",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {kind.partition(";")[0]: {} for kind in FILES.values()}},
        206: {"description": "The part of it that `Range` asked for."},
    },
)
@requires("viewer", ticket=True)
async def replay_result(request: Request, caller: CallerOf, job_id: JobId, file: ResultFile) -> Response:
    """Return a result file of a replay: report, video or model."""
    path = await asyncio.to_thread(jobs_of(request).file, job_id, file)
    headers = {"Content-Security-Policy": REPORT_POLICY} if file == "report.html" else {}
    shown = file != "model.isplat"
    return FileResponse(
        path, media_type=FILES[file], headers=headers, filename=f"{job_id}-{file}",
        content_disposition_type="inline" if shown else "attachment",
    )  # fmt: skip


class Kept(BaseModel):
    """Target model for a replay's model."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"model": "liver"}]})
    model: ResourceName


@router.post("/replays/{job_id}/keep", status_code=201)
@requires("operator")
async def keep_model(
    request: Request, response: Response, caller: CallerOf, job_id: JobId, wanted: Kept
) -> VersionView:
    """Store a replay's model in the registry as the next version of a model. It is checked like an
    upload."""
    jobs, registry = jobs_of(request), registry_of(request)
    async with recorded(request, caller, "replay.keep", f"{wanted.model}/{job_id}") as said:
        job = await asyncio.to_thread(jobs.get, job_id)
        if "model.isplat" not in jobs.files(job):
            raise Conflicting(f"the replay is {job.state} and has no model; wait until it is done")
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
                    await asyncio.sleep(LOOK_S)
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
