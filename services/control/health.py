"""Readiness: the combined health checks of the control plane and its parts."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Literal

from pydantic import BaseModel

from services.control.parts import CheckResult
from services.control.state import ControlState

CHECK_TIMEOUT_S = 2.0


class CheckView(BaseModel):
    """Result of one health check."""

    ok: bool
    detail: str
    needed: bool


class Readiness(BaseModel):
    """Readiness of the service. `degraded` still counts as ready: a component that is not required,
    such as a camera, has a problem."""

    status: Literal["ready", "degraded", "not ready"]
    checks: dict[str, CheckView] | None = None


async def readiness(control: ControlState, *, verbose: bool) -> Readiness:
    """Run every health check concurrently.

    Args:
        control: state of the application.
        verbose: include the result of each check.
    """
    checks = await _results(control)
    status: Literal["ready", "degraded", "not ready"] = "ready" if all(c.ok for c in checks.values()) else "degraded"
    if any(check.needed and not check.ok for check in checks.values()):
        status = "not ready"
    views = {name: CheckView(ok=c.ok, detail=c.detail, needed=c.needed) for name, c in checks.items()}
    return Readiness(status=status, checks=views if verbose else None)


async def _results(control: ControlState) -> dict[str, CheckResult]:
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
