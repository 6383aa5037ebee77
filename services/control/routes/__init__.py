"""API routes, one module per resource."""

from fastapi import APIRouter

from services.control import documents
from services.control.routes import (
    audit,
    config,
    display,
    exports,
    health,
    jobs,
    keys,
    metrics,
    models,
    recordings,
    results,
    snapshots,
    streams,
    tickets,
    uploads,
    version,
    virtual_camera,
)

ROUTERS: tuple[APIRouter, ...] = tuple(
    module.router
    for module in (
        health, version, config, streams, virtual_camera, display, models, uploads, snapshots, exports, jobs, results,
        recordings, keys, tickets, audit, metrics,
        documents,
    )
)  # fmt: skip
