"""Replays as jobs."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.state import part

router = new_router("replays")


@router.get("/replays")
@requires("viewer")
async def replays(request: Request) -> list[dict[str, Any]]:
    """Every replay."""
    jobs = part(request, lambda parts: parts.jobs, "replays")
    return [dict(job) for job in await jobs.all()]
