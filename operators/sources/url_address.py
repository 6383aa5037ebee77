"""Addresses on a network: which are allowed, what FFmpeg may open for them, and how they are named without their secrets."""

from __future__ import annotations

import contextlib
import ipaddress
import re
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from gsplat_core.errors import InvalidSetting
from operators.sources.address import Address

PROTOCOLS = {
    "rtsp": "rtsp,rtp,udp,tcp",
    "rtsps": "rtsps,rtsp,rtp,srtp,udp,tcp,tls,crypto",
    "rtp": "rtp,udp",
    "udp": "udp",
    "tcp": "tcp",
    "srt": "srt,udp",
    "rtmp": "rtmp,tcp",
    "rtmps": "rtmps,rtmp,tls,tcp",
    "http": "http,https,httpproxy,tcp,tls,crypto",
    "https": "https,http,httpproxy,tcp,tls,crypto",
}
"""What FFmpeg may open for an address of each scheme, whatever a server or a playlist names: never a file."""
FORMATS = (
    "rtsp,rtp,sdp,mpegts,flv,live_flv,mov,mp4,matroska,webm,avi,asf,ogg,nut,mpjpeg,mjpeg,h264,hevc,mpeg,mpegvideo,m4v,ivf,"
    "yuv4mpegpipe,hls,jpeg_pipe,png_pipe"
)
"""Demuxers that a stream may turn out to be for; none that reads other files by name, but for HLS, whose parts are bound by `PROTOCOLS`."""
_LABEL = re.compile(r"(?![-])[\w-]{1,63}(?<!-)")
_SECRET = re.compile(r"(?<=://)[^/@\s'\"]*@")


@dataclass(frozen=True)
class UrlAddress:
    """A URL, and options of ours: what stands behind `#`, which is never sent to a server."""

    url: str = field(repr=False)
    scheme: str
    name: str
    """The URL without user, password and query: for people, reports and logs."""
    transport: str = "tcp"
    """Of RTSP: `tcp` or `udp`."""
    open_s: float = 10.0
    """How long a connection may take."""
    stall_s: float = 5.0
    """Without data for so long the connection is lost."""

    @classmethod
    def parse(cls, scheme: str, rest: str) -> UrlAddress:
        """From what follows `scheme://`. Raises InvalidSetting, in words without secrets, for what is no such URL."""
        place, _, fragment = rest.partition("#")
        url = f"{scheme}://{place}"
        ours = Address.parse(scheme, f"?{fragment}")
        if any(character.isspace() or not character.isprintable() for character in url):
            raise InvalidSetting(
                f"a {scheme} address has a blank or a control character in it; write it as %20 and the like"
            )
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise InvalidSetting(f"a {scheme} address is wrong: its host or its port cannot be read") from error
        listens = scheme in ("udp", "rtp")
        if not host and not listens:
            raise InvalidSetting(f"a {scheme} address names no host; give it as {scheme}://host:port/path")
        if host and not _is_host(host):
            raise InvalidSetting(
                f"a {scheme} address names {host!r:.80}, which is no host; give a name or an IP address"
            )
        if port == 0 or (port is None and (listens or scheme in ("tcp", "srt"))):
            what = "names no port" if port is None else "has the port 0"
            raise InvalidSetting(f"a {scheme} address {what}; give one from 1 to 65535, as in {scheme}://host:5000")
        shown = f"[{host}]" if host and ":" in host else host or ""
        name = f"{scheme}://{shown}{'' if port is None else f':{port}'}{parts.path}"
        address = cls(
            url=url,
            scheme=scheme,
            name=name,
            transport=ours.choice("transport", "tcp", ("tcp", "udp")),
            open_s=ours.number("open_s", 10.0, 0.1, 600.0),
            stall_s=ours.number("stall_s", 5.0, 0.1, 600.0),
        )
        ours.refuse_others()
        return address

    def options(self) -> dict[str, str]:
        """FFmpeg's options: nothing is kept back, and nothing but this stream is opened."""
        options = {
            "protocol_whitelist": PROTOCOLS[self.scheme],
            "format_whitelist": FORMATS,
            "analyzeduration": f"{round(0.9 * self.open_s * 1e6)}",  # µs: sizes may come with the next key frame only
            "probesize": "50000000",
            "max_delay": "100000",  # µs; how long RTP packets that are missing are waited for
        }
        if self.scheme in ("rtsp", "rtsps"):
            options["rtsp_transport"] = self.transport
        return options


def _is_host(host: str) -> bool:
    """True for an IP address and for a name that could be one: labels of letters, digits, - and _ with dots between them."""
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host.partition("%")[0])
        return True
    labels = host.removesuffix(".").split(".")
    # What ends in a number is an IPv4 address, and has not been one.
    return len(host) <= 253 and not labels[-1].isdigit() and all(_LABEL.fullmatch(label) for label in labels)


def without_secrets(text: str) -> str:
    """A text in which addresses have neither user nor password."""
    return _SECRET.sub("", text)
