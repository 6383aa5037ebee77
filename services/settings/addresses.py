"""Source addresses without secrets, for display."""

from __future__ import annotations

import re

_CREDENTIALS = re.compile(r"(?<=://)[^/?#|]*@")
_SECRET_OPTION = re.compile(r"(?i)(?<=[?&#])([^=&#|]*(?:pass|secret|token|ticket|key|auth|sig)[^=&#|]*)=[^&#|]*")
MASK = "**********"


def masked_address(address: str) -> str:
    """Return the address with user, password and tokens masked."""
    return _SECRET_OPTION.sub(rf"\1={MASK}", _CREDENTIALS.sub(f"{MASK}@", address))
