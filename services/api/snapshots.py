"""Snapshots of live streams, and export of snapshots and models to file formats of other programs."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated

from fastapi import Path, Query
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.formats import MOST_TIMES, ExportWish
from operators.options import Names
from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.models import Number, check_soon, registry_of
from services.api.problems import Forbidden, Unprocessable, problem_answer
from services.api.state import IdempotencyKey, control_of, part
from services.api.streams import streams_of
from services.exports.files import ALL, PICTURES
from services.schemas import RenderRequest, SnapshotRequest, SnapshotView, VersionView
from services.settings import ResourceName

if TYPE_CHECKING:
    from services.exports.files import Exported, Wish
    from services.exports.snapshots import ModelExports, StreamSnapshots

router = new_router("snapshots")
SnapshotId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", examples=["1f0c9a3b5d7e8f20"])]


def snapshots_of(request: Request) -> StreamSnapshots:
    """Return the snapshot store of this server."""
    return part(request, lambda parts: parts.snapshots, "snapshots")


@router.post("/streams/{name}/snapshots", status_code=201)
@requires("operator", scope="stream")
async def take_snapshot(
    request: Request,
    response: Response,
    caller: CallerOf,
    name: ResourceName,
    wanted: SnapshotRequest,
    idempotency_key: IdempotencyKey = None,
) -> SnapshotView:
    """Write the live model after the next frame, without delaying pictures. 409 if the stream is
    stopped, just starting, or shows a finished model. The newest 20 snapshots per stream are kept.
    """

    async def take() -> SnapshotView:
        async with recorded(request, caller, "snapshot.take", name, {"model": wanted.model}) as said:
            taken, version = await snapshots_of(request).take(name, wanted.model, str(caller))
            said["id" if version is None else "version"] = taken.id if version is None else version.version
        view = SnapshotView.model_validate(taken)
        if version is not None:
            check_soon(control_of(request), registry_of(request), version)
            view = view.model_copy(update={"id": None, "version": VersionView.model_validate(version)})
        return view

    if wanted.model is not None and caller.streams is not None:
        raise Forbidden(f"the key {caller.name} is limited to streams; keep the snapshot as a file, without `model`")
    streams_of(request).get(name)  # 404 if there is none
    asked = f"snapshot {name} {wanted.model}"
    view: SnapshotView = await control_of(request).repeated.once(caller.key_id, idempotency_key, asked, take)
    where = f"/v1/streams/{name}/snapshots/{view.id}"
    if view.version is not None:
        where = f"/v1/models/{view.version.name}/versions/{view.version.version}"
    response.headers["Location"] = where
    return view


@router.get("/streams/{name}/snapshots")
@requires("viewer", scope="stream")
async def snapshots(request: Request, name: ResourceName) -> list[SnapshotView]:
    """List the stored snapshots of a stream, newest first. They remain after the stream is deleted."""
    found = await asyncio.to_thread(snapshots_of(request).all, name)
    return [SnapshotView.model_validate(each) for each in found]


@router.get("/streams/{name}/snapshots/{number}")
@requires("viewer", scope="stream")
async def snapshot(request: Request, name: ResourceName, number: SnapshotId) -> SnapshotView:
    """Return one snapshot."""
    return SnapshotView.model_validate(await asyncio.to_thread(snapshots_of(request).get, name, number))


@router.delete("/streams/{name}/snapshots/{number}", status_code=204)
@requires("admin", scope="stream")
async def delete_snapshot(request: Request, caller: CallerOf, name: ResourceName, number: SnapshotId) -> None:
    """Delete a snapshot."""
    found = snapshots_of(request)
    async with recorded(request, caller, "snapshot.delete", f"{name}/{number}"):
        await asyncio.to_thread(found.delete, name, number)


exports_router = new_router("exports")
FormatName = Annotated[str, Names(ALL)]
TimeS = Annotated[
    float | None,
    Query(
        ge=-1e9,
        le=1e9,
        description="Time within the model's time window, in seconds. Default: the end of the window.",
        examples=[0.5],
    ),
]
Times = Annotated[
    int | None,
    Query(
        ge=1,
        le=MOST_TIMES,
        description="Number of times in a `ply-sequence`, spread over the model's time window. Default: 30.",
    ),
]
PIECE_BYTES = 1 << 18
BINARY = {"schema": {"type": "string", "format": "binary"}}
ANSWER: dict[int | str, dict[str, object]] = {
    200: {
        "description": "The file: `ply`, `splat`, `glb` (KHR_gaussian_splatting) or `ply-sequence` (a zip archive); the surface "
        "as `mesh-ply`, `mesh-glb` or `points-ply`; or `isplat`, a packed model for upload.",
        "content": {media_type: BINARY for media_type in sorted({each.media_type for each in ALL.values()})},
        "headers": {
            name: {"description": description, "schema": {"type": "string"}}
            for name, description in {
                "Content-Disposition": "The file's name.",
                "Content-Digest": "Its SHA-256 (RFC 9530).",
                "ETag": "The same.",
            }.items()
        },
    }
}


@exports_router.get(
    "/models/{name}/versions/{number}/exports/{format}",
    response_class=Response,
    responses={**ANSWER, 409: problem_answer("The version is not checked yet, or was rejected.")},
)
@requires("operator")
async def export_model(
    request: Request,
    caller: CallerOf,
    name: ResourceName,
    number: Number,
    format: FormatName,
    time_s: TimeS = None,
    times: Times = None,
) -> Response:
    """Export a checked version of a model. A separate process creates the file, and later requests
    use the cached file."""
    exports, wish = exports_of(request), _wish(format, time_s, times)
    subject = f"{name}/{number}"
    return await _answer(request, caller, "model.export", subject, wish, lambda: exports.of_version(name, number, wish))


RENDERED: dict[int | str, dict[str, object]] = {
    200: {
        **ANSWER[200],
        "description": "The picture or video.",
        "content": {each.media_type: BINARY for each in PICTURES.values()},
    }
}


@exports_router.post(
    "/models/{name}/versions/{number}/render",
    response_class=Response,
    responses={**RENDERED, 409: problem_answer("The version is not checked yet, or was rejected.")},
)
@requires("operator")
async def render_model(
    request: Request, caller: CallerOf, name: ResourceName, number: Number, wanted: RenderRequest
) -> Response:
    """Render a checked version of a model. A separate process renders on the CPU, and later requests use the cached
    file."""
    exports, wish = exports_of(request), wanted.wish()
    subject = f"{name}/{number}"
    return await _answer(request, caller, "model.render", subject, wish, lambda: exports.of_version(name, number, wish))


@exports_router.get("/streams/{name}/snapshots/{number}/exports/{format}", response_class=Response, responses=ANSWER)
@requires("operator", scope="stream")
async def export_snapshot(
    request: Request,
    caller: CallerOf,
    name: ResourceName,
    number: SnapshotId,
    format: FormatName,
    time_s: TimeS = None,
    times: Times = None,
) -> Response:
    """Export a snapshot."""
    exports, wish = exports_of(request), _wish(format, time_s, times)
    subject = f"{name}/{number}"
    return await _answer(
        request, caller, "snapshot.export", subject, wish, lambda: exports.of_snapshot(name, number, wish)
    )


def exports_of(request: Request) -> ModelExports:
    """Return the exporter of this server."""
    return part(request, lambda parts: parts.exports, "exports")


def _wish(name: FormatName, time_s: float | None, times: int | None) -> ExportWish:
    try:
        if name == "isplat" and time_s is not None:
            raise InvalidSetting("isplat is the whole model; leave the time out")
        return ExportWish(ALL[name], time_s, times)
    except InvalidSetting as error:
        raise Unprocessable(str(error)) from error


async def _answer(
    request: Request, caller: CallerOf, event: str, subject: str, wish: Wish, make: Callable[[], Exported]
) -> Response:
    async with recorded(request, caller, event, subject, {"format": wish.format.name}) as said:
        made = await asyncio.to_thread(make)
        said["sha256"], said["size_bytes"] = made.sha256, made.size_bytes
    digest = base64.b64encode(bytes.fromhex(made.sha256)).decode()
    headers = {
        "Content-Disposition": f'attachment; filename="{subject.replace("/", "-")}{wish.format.suffix}"',
        "Content-Length": str(made.size_bytes),
        "Content-Digest": f"sha-256=:{digest}:",
        "ETag": f'"{made.sha256}"',
    }
    return StreamingResponse(_pieces(made), media_type=wish.format.media_type, headers=headers)


def _pieces(made: Exported) -> Iterator[bytes]:
    with made.file as file:
        while piece := file.read(PIECE_BYTES):
            yield piece
