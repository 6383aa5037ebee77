"""Network addresses: validation, restrictions for FFmpeg, and names without secrets."""

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
"""Protocols that FFmpeg may open for each scheme. Files are excluded, even if a server or playlist
names one.
"""
FORMATS = (
    "rtsp,rtp,sdp,mpegts,flv,live_flv,mov,mp4,matroska,webm,avi,asf,ogg,nut,mpjpeg,mjpeg,h264,hevc,mpeg,mpegvideo,m4v,ivf,"
    "yuv4mpegpipe,hls,jpeg_pipe,png_pipe"
)
"""Permitted demuxers. None opens other files by name except HLS, whose segments are restricted by
`PROTOCOLS`.
"""
_LABEL = re.compile(r"(?![-])[\w-]{1,63}(?<!-)")
_SECRET = re.compile(r"(?<=://)[^/@\s'\"]*@")


@dataclass(frozen=True)
class UrlAddress:
    """A URL with the options after `#`, which are never sent to a server."""

    url: str = field(repr=False)
    scheme: str
    name: str
    """URL without user, password and query, for messages, reports and logs."""
    transport: str = "tcp"
    """RTSP transport: `tcp` or `udp`."""
    open_s: float = 10.0
    """Connection timeout in seconds."""
    stall_s: float = 5.0
    """Time without data, in seconds, after which the connection counts as lost."""

    @classmethod
    def parse(cls, scheme: str, rest: str) -> UrlAddress:
        """Parse the text after `scheme://`. Raises InvalidSetting, without secrets, for an invalid
        URL.
        """
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
        """Return FFmpeg's options, which minimise buffering and restrict protocols and formats."""
        options = {
            "protocol_whitelist": PROTOCOLS[self.scheme],
            "format_whitelist": FORMATS,
            "analyzeduration": f"{round(0.9 * self.open_s * 1e6)}",  # microseconds; the picture size may arrive only with the next key frame
            "probesize": "50000000",
            "max_delay": "100000",  # microseconds; maximum wait for missing RTP packets
        }
        if self.scheme in ("rtsp", "rtsps"):
            options["rtsp_transport"] = self.transport
        return options


def _is_host(host: str) -> bool:
    """Return True for an IP address or a valid host name: labels of letters, digits, - and _,
    separated by dots.
    """
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host.partition("%")[0])
        return True
    labels = host.removesuffix(".").split(".")
    # A host that ends in a number must be an IPv4 address, which was rejected above.
    return len(host) <= 253 and not labels[-1].isdigit() and all(_LABEL.fullmatch(label) for label in labels)


def without_secrets(text: str) -> str:
    """Return the text with user and password removed from all addresses."""
    return _SECRET.sub("", text)
