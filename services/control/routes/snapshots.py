"""Snapshots of live streams: take, list, delete. `exports.py` serves the files."""

from __future__ import annotations

import asyncio
from datetime import datetime
from typing import Annotated

from fastapi import Path, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.problems import Forbidden
from services.control.recorded import recorded
from services.control.repeated import IdempotencyKey
from services.control.routes.models import VersionView, registry_of
from services.control.routes.streams import streams_of
from services.control.routes.uploads import check_soon
from services.control.snapshot_parts import Snapshots
from services.control.state import control_of, part
from services.settings import ResourceName

router = new_router("snapshots")
SnapshotId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", examples=["1f0c9a3b5d7e8f20"])]


class SnapshotWanted(BaseModel):
    """Use of a snapshot."""

    model_config = ConfigDict(extra="forbid", strict=True)
    model: ResourceName | None = Field(
        None,
        description="Make it the next version of this model; without it, it is kept as a file.",
        examples=["liver"],
    )


class SnapshotView(BaseModel):
    """Model of a stream at one frame."""

    model_config = ConfigDict(from_attributes=True)
    id: str | None = Field(None, examples=["1f0c9a3b5d7e8f20"], description="null: it became a version.")
    stream: str = Field(examples=["theatre-1"])
    taken_at: datetime | str
    taken_by: str
    seq: int = Field(description="Number of the frame.")
    model_version: int = Field(description="As pictures name it.")
    gaussians: int
    time_window_s: list[float] = Field(description="First and last time that the model has.", examples=[[2.0, 5.0]])
    pause_ms: float = Field(description="How long training stood still; the frame's picture was on its way before.")
    size_bytes: int
    digest: str = Field(description="SHA-256 of its manifest, which has that of its tensors.")
    version: VersionView | None = Field(None, description="The model's version that it became.")


def snapshots_of(request: Request) -> Snapshots:
    """Return the snapshot store of this server."""
    return part(request, lambda parts: parts.snapshots, "snapshots")


@router.post("/streams/{name}/snapshots", status_code=201)
@requires("operator", scope="stream")
async def take_snapshot(
    request: Request,
    response: Response,
    caller: CallerOf,
    name: ResourceName,
    wanted: SnapshotWanted,
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
    await streams_of(request).get(name)
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
