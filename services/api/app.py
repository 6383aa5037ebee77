"""Application factory: routes, access guards and limits for the components of a server."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, FastAPI
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from services import product_version
from services.api import audit as audit_routes
from services.api import display, models, pages, recordings, replays, service, snapshots, streams
from services.api import keys as key_routes
from services.api.guard import AddressRate, HeadLength, KnownHosts, SecurityHeaders, operation_id
from services.api.observability import Measures, Observed
from services.api.pages import ABOUT, describe
from services.api.problems import answer_with_problems
from services.api.state import ControlState, Parts, Storage, TokenBuckets, ViewerCount, folders_of
from services.audit import AuditLog, AuditUnwritable, Keeping
from services.auth.keys import KeyStore, Tickets, changed_outside, first_admin_key, keys_read_again
from services.settings import ServiceSettings, SettingsInvalid

if TYPE_CHECKING:
    from services.auth.oidc import OpenIdPersons

log = logging.getLogger(__name__)
ROUTERS: tuple[APIRouter, ...] = (
    service.router, service.service_router, streams.router, display.router, models.router, snapshots.router, snapshots.exports_router, replays.router,
    recordings.router, key_routes.router, audit_routes.router, pages.router,
)  # fmt: skip
KEYS_FILE = "keys.json"
AUDIT_FILE = "audit.jsonl"


def new_app(settings: ServiceSettings, parts: Parts | None = None) -> FastAPI:
    """Build the control plane as an ASGI application.

    Creates `settings.data_dir` and its stores. On the first start, writes the administrator's key
    to `settings.admin_key_file`.

    Raises:
        AuditError: if another server uses the same data folder.
        SettingsInvalid: if `auth.oidc` is set and PyJWT is not installed.
    """
    parts = parts or Parts()
    control = _new_state(settings, parts)
    app = FastAPI(
        title="IntraSplat",
        version=product_version(),
        summary="Live, deforming 3D reconstruction from endoscopic video.",
        description=ABOUT,
        openapi_url=None, docs_url=None, redoc_url=None,  # `pages.py` serves them, without external resources
        redirect_slashes=False,
        generate_unique_id_function=operation_id,
        lifespan=_lifespan,
    )  # fmt: skip
    app.state.control = control
    for router in ROUTERS:
        app.router.routes += router.routes  # `include_router` would build each of them again at the first request
    for router in parts.routers:
        app.include_router(router)
    answer_with_problems(app, parts.errors)
    describe(app)
    limits = settings.limits
    by_address = TokenBuckets(limits.address_requests_per_s, limits.address_requests_per_s * limits.burst_s)
    # Each middleware wraps the ones added before it.
    app.add_middleware(KnownHosts, server=settings.server, measures=control.measures)
    app.add_middleware(AddressRate, buckets=by_address, measures=control.measures)
    app.add_middleware(HeadLength, measures=control.measures)
    app.add_middleware(Observed, measures=control.measures)
    app.add_middleware(SecurityHeaders)
    if settings.server.trusted_proxies:
        app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=list(settings.server.trusted_proxies))
    return app


def _new_state(settings: ServiceSettings, parts: Parts) -> ControlState:
    persons = _persons(settings)
    data = settings.data_dir
    uploads = data / "uploads"
    for folder in (data, uploads):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    keep = settings.audit
    # The audit log is opened before the stores, because its lock excludes other servers from these folders.
    audit = AuditLog(
        data / AUDIT_FILE, Keeping(keep.segment_bytes, keep.keep_segments, keep.keep_days, parts.trusts_ages)
    )
    _remove_unfinished(uploads)
    keys = KeyStore(data / KEYS_FILE)
    made = first_admin_key(keys, settings.admin_key_file)
    if made:
        audit.append("key.create", actor="system", subject="admin", detail={"role": "admin", "first": True})
        log.warning("the administrator's key was made: it is in %s", settings.admin_key_file)
    keys.watch(partial(changed_outside, audit))
    limits = settings.limits
    storage = Storage(folders_of(settings), audit)
    return ControlState(
        settings=settings,
        parts=parts,
        keys=keys,
        tickets=Tickets(settings.auth.ticket_s),
        audit=audit,
        measures=Measures([*parts.collectors, storage], lambda: audit.head.seq + 1),
        key_rate=TokenBuckets(limits.requests_per_s, limits.requests_per_s * limits.burst_s),
        uploads_dir=uploads,
        uploads=asyncio.Semaphore(limits.uploads),
        viewers=ViewerCount(limits.viewers),
        storage=storage,
        persons=persons,
    )


def _persons(settings: ServiceSettings) -> OpenIdPersons | None:
    if settings.auth.oidc is None:
        return None
    try:
        from services.auth.oidc import OpenIdPersons
    except ModuleNotFoundError as error:
        raise SettingsInvalid("auth.oidc needs PyJWT; install intrasplat with the extra oidc") from error
    return OpenIdPersons(settings.auth.oidc)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    control: ControlState = app.state.control
    async with AsyncExitStack() as running:
        await running.enter_async_context(control.parts.events.written_to(control.audit))
        await running.enter_async_context(keys_read_again(control.keys))
        for enter in control.parts.background:
            await running.enter_async_context(enter())
        audit = control.audit
        await asyncio.to_thread(audit.append, "service.start", actor="system", detail={"version": product_version()})
        try:
            yield
        finally:
            control.draining.set()
            if control.tasks:
                await asyncio.wait(control.tasks, timeout=control.settings.server.drain_s)
            try:
                await asyncio.to_thread(audit.append, "service.stop", actor="system")
            except AuditUnwritable as error:
                log.error("the end of the service is not in the audit log: %s", error)
    control.audit.close()


def _remove_unfinished(uploads: Path) -> None:
    """Delete partial uploads of a killed server."""
    for name in os.listdir(uploads):
        if name.startswith("upload-"):
            (uploads / name).unlink()
