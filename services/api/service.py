"""Routes of the service itself: version, settings in force, and metrics in the Prometheus format."""

from __future__ import annotations

import asyncio
import platform
from typing import Any

import fastapi
from prometheus_client.exposition import choose_encoder
from starlette.requests import Request
from starlette.responses import Response

from services.api.guard import new_router, requires
from services.api.state import control_of
from services.schemas.service import Version
from services.settings import ServiceSettings

router = new_router("service")
FASTAPI = fastapi.__version__


@router.get("/version")
@requires("viewer", scope="any")
async def version(request: Request) -> Version:
    """Return the versions of the server, Python and FastAPI, and the available parts."""
    parts = control_of(request).parts
    here = [name for name in ("streams", "models", "display", "jobs", "recordings") if getattr(parts, name) is not None]
    return Version(version=request.app.version, python=platform.python_version(), fastapi=FASTAPI, parts=here)


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


metrics_router = new_router("health", prefix="")


@metrics_router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
@requires("viewer")
async def metrics(request: Request) -> Response:
    """Return the metrics. Give Prometheus a key with the role viewer (`authorization:
    credentials_file`)."""
    encode, content_type = choose_encoder(request.headers.get("accept", ""))
    body = await asyncio.to_thread(encode, control_of(request).measures.registry)
    return Response(body, headers={"Content-Type": content_type})
