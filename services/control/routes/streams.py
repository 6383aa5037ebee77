"""Streams: create, start, stop, configure, delete."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator
from starlette.requests import Request

from operators.settings import stream_options_schema
from services.control.auth.guard import CallerOf, new_router, requires
from services.control.parts import NewStream, Streams, StreamState
from services.control.problems import Forbidden
from services.control.recorded import recorded
from services.control.sources import check_source
from services.control.state import control_of, part
from services.settings import ResourceName, StreamSettings
from services.settings.sections import masked_address

router = new_router("streams")
MOST_OPTIONS = 50
Option = str | int | FiniteFloat | bool | None


class StreamOptions(BaseModel):
    """Source and reconstruction options by name; null restores the default."""

    model_config = ConfigDict(extra="forbid", strict=True)
    options: dict[str, Option] = Field(
        max_length=MOST_OPTIONS, examples=[{"tool_mask": "builtin"}], json_schema_extra=stream_options_schema()
    )


class StreamWanted(StreamSettings):
    """New stream."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: ResourceName
    start: bool = Field(True, description="Start it at once.")
    options: dict[str, Any] = Field({}, max_length=MOST_OPTIONS, json_schema_extra=stream_options_schema())

    @field_validator("options")
    @classmethod
    def _plain(cls, options: dict[str, Any]) -> dict[str, Any]:
        return StreamOptions(options=options).options


class StreamView(BaseModel):
    """Stream. `state`: stopped, starting, live, stale, frozen, source lost or failed; `reason`
    explains it."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["endoscope"])
    source: str = Field(examples=["rtsp://10.0.0.5/stream"])
    show: str = Field(examples=["live"])
    device: str = Field(examples=["cuda:0"])
    options: dict[str, Any]
    state: str = Field(examples=["live"])
    reason: str | None = None
    processes: dict[str, dict[str, Any]] = Field(
        {},
        description="Capture and engine: `state`, `reason`, `pid`, `restarts`, `rate_hz` (frames captured, pictures shown a second), `heard_s` since the"
        " last heartbeat, and its `figures`. Those of the engine have the newest `picture` with its `age_ms` and its `psnr_db`: the training error"
        " of the frame that is displayed, not of one that was held out.",
    )
    viewers: dict[str, int] = Field({}, description="Open displays, by picture.", examples=[{"raw": 1, "shown": 2}])

    @field_validator("source")
    @classmethod
    def _without_credentials(cls, source: str) -> str:
        return masked_address(source)

    @field_validator("options", "processes", "viewers", mode="before")
    @classmethod
    def _as_dict(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        return dict(values)


def streams_of(request: Request) -> Streams:
    """Return the stream manager of this server."""
    return part(request, lambda parts: parts.streams, "streams")


@router.get("/streams")
@requires("viewer", scope="any")
async def streams(request: Request, caller: CallerOf) -> list[StreamView]:
    """List the streams that the key may access."""
    return [_view(stream) for stream in await streams_of(request).all() if caller.may_use(stream.name)]


@router.post("/streams", status_code=201)
@requires("operator", scope="any")
async def create_stream(request: Request, caller: CallerOf, wanted: StreamWanted) -> StreamView:
    """Create a stream. The settings must allow its source (`sources`)."""
    found = streams_of(request)
    if not caller.may_use(wanted.name):
        raise Forbidden(f"the key {caller.name} is limited to other streams; make {wanted.name} with another key")
    detail = {"scheme": wanted.source.partition(":")[0][:20] if wanted.source.isascii() else "", "show": wanted.show}
    async with recorded(request, caller, "stream.create", wanted.name, {**detail}):
        check_source(wanted.source, control_of(request).settings.sources)
        new = NewStream(wanted.name, wanted.source, wanted.show, wanted.device, wanted.options)
        state = await found.create(new)
        if wanted.start:
            state = await found.start(wanted.name)
    return _view(state)


@router.get("/streams/{name}")
@requires("viewer", scope="stream")
async def stream(request: Request, name: ResourceName) -> StreamView:
    """Return a stream with its state and processes."""
    return _view(await streams_of(request).get(name))


@router.post("/streams/{name}/start")
@requires("operator", scope="stream")
async def start_stream(request: Request, caller: CallerOf, name: ResourceName) -> StreamView:
    """Start a stream. No effect on a running stream."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.start", name):
        return _view(await found.start(name))


@router.post("/streams/{name}/stop")
@requires("operator", scope="stream")
async def stop_stream(request: Request, caller: CallerOf, name: ResourceName) -> StreamView:
    """Stop a stream, including its raw picture."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.stop", name):
        return _view(await found.stop(name))


@router.patch("/streams/{name}/options")
@requires("operator", scope="stream")
async def set_stream_options(
    request: Request, caller: CallerOf, name: ResourceName, wanted: StreamOptions
) -> StreamView:
    """Change options; unnamed options keep their values."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.options", name, {"options": len(wanted.options)}):
        return _view(await found.set_options(name, wanted.options))


@router.delete("/streams/{name}", status_code=204)
@requires("admin", scope="stream")
async def delete_stream(request: Request, caller: CallerOf, name: ResourceName) -> None:
    """Stop and delete a stream."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.delete", name):
        await found.delete(name)


def _view(state: StreamState) -> StreamView:
    return StreamView.model_validate(state)
