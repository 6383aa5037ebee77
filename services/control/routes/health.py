"""Whether the server lives, and whether it is ready: for orchestrators, without a key."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Literal

from fastapi import Query, Response
from pydantic import BaseModel
from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.parts import CheckResult
from services.control.state import ControlState, control_of

router = new_router("health", prefix="")
CHECK_TIMEOUT_S = 2.0


class Alive(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class CheckView(BaseModel):
    """One thing that was looked at."""

    ok: bool
    detail: str
    needed: bool


class Readiness(BaseModel):
    """`degraded` is ready: something that is not needed for it is not well, a camera for example."""

    status: Literal["ready", "degraded", "not ready"]
    checks: dict[str, CheckView] | None = None


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
    control = control_of(request)
    checks = await _checks(control)
    status: Literal["ready", "degraded", "not ready"] = "ready" if all(c.ok for c in checks.values()) else "degraded"
    if any(check.needed and not check.ok for check in checks.values()):
        status = "not ready"
        response.status_code = 503
    views = {name: CheckView(ok=c.ok, detail=c.detail, needed=c.needed) for name, c in checks.items()}
    return Readiness(status=status, checks=None if verbose is None else views)


async def _checks(control: ControlState) -> dict[str, CheckResult]:
    checks = {"disk": control.storage.disk, "audit": control.storage.audit, **control.parts.checks}
    results = await asyncio.gather(*(_result(check) for check in checks.values()))
    draining = control.draining.is_set()
    return {
        "server": CheckResult(not draining, "ending" if draining else "taking requests"),
        **dict(zip(checks, results, strict=True)),
    }


async def _result(check: Callable[[], Awaitable[CheckResult]]) -> CheckResult:
    try:
        async with asyncio.timeout(CHECK_TIMEOUT_S):
            return await check()
    except TimeoutError:
        return CheckResult(False, f"no answer within {CHECK_TIMEOUT_S:g} s")
