"""Answers to malformed WebSocket handshakes, which uvicorn would leave open."""

from __future__ import annotations

import h11
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import SecurityError

CANNOT_BE_READ = "the WebSocket handshake cannot be read; send a GET request with the headers of RFC 6455 and no body"
TOO_LARGE = "the head of the WebSocket handshake has too many or too long lines; send at most 128 lines of 8192 bytes"


class AnsweredHandshakes(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol, extended to answer every handshake that the parser refuses.

    uvicorn neither answers nor closes such a connection, so it would stay open until the client
    closes it.
    """

    def data_received(self, data: bytes) -> None:
        """Parse received bytes. Answer 431 or 400 if the parser refused the handshake before the
        application saw it."""
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.handshake_initiated and not self.transport.is_closing():
            causes = (self.conn.handshake_exc, self.conn.handshake_exc.__cause__)
            is_long = any(isinstance(each, SecurityError) for each in causes)
            self.transport.write(_refusal(431 if is_long else 400, TOO_LARGE if is_long else CANNOT_BE_READ))
            self.transport.close()


def _refusal(status: int, text: str) -> bytes:
    body = text.encode()
    headers = [
        ("content-type", "text/plain; charset=utf-8"),
        ("connection", "close"),
        ("content-length", str(len(body))),
    ]
    connection = h11.Connection(h11.SERVER)
    events = (h11.Response(status_code=status, headers=headers), h11.Data(data=body), h11.EndOfMessage())
    return b"".join(connection.send(event) or b"" for event in events)
