"""Check of listen addresses for servers without keys or encryption."""

from __future__ import annotations

import ipaddress

from gsplat_core.errors import InvalidSetting


def check_host(host: str, plaintext: bool, why: str) -> None:
    """Check that an address is a loopback address, unless `plaintext` is set.

    Args:
        host: address to listen on.
        plaintext: allow other addresses.
        why: explanation for the error message.

    Raises:
        InvalidSetting: if the address is reachable from other machines.
    """
    try:
        here = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        here = False
    if not here and not plaintext:
        raise InvalidSetting(
            f"{host} is beyond this machine: {why}; give --plaintext on a network that is closed to others"
        )
