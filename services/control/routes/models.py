"""Models and their versions: list, activate, roll back, delete. Uploads are in `uploads.py`."""

from __future__ import annotations

import asyncio
from datetime import datetime
from typing import Annotated

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.parts import Models
from services.control.recorded import recorded
from services.control.state import part
from services.settings import ResourceName

router = new_router("models")
Number = Annotated[int, Path(ge=1, le=2**31 - 1)]


class VersionView(BaseModel):
    """Model version. `state`: uploaded, validated, ready, active, retired, or rejected with a
    reason."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    version: int = Field(examples=[3])
    state: str = Field(examples=["ready"])
    reason: str | None = None
    digest: str = Field(description="SHA-256 of the uploaded file.")
    size_bytes: int
    uploaded_at: datetime | str
    uploaded_by: str


class ModelView(BaseModel):
    """Model and its active version."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    active: int | None = Field(examples=[3])


class Activation(BaseModel):
    """Version to activate, and the version that the caller expects to be active. A different active
    version refuses the request."""

    model_config = ConfigDict(extra="forbid", strict=True)
    version: int = Field(ge=1, le=2**31 - 1, examples=[3])
    expected_current: int | None = Field(ge=1, le=2**31 - 1, examples=[2], description="null: none is active.")


def registry_of(request: Request) -> Models:
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
    """Activate a version from the next frame on. 409 if another version than `expected_current` is
    active."""
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
