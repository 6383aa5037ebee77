"""Routes of the web console. Its files are public; its API requests need a key."""

from __future__ import annotations

from starlette.responses import FileResponse, Response

from services.console import FILES, PAGE
from services.control.auth.guard import new_router, requires
from services.control.problems import Missing

router = new_router("console", prefix="")


@router.get("/", include_in_schema=False)
@requires("public")
async def console() -> Response:
    """Return the console page."""
    return FileResponse(PAGE / "index.html", media_type="text/html")


@router.get("/console/{file}", include_in_schema=False)
@requires("public")
async def console_file(file: str) -> Response:
    """Return a static file of the console."""
    if file not in FILES:
        raise Missing("the console has no such file")
    return FileResponse(PAGE / file, media_type=FILES[file])
