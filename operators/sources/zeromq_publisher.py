"""Publisher of frames over ZeroMQ, for readers with `zmq+tcp://…` or `zmq+ipc://…`."""

from __future__ import annotations

from types import TracebackType

import zmq
from numpy.typing import NDArray
from zmq.auth.thread import ThreadAuthenticator

from gsplat_core.errors import InvalidSetting
from operators.sources.zeromq_address import connected, keys_from, require_encryption
from operators.sources.zeromq_message import packed


class FramePublisher:
    """Publishes frames at an endpoint to any number of readers. A slow reader loses the oldest
    frames.

        with FramePublisher("tcp://127.0.0.1:5555") as publisher:
            publisher.publish(image, pts_ns=time.time_ns())

    A remote endpoint requires `certificate`, the secret key file of `zmq.auth.create_certificates`.
    `clients` is a folder with the public keys of permitted readers. Without it any reader that has
    the publisher's public key is permitted.
    """

    def __init__(self, endpoint: str, *, certificate: str | None = None, clients: str | None = None) -> None:
        """Bind the endpoint. Raises InvalidSetting for an unusable endpoint or keys.

        Args:
            endpoint: ZeroMQ endpoint.
            certificate: file with the secret key; None for no encryption.
            clients: folder with public keys of permitted readers; None for any reader.
        """
        require_encryption(endpoint, certificate is not None)
        options: dict[int, object] = {zmq.SNDHWM: 2}
        self._authenticator: ThreadAuthenticator | None = None
        if certificate is not None:
            public, secret = keys_from(certificate)
            if secret is None:
                raise InvalidSetting(f"{certificate} has no secret key; give the file that ends in .key_secret")
            options |= {zmq.CURVE_SERVER: 1, zmq.CURVE_PUBLICKEY: public, zmq.CURVE_SECRETKEY: secret}
        self._context, self._socket = connected(zmq.PUB, endpoint, bind=True, options=options)
        if certificate is not None:
            self._authenticator = ThreadAuthenticator(self._context)
            self._authenticator.start()
            self._authenticator.configure_curve(domain="*", location=clients or zmq.auth.CURVE_ALLOW_ANY)
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        """Bound endpoint, with the actual port for `tcp://…:*`."""
        self._seq = 0

    def publish(self, image: NDArray, *, pts_ns: int, seq: int | None = None, **arrays: NDArray | None) -> None:
        """Send one frame.

        Args:
            image: uint8 RGB [H, W, 3].
            pts_ns: timestamp in nanoseconds.
            seq: sequence number; None for the next one.
            arrays: any of `right_image`, `depth`, `mask` and `pose`, as in `Frame`.

        Raises:
            ValueError: shapes do not match, or the picture is too large.
        """
        seq = self._seq if seq is None else seq
        self._seq = seq + 1
        given = {name: array for name, array in arrays.items() if array is not None}
        self._socket.send(packed(seq, pts_ns, {"image": image, **given}))

    def close(self) -> None:
        """Close the socket and stop the authenticator."""
        if self._authenticator is not None:
            self._authenticator.stop()
        self._socket.close()
        self._context.term()

    def __enter__(self) -> FramePublisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
