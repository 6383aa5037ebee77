"""Network streams: RTSP and other URLs that PyAV can open."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from gsplat_core.scene.frames import Frame
from operators.errors import SourceUnavailable
from operators.sources.backoff import Backoff
from operators.sources.connection import Connection, ConnectionFailed, Place
from operators.sources.options import SourceOptions
from operators.sources.stream import StreamSource
from operators.sources.url_address import UrlAddress

FRESH_S = 1.0
"""Age in seconds at which an idle connection is replaced before reading, because its data are
outdated.
"""


class ConnectedSource(StreamSource):
    """Pictures from a `Place` with automatic reconnection.

    The constructor connects. A connection that breaks, ends or times out is re-established with
    increasing delays. Numbers and timestamps continue.
    """

    def __init__(self, place: Place, name: str, options: SourceOptions) -> None:
        """Connect and describe the source.

        Args:
            place: address and parameters of the stream.
            name: name of the source for the user, without secrets.
            options: source options.

        Raises:
            SourceUnavailable: the stream cannot be opened.
        """
        super().__init__(options)
        self._place = place
        try:
            self._connection: Connection | None = Connection(place)
        except ConnectionFailed as error:
            raise SourceUnavailable(
                f"{name} cannot be opened: {error}. Check the address, and that it is sending."
            ) from None
        self._connected_s = time.monotonic()
        self.describe(name, self._connection.size, self._connection.fps)

    def pictures(self) -> Iterator[Frame]:
        """See `StreamSource`."""
        backoff = Backoff()
        connection, self._connection = self._connection, None
        if connection is not None and not connection.has_an_end and time.monotonic() - self._connected_s > FRESH_S:
            # Data buffered since then would appear as if new.
            connection.close()
            connection = None
        while True:
            try:
                connection = connection or Connection(self._place)
                for frame in connection.pictures():
                    backoff.worked()
                    yield frame
                if connection.has_an_end:
                    return
                why = "the sender has ended it"
            except ConnectionFailed as error:
                why = str(error)
            finally:
                if connection is not None:
                    self.count("before_key_frame", connection.skipped)
                    connection.close()
                    connection = None
            delay_s = backoff.failed()
            self.lost(
                f"the connection to {self.description.name} is lost ({why}); attempt {backoff.failures} to make it again follows in {delay_s:g} s"
            )
            if self.wait(delay_s):
                return

    def close(self) -> None:
        """See `FrameSource`."""
        super().close()
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


def url_source(scheme: str, rest: str, options: SourceOptions) -> ConnectedSource:
    """Open `scheme://rest`, with options of this program after `#`. Raises InvalidSetting and
    SourceUnavailable.
    """
    address = UrlAddress.parse(scheme, rest)
    place = Place(address.url, address.options(), open_s=address.open_s, read_s=address.stall_s)
    return ConnectedSource(place, address.name, replace(options, process=False))


rtsp_source = partial(url_source, "rtsp")
rtsps_source = partial(url_source, "rtsps")
rtp_source = partial(url_source, "rtp")
udp_source = partial(url_source, "udp")
tcp_source = partial(url_source, "tcp")
srt_source = partial(url_source, "srt")
rtmp_source = partial(url_source, "rtmp")
rtmps_source = partial(url_source, "rtmps")
http_source = partial(url_source, "http")
https_source = partial(url_source, "https")
