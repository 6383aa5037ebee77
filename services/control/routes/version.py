"""Version of the server."""

from __future__ import annotations

import platform

import fastapi
from pydantic import BaseModel, Field
from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.state import control_of

router = new_router("service")
FASTAPI = fastapi.__version__


class Version(BaseModel):
    """Versions, and the available parts of this server."""

    version: str = Field(examples=["0.1.0"])
    api: str = "v1"
    python: str
    fastapi: str
    parts: list[str] = Field(examples=[["models", "streams"]])


@router.get("/version")
@requires("viewer", scope="any")
async def version(request: Request) -> Version:
    """Return the versions of the server, Python and FastAPI, and the available parts."""
    parts = control_of(request).parts
    here = [name for name in ("streams", "models", "display", "jobs", "recordings") if getattr(parts, name) is not None]
    return Version(version=request.app.version, python=platform.python_version(), fastapi=FASTAPI, parts=here)
