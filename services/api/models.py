"""Models and their versions: upload, list, activate, roll back, delete.

An upload is the request body, its digest a header. A separate process checks it after the answer.
"""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import Path, Query, Response
from starlette.requests import Request

from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.state import ControlState, control_of, is_missing, known_problem, part
from services.api.uploads import incoming_file, stated_sha256
from services.schemas import Activation, ModelView, VersionView
from services.settings import ResourceName

if TYPE_CHECKING:
    from services.registry.models import ModelRegistry
    from services.registry.records import VersionRecord

router = new_router("models")
Number = Annotated[int, Path(ge=1, le=2**31 - 1)]


def registry_of(request: Request) -> ModelRegistry:
    """Return the model registry of this server."""
    return part(request, lambda parts: parts.models, "a registry of models")


@router.get("/models")
@requires("viewer")
async def models(request: Request) -> list[ModelView]:
    """List every model."""
    found = await asyncio.to_thread(registry_of(request).models)
    return [ModelView.model_validate(model) for model in found]


@router.get("/models/{name}/versions")
@requires("viewer")
async def model_versions(request: Request, name: ResourceName) -> list[VersionView]:
    """List every version of a model."""
    found = await asyncio.to_thread(registry_of(request).versions, name)
    return [VersionView.model_validate(version) for version in found]


@router.get("/models/{name}/versions/{number}")
@requires("viewer")
async def model_version(request: Request, name: ResourceName, number: Number) -> VersionView:
    """Return one version."""
    return VersionView.model_validate(await asyncio.to_thread(registry_of(request).version, name, number))


@router.post("/models/{name}/activate")
@requires("operator")
async def activate_model(request: Request, caller: CallerOf, name: ResourceName, wanted: Activation) -> VersionView:
    """Activate a version from the next frame on. 409 if another version than `expected_current` is active."""
    registry = registry_of(request)
    detail = {"expected_current": wanted.expected_current}
    async with recorded(request, caller, "model.activate", f"{name}/{wanted.version}", {**detail}):
        record = await asyncio.to_thread(registry.activate, name, wanted.version, wanted.expected_current, str(caller))
    return VersionView.model_validate(record)


@router.post("/models/{name}/rollback")
@requires("operator")
async def roll_back_model(request: Request, caller: CallerOf, name: ResourceName) -> VersionView:
    """Activate the previous version again."""
    registry = registry_of(request)
    async with recorded(request, caller, "model.rollback", name) as said:
        record = await asyncio.to_thread(registry.rollback, name, str(caller))
        said["version"] = record.version
    return VersionView.model_validate(record)


@router.delete("/models/{name}/versions/{number}", status_code=204)
@requires("admin")
async def delete_model_version(request: Request, caller: CallerOf, name: ResourceName, number: Number) -> None:
    """Delete a version. The active version cannot be deleted."""
    registry = registry_of(request)
    async with recorded(request, caller, "model.delete", f"{name}/{number}"):
        await asyncio.to_thread(registry.delete, name, number, str(caller))


log = logging.getLogger(__name__)
ModelFormat = Literal["isplat", "ply", "splat", "spz"]
FileFormat = Annotated[
    ModelFormat | None,
    Query(description="Format of the file. Default: recognised by its content, except for `splat`, which has no mark."),
]


def recognised(file: FilePath) -> ModelFormat:
    """Return the format of a model file by its first bytes; `isplat` for an unknown one, whose check names it."""
    with open(file, "rb") as opened:
        start = opened.read(4)
    if start[:3] == b"ply":
        return "ply"
    return "spz" if start == b"NGSP" or start[:2] == b"\x1f\x8b" else "isplat"


OCTETS = "application/octet-stream"
DIGEST = "sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:"
DESCRIBED = {
    "parameters": [
        {
            "name": "Content-Digest",
            "in": "header",
            "required": True,
            "description": "`sha-256=:BASE64:` of the file (RFC 9530).",
            "schema": {"type": "string", "examples": [DIGEST]},
        }
    ],
    "requestBody": {
        "required": True,
        "description": "A model packed by `intrasplat pack`, or a `.ply` (also compressed), `.splat` or `.spz` file of another "
        "program; at most limits.model_bytes long.",
        "content": {OCTETS: {"schema": {"type": "string", "format": "binary"}}},
    },
}
"""OpenAPI entry for the request body, which the route reads from the request itself."""


@router.put("/models/{name}/versions", status_code=201, openapi_extra=DESCRIBED)
@requires("operator", takes=OCTETS, most="model_bytes")
async def upload_model(
    request: Request,
    response: Response,
    caller: CallerOf,
    name: ResourceName,
    format: FileFormat = None,
) -> VersionView:
    """Upload a model's next version. It is `uploaded` at first; a check makes it `ready`, or
    `rejected` with a reason. A splat file becomes a static model before the answer."""
    control = control_of(request)
    registry = registry_of(request)
    expected = stated_sha256(", ".join(request.headers.getlist("content-digest")) or None)
    async with recorded(request, caller, "model.upload", name, {"sha256": expected.hex()}) as said:
        async with incoming_file(request, control, expected) as file:
            kind = await asyncio.to_thread(recognised, file.path) if format is None else format
            if kind == "isplat":
                record = await asyncio.to_thread(registry.upload, name, file.path, file.sha256, str(caller))
            else:
                said["format"] = kind
                record = await asyncio.to_thread(registry.upload_splats, name, file.path, kind, str(caller))
        said["version"] = record.version
        said["size_bytes"] = file.size_bytes
    check_soon(control, registry, record)
    response.headers["Location"] = f"/v1/models/{name}/versions/{record.version}"
    return VersionView.model_validate(record)


def check_soon(control: ControlState, registry: ModelRegistry, record: VersionRecord) -> None:
    """Start the check of a new version in the background."""
    checking = asyncio.create_task(_check(control, registry, record.name, record.version))
    control.tasks.add(checking)
    checking.add_done_callback(control.tasks.discard)


async def _check(control: ControlState, registry: ModelRegistry, name: str, version: int) -> None:
    """Check a version and store the result. If the check cannot run, the state is unchanged until the next start."""
    events = control.parts.events
    try:
        record = await asyncio.to_thread(registry.check, name, version)
    except Exception as error:  # background task: no caller receives the error
        kind = known_problem(control, error)
        if kind is not None and await is_missing(control, lambda: registry.version(name, version)):
            log.info("%s/%d was deleted during its check", name, version)
        else:
            log.error("the check of %s/%d failed: %s", name, version, error, exc_info=None if kind else error)
            events.tell("model.check", f"{name}/{version}", "failed")
    else:
        events.tell("model.check", f"{name}/{version}", "refused" if record.state == "rejected" else "done")
        log.info("%s/%d was checked: %s", name, version, record.state)
