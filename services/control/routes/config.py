"""Settings in force."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.state import control_of
from services.settings import ServiceSettings

router = new_router("service")


@router.get("/config")
@requires("admin")
async def config(request: Request) -> dict[str, Any]:
    """Return the settings of this server, with secrets masked."""
    return control_of(request).settings.shown()


@router.get("/config/schema")
@requires("viewer")
async def config_schema() -> dict[str, Any]:
    """Return the JSON schema of the settings file."""
    return ServiceSettings.model_json_schema()
