"""Metadata travels with messages; this is how the metadata of several messages of one compute come together."""

from __future__ import annotations

from enum import Enum
from typing import Any

from operators.errors import MetadataConflict


class MetadataPolicy(Enum):
    """What happens to a key that is already there."""

    UPDATE = "update"
    """The message received last wins (the default)."""
    REJECT = "reject"
    """The message received first wins."""
    RAISE = "raise"
    """Equal values are fine, different ones are an error: joins stay aligned."""
    INPLACE_UPDATE = "update"  # noqa: PIE796 - Holoscan's other name


def merge_metadata(into: dict[str, Any], received: dict[str, Any], policy: MetadataPolicy) -> None:
    """Merge `received` into `into`. Raises MetadataConflict under RAISE."""
    if policy is MetadataPolicy.UPDATE:
        into.update(received)
        return
    for key, value in received.items():
        present = into.setdefault(key, value)
        if policy is MetadataPolicy.RAISE and present is not value and not _same_scalar(present, value):
            raise MetadataConflict(f"metadata {key!r} is {present!r} in one message and {value!r} in another")


def _same_scalar(one: Any, other: Any) -> bool:
    """Equality of plain values; arrays compare by identity, which the caller has done."""
    plain = (str, bytes, int, float, bool, tuple)
    return isinstance(one, plain) and isinstance(other, plain) and one == other
