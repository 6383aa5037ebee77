"""Metrics in the Prometheus format."""

from __future__ import annotations

import asyncio

from prometheus_client.exposition import choose_encoder
from starlette.requests import Request
from starlette.responses import Response

from services.control.auth.guard import new_router, requires
from services.control.state import control_of

router = new_router("health", prefix="")


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
@requires("viewer")
async def metrics(request: Request) -> Response:
    """Return the metrics. Give Prometheus a key with the role viewer (`authorization:
    credentials_file`)."""
    encode, content_type = choose_encoder(request.headers.get("accept", ""))
    body = await asyncio.to_thread(encode, control_of(request).measures.registry)
    return Response(body, headers={"Content-Type": content_type})
