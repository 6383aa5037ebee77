"""Addresses that a command listens on without keys or encryption."""

from __future__ import annotations

import ipaddress

from gsplat_core.errors import InvalidSetting


def check_host(host: str, plaintext: bool, why: str) -> None:
    """Raises InvalidSetting for an address beyond this machine, unless that was asked for; `why` says what is wrong with it."""
    try:
        here = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        here = False
    if not here and not plaintext:
        raise InvalidSetting(
            f"{host} is beyond this machine: {why}; give --plaintext on a network that is closed to others"
        )
