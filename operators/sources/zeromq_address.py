"""Endpoints of ZeroMQ: on this machine in the clear, beyond it only encrypted (CURVE)."""

from __future__ import annotations

import ipaddress
import os
from typing import Any

import zmq
import zmq.auth

from gsplat_core.errors import InvalidSetting


def is_of_this_machine(endpoint: str) -> bool:
    """Whether what goes to an endpoint stays on this machine."""
    scheme, _, place = endpoint.partition("://")
    if scheme == "ipc":
        return True
    host = place.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def require_encryption(endpoint: str, encrypted: bool) -> None:
    """Raises InvalidSetting for an endpoint beyond this machine without keys."""
    if not encrypted and not is_of_this_machine(endpoint):
        raise InvalidSetting(
            f"{endpoint} leads to another machine, and patients' pictures do not go over a network in the clear; give keys "
            "(docs/sources.md, ZeroMQ), or stay on 127.0.0.1"
        )


def keys_from(path: str) -> tuple[bytes, bytes | None]:
    """Public and secret key of a certificate file, as `zmq.auth.create_certificates` writes it. Raises InvalidSetting."""
    try:
        return zmq.auth.load_certificate(os.fspath(path))
    except (OSError, ValueError) as error:
        raise InvalidSetting(f"{path} is no certificate of ZeroMQ: {error}") from None


def connected(kind: int, endpoint: str, *, bind: bool, options: dict[int, Any]) -> tuple[zmq.Context, zmq.Socket]:
    """A socket in a context of its own. Raises InvalidSetting for an endpoint that cannot be used."""
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
