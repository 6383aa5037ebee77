"""Export of models and snapshots to file formats of other programs."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Callable, Iterator
from typing import Annotated, Literal

from fastapi import Query
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.formats import MOST_TIMES, ExportWish
from services.control.auth.guard import CallerOf, new_router, requires
from services.control.problems import Unprocessable, problem_answer
from services.control.recorded import recorded
from services.control.routes.models import Number
from services.control.routes.snapshots import SnapshotId
from services.control.snapshot_parts import ExportedFile, Exports
from services.control.state import part
from services.exports.cache import ALL
from services.settings import ResourceName

router = new_router("exports")
FormatName = Literal["ply", "splat", "glb", "ply-sequence", "mesh-ply", "mesh-glb", "points-ply", "isplat"]
TimeS = Annotated[
    float | None,
    Query(
        ge=-1e9, le=1e9, description="Which time of the model's window, in seconds; without it the end.", examples=[0.5]
    ),
]
Times = Annotated[
    int | None,
    Query(ge=1, le=MOST_TIMES, description="Of `ply-sequence`: how many times of the window; without it 30."),
]
PIECE_BYTES = 1 << 18
BINARY = {"schema": {"type": "string", "format": "binary"}}
ANSWER: dict[int | str, dict[str, object]] = {
    200: {
        "description": "The file. `ply`, `splat`, `glb` (KHR_gaussian_splatting), `ply-sequence` (a zip archive), the surface as `mesh-ply`, `mesh-glb` or `points-ply`, or `isplat`, which can be uploaded.",
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


@router.get(
    "/models/{name}/versions/{number}/exports/{format}",
    response_class=Response,
    responses={**ANSWER, 409: problem_answer("The version was not checked yet, or was rejected.")},
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


@router.get("/streams/{name}/snapshots/{number}/exports/{format}", response_class=Response, responses=ANSWER)
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


def exports_of(request: Request) -> Exports:
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
    request: Request, caller: CallerOf, event: str, subject: str, wish: ExportWish, make: Callable[[], ExportedFile]
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


def _pieces(made: ExportedFile) -> Iterator[bytes]:
    with made.file as file:
        while piece := file.read(PIECE_BYTES):
            yield piece
