"""Liveness and readiness for orchestrators; no key required."""

from __future__ import annotations

from typing import Literal

from fastapi import Query, Response
from pydantic import BaseModel
from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.health import Readiness, readiness
from services.control.state import control_of

router = new_router("health", prefix="")


class Alive(BaseModel):
    """Liveness of the process."""

    status: Literal["alive"] = "alive"


@router.get("/livez")
@requires("public")
async def live() -> Alive:
    """Confirm that the process answers. Nothing else is checked: a lost camera does not justify a
    restart."""
    return Alive()


@router.get("/readyz", response_model_exclude_none=True, responses={503: {"model": Readiness}})
@requires("public")
async def ready(
    request: Request,
    response: Response,
    verbose: str | None = Query(None, max_length=8, description="Given, with or without a value: each check."),
) -> Readiness:
    """Report readiness: 503 while the server drains or a required part is unhealthy."""
    found = await readiness(control_of(request), verbose=verbose is not None)
    if found.status == "not ready":
        response.status_code = 503
    return found
