"""Streams: create, start, stop, configure, delete, and their virtual camera.

A stream makes this machine open an address, so only sources listed in the settings are accepted.
"""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.requests import Request

from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.problems import Forbidden, Unprocessable
from services.api.state import control_of, part
from services.schemas import StreamOptions, StreamRequest, StreamView, VirtualCamera
from services.settings import ResourceName, SourceRules

if TYPE_CHECKING:
    from services.supervisor.stream import SupervisedStreams

OF_NETWORKS = frozenset(
    {"rtsp", "rtsps", "rtp", "udp", "tcp", "srt", "rtmp", "rtmps", "http", "https", "zmq+tcp"}
)  # fmt: skip
OF_FOLDERS = frozenset({"recording", "realtime", "folder", "pipe", "zmq+ipc"})
OF_DEVICES = frozenset({"v4l2"})
OF_NOTHING = frozenset({"synthetic"})
_ADDRESS = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]+):(?P<slashes>/{0,2})(?P<rest>.*)")
_PRINTABLE = re.compile(r"[\x21-\x7e]+")
_HOST = re.compile(r"([A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\])(:\d{1,5})?")
MOST_LENGTH = 1000
_STEREO = "stereo:"


def check_source(address: str, rules: SourceRules) -> None:
    """Check an address against the source rules. No host name is resolved; unlisted names are refused.

    Raises:
        Unprocessable: if the rules do not allow the address.
    """
    if len(address) > MOST_LENGTH:
        raise Unprocessable(f"the source's address has {len(address)} characters; at most {MOST_LENGTH} are taken")
    if not _PRINTABLE.fullmatch(address) or "\\" in address:
        raise Unprocessable(
            "the source's address is empty, or has spaces, backslashes or letters beyond ASCII; encode them as %20"
        )
    eyes = address.removeprefix(_STEREO).split("|") if address.startswith(_STEREO) else [address]
    for eye in eyes:
        _check_one(eye, rules)


def _check_one(address: str, rules: SourceRules) -> None:
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise Unprocessable("the source has no scheme; give an address such as rtsp://10.0.0.5/stream or synthetic:")
    scheme = match["scheme"]
    if scheme not in rules.schemes:
        raise Unprocessable(
            f"sources with the scheme {scheme} are not allowed here; the settings allow {', '.join(rules.schemes)}"
        )
    place = ("/" if match["slashes"] == "/" else "") + match[
        "rest"
    ]  # as the sources parse it: one slash begins an absolute path
    if scheme in OF_NETWORKS:
        _check_host(address, rules)
    elif scheme in OF_FOLDERS:
        # Some sources treat `?` as the start of options, others as part of the path; both readings must be allowed.
        for path in (place, place.partition("?")[0]):
            _check_path(path, rules.folders, "sources.folders")
    elif scheme in OF_DEVICES:
        _check_path(place.partition("?")[0], rules.devices, "sources.devices")
    elif scheme not in OF_NOTHING:
        raise Unprocessable(
            f"it is not known what a source with the scheme {scheme} opens; name it in the settings' streams"
        )


def _check_host(address: str, rules: SourceRules) -> None:
    try:
        parts = urlsplit(address)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise Unprocessable(f"the source's address cannot be read: {error}") from error
    # URL parsers disagree on user info (first or last @), so an ambiguous authority is refused.
    authority = parts.netloc.rpartition("@")
    if host is None or parts.netloc.count("@") > 1 or not _HOST.fullmatch(authority[2]):
        raise Unprocessable("the source's address has no plain host in it; write scheme://host:port/path")
    if host in rules.hosts:
        return
    try:
        ip = ipaddress.ip_address(host)
    except ValueError:
        raise Unprocessable(
            f"the host {host:.80} is not in sources.hosts of the settings; add it, or give an address of sources.networks"
        ) from None
    ip = getattr(ip, "ipv4_mapped", None) or ip
    if not any(ip in network for network in map(ipaddress.ip_network, rules.networks) if network.version == ip.version):
        raise Unprocessable(f"{ip} is in none of sources.networks of the settings; add its network there")


def _check_path(path: str, allowed: tuple[Path, ...], setting: str) -> None:
    real = Path(path).resolve()
    inside = any(real.is_relative_to(each.resolve()) for each in allowed)
    if not path.startswith("/") or ".." in path or "%" in path or not inside:
        raise Unprocessable(
            f"the source's path is in none of {setting} of the settings; give an absolute path in one of them"
        )


router = new_router("streams")


def streams_of(request: Request) -> SupervisedStreams:
    """Return the stream manager of this server."""
    return part(request, lambda parts: parts.streams, "streams")


@router.get("/streams")
@requires("viewer", scope="any")
async def streams(request: Request, caller: CallerOf) -> list[StreamView]:
    """List the streams that the key may access."""
    return [stream for stream in streams_of(request).all() if caller.may_use(stream.name)]


@router.post("/streams", status_code=201)
@requires("operator", scope="any")
async def create_stream(request: Request, caller: CallerOf, wanted: StreamRequest) -> StreamView:
    """Create a stream. The settings must allow its source (`sources`)."""
    found = streams_of(request)
    if not caller.may_use(wanted.name):
        raise Forbidden(f"the key {caller.name} is limited to other streams; make {wanted.name} with another key")
    if wanted.show != "live" and caller.streams is not None:
        raise Forbidden(
            f"the key {caller.name} is limited to streams and sees no models; show live, or use another key"
        )
    address = _ADDRESS.fullmatch(wanted.source)
    detail = {"scheme": "" if address is None else address["scheme"][:20], "show": wanted.show}
    async with recorded(request, caller, "stream.create", wanted.name, {**detail}):
        check_source(wanted.source, control_of(request).settings.sources)
        view = found.create(wanted.name, wanted)
        if wanted.start:
            view = await found.start(wanted.name)
    return view


@router.get("/streams/{name}")
@requires("viewer", scope="stream")
async def stream(request: Request, name: ResourceName) -> StreamView:
    """Return a stream with its state and processes."""
    return streams_of(request).get(name)


@router.post("/streams/{name}/start")
@requires("operator", scope="stream")
async def start_stream(request: Request, caller: CallerOf, name: ResourceName) -> StreamView:
    """Start a stream. No effect on a running stream."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.start", name):
        return await found.start(name)


@router.post("/streams/{name}/stop")
@requires("operator", scope="stream")
async def stop_stream(request: Request, caller: CallerOf, name: ResourceName) -> StreamView:
    """Stop a stream, including its raw picture."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.stop", name):
        return await found.stop(name)


@router.patch("/streams/{name}/options")
@requires("operator", scope="stream")
async def set_stream_options(
    request: Request, caller: CallerOf, name: ResourceName, wanted: StreamOptions
) -> StreamView:
    """Change options; unnamed options keep their values."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.options", name, {"options": len(wanted.options)}):
        return await found.set_options(name, wanted.options)


@router.delete("/streams/{name}", status_code=204)
@requires("admin", scope="stream")
async def delete_stream(request: Request, caller: CallerOf, name: ResourceName) -> None:
    """Stop and delete a stream."""
    found = streams_of(request)
    async with recorded(request, caller, "stream.delete", name):
        await found.delete(name)


@router.put("/streams/{name}/camera")
@requires("viewer", scope="stream")
async def turn_virtual_camera(request: Request, name: ResourceName, wanted: VirtualCamera) -> VirtualCamera:
    """Set the position of the stream's virtual camera, which all viewers share; the last request wins. Nothing
    else changes, and the audit log has no entry. 409 if the stream is stopped or just starting."""
    return VirtualCamera.model_validate(await streams_of(request).set_camera(name, wanted.model_dump()))
