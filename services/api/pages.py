"""Pages of the server: web console, Swagger UI and the OpenAPI document. No page loads external resources.

The console's files are public; its API requests need a key.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response

from services.api.guard import new_router, requires
from services.api.problems import PROBLEM_JSON, TITLES, Missing
from services.console import FILES, PAGE

SWAGGER_UI = Path(__file__).parent / "swagger"
SWAGGER_FILES = {
    "swagger-ui-bundle.js": "text/javascript",
    "swagger-ui.css": "text/css",
    "page.css": "text/css",
    "start.js": "text/javascript",
    "favicon-32x32.png": "image/png",
    "LICENSE": "text/plain",
    "NOTICE": "text/plain",
}
SWAGGER_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>IntraSplat API</title>
<meta name="viewport" content="width=device-width">
<link rel="icon" href="/docs/favicon-32x32.png">
<link rel="stylesheet" href="/docs/swagger-ui.css">
<link rel="stylesheet" href="/docs/page.css">
</head>
<body>
<div id="api"></div>
<script src="/docs/swagger-ui-bundle.js"></script>
<script src="/docs/start.js"></script>
</body>
</html>
"""
ABOUT = """Research use only, not a medical device. Keys have roles (viewer, operator, admin); `x-role` of an operation says which it needs."""
router = new_router("documents", prefix="")


@router.get("/openapi.json", include_in_schema=False)
@requires("public")
async def openapi_document(request: Request) -> Response:
    """Return the OpenAPI document."""
    return JSONResponse(request.app.openapi())


@router.get("/docs", include_in_schema=False)
@requires("public")
async def swagger_ui() -> Response:
    """Return the Swagger UI page."""
    return HTMLResponse(SWAGGER_PAGE)


@router.get("/docs/{file}", include_in_schema=False)
@requires("public")
async def swagger_ui_file(file: str) -> Response:
    """Return a static file of the Swagger UI page."""
    if file not in SWAGGER_FILES:
        raise Missing("there is no such file of the API's page")
    return FileResponse(
        SWAGGER_UI / file, media_type=SWAGGER_FILES[file], headers={"Cache-Control": "public, max-age=3600"}
    )


PROBLEM_SCHEMA: dict[str, Any] = {
    "title": "Problem",
    "description": "RFC 9457: what happened, the value, what to do.",
    "type": "object",
    "required": ["type", "title", "status"],
    "properties": {
        "type": {"type": "string", "examples": ["urn:intrasplat:problem:not-found"]},
        "title": {"type": "string", "examples": ["Not found"]},
        "status": {"type": "integer", "examples": [404]},
        "detail": {"type": "string", "examples": ["there is no model liver; PUT a version of it first"]},
        "instance": {"type": "string", "examples": ["urn:intrasplat:request:1f0c9a3b5d7e8f20"]},
        "errors": {"type": "array", "items": {"type": "object"}},
    },
}


def _problems_of(path: str, method: str, operation: dict[str, Any]) -> set[int]:
    """Return the problem statuses that an operation may answer with, derived from its shape."""
    found = {400, 413, 421, 429, 431, 500, 503}
    if operation["security"]:
        found |= {401, 403, 422}
    if "parameters" in operation:
        found |= {422}
    if "{" in path:
        found |= {404}
    if "requestBody" in operation:
        found |= {408, 415, 422}
    if method != "get":
        found |= {409}
    if method == "put":
        found |= {507}
    return found


def describe(app: FastAPI) -> None:
    """Add the key scheme and the problem responses to the application's OpenAPI document."""
    framework = app.openapi

    def described() -> dict[str, Any]:
        fresh = app.openapi_schema is None
        document = framework()
        if fresh:
            _add_common(document)
        return document

    app.openapi = partial(described)  # type: ignore[method-assign]


def _add_common(document: dict[str, Any]) -> None:
    components = document.setdefault("components", {})
    components["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer", "description": "An API key."}}
    schemas = components.setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    schemas["Problem"] = PROBLEM_SCHEMA
    content = {PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            responses = operation["responses"]
            responses.pop("422", None)  # FastAPI's own schema; this server answers with a Problem
            for status in sorted(_problems_of(path, method, operation)):
                responses.setdefault(str(status), {"description": TITLES[status], "content": content})


console_router = new_router("console", prefix="")


@console_router.get("/", include_in_schema=False)
@requires("public")
async def console() -> Response:
    """Return the console page."""
    return FileResponse(PAGE / "index.html", media_type="text/html")


@console_router.get("/console/{file}", include_in_schema=False)
@requires("public")
async def console_file(file: str) -> Response:
    """Return a static file of the console."""
    if file not in FILES:
        raise Missing("the console has no such file")
    return FileResponse(PAGE / file, media_type=FILES[file])
