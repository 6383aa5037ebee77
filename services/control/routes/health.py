"""Liveness and readiness for orchestrators, without a key."""

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
    """The process answers."""

    status: Literal["alive"] = "alive"


@router.get("/livez")
@requires("public")
async def live() -> Alive:
    """Whether the process answers. Nothing else is looked at: a lost camera is no reason to restart."""
    return Alive()


@router.get("/readyz", response_model_exclude_none=True, responses={503: {"model": Readiness}})
@requires("public")
async def ready(
    request: Request,
    response: Response,
    verbose: str | None = Query(None, max_length=8, description="Given, with or without a value: each check."),
) -> Readiness:
    """Whether requests should come here: 503 while the server drains, or while a part that is needed is not well."""
    found = await readiness(control_of(request), verbose=verbose is not None)
    if found.status == "not ready":
        response.status_code = 503
    return found
