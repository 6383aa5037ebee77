"""ZeroMQ endpoints. Connections to other machines must be encrypted (CURVE)."""

from __future__ import annotations

import ipaddress
import os
from typing import Any

import zmq
import zmq.auth

from gsplat_core.errors import InvalidSetting


def is_of_this_machine(endpoint: str) -> bool:
    """Return True if the endpoint is on this machine."""
    scheme, _, place = endpoint.partition("://")
    if scheme == "ipc":
        return True
    host = place.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def require_encryption(endpoint: str, encrypted: bool) -> None:
    """Raise InvalidSetting for an unencrypted endpoint on another machine."""
    if not encrypted and not is_of_this_machine(endpoint):
        raise InvalidSetting(
            f"{endpoint} leads to another machine, and patients' pictures do not go over a network in the clear; give keys "
            "(docs/sources.md, ZeroMQ), or stay on 127.0.0.1"
        )


def keys_from(path: str) -> tuple[bytes, bytes | None]:
    """Return public and secret key of a certificate file of `zmq.auth.create_certificates`. Raises
    InvalidSetting.
    """
    try:
        return zmq.auth.load_certificate(os.fspath(path))
    except (OSError, ValueError) as error:
        raise InvalidSetting(f"{path} is no certificate of ZeroMQ: {error}") from None


def connected(kind: int, endpoint: str, *, bind: bool, options: dict[int, Any]) -> tuple[zmq.Context, zmq.Socket]:
    """Create a socket in a new context and bind or connect it.

    Args:
        kind: ZeroMQ's socket type.
        endpoint: ZeroMQ endpoint.
        bind: bind the socket; otherwise connect it.
        options: socket options.

    Raises:
        InvalidSetting: the endpoint or an option is invalid.
    """
    context = zmq.Context()
    socket = context.socket(kind)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        for option, value in options.items():
            socket.setsockopt(option, value)
        if bind:
            socket.bind(endpoint)
        else:
            socket.connect(endpoint)
    except (zmq.ZMQError, ValueError) as error:
        socket.close()
        context.term()
        raise InvalidSetting(f"{endpoint} cannot be used: {error}") from None
    return context, socket
