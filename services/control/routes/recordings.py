"""Uploaded recordings."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.state import part

router = new_router("recordings")


@router.get("/recordings")
@requires("viewer")
async def recordings(request: Request) -> list[dict[str, Any]]:
    """Every recording."""
    kept = part(request, lambda parts: parts.recordings, "recordings")
    return [dict(recording) for recording in await kept.all()]
