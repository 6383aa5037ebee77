"""Model upload: the file is the request body, its digest a header. A separate process checks it
after the answer."""

from __future__ import annotations

import asyncio
import logging

from fastapi import Response
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.digests import stated_sha256
from services.control.incoming import incoming_file
from services.control.parts import Models, VersionRecord
from services.control.recorded import recorded
from services.control.routes.models import VersionView, registry_of
from services.control.state import ControlState, control_of, is_missing, known_problem
from services.settings import ResourceName

log = logging.getLogger(__name__)
router = new_router("models")
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
        "description": "A model packed by `intrasplat pack`, not longer than limits.model_bytes.",
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
) -> VersionView:
    """Upload a model's next version. It is `uploaded` at first; a check makes it `ready`, or
    `rejected` with a reason."""
    control = control_of(request)
    registry = registry_of(request)
    expected = stated_sha256(", ".join(request.headers.getlist("content-digest")) or None)
    async with recorded(request, caller, "model.upload", name, {"sha256": expected.hex()}) as said:
        async with incoming_file(request, control, expected) as file:
            record = await asyncio.to_thread(registry.upload, name, file.path, file.sha256, str(caller))
        said["version"] = record.version
        said["size_bytes"] = file.size_bytes
    check_soon(control, registry, record)
    response.headers["Location"] = f"/v1/models/{name}/versions/{record.version}"
    return VersionView.model_validate(record)


def check_soon(control: ControlState, registry: Models, record: VersionRecord) -> None:
    """Start the check of a new version in the background."""
    checking = asyncio.create_task(_check(control, registry, record.name, record.version))
    control.tasks.add(checking)
    checking.add_done_callback(control.tasks.discard)


async def _check(control: ControlState, registry: Models, name: str, version: int) -> None:
    """Check a version and store the result. If the check cannot run, the state is unchanged until
    the next start."""
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
