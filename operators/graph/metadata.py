"""Merging of the metadata of several messages that one compute receives."""

from __future__ import annotations

from enum import Enum
from typing import Any

from operators.errors import MetadataConflict


class MetadataPolicy(Enum):
    """Treatment of a metadata key that is already present."""

    UPDATE = "update"
    """The last received message wins (default)."""
    REJECT = "reject"
    """The first received message wins."""
    RAISE = "raise"
    """Equal values are accepted and different ones raise MetadataConflict, to detect misaligned
    joins.
    """
    INPLACE_UPDATE = "update"  # noqa: PIE796 - alias of the Holoscan SDK


def merge_metadata(into: dict[str, Any], received: dict[str, Any], policy: MetadataPolicy) -> None:
    """Merge the metadata of a received message.

    Args:
        into: metadata of the current compute, modified.
        received: metadata of the message.
        policy: treatment of keys that are already present.

    Raises:
        MetadataConflict: a key has different values and `policy` is `RAISE`.
    """
    if policy is MetadataPolicy.UPDATE:
        into.update(received)
        return
    for key, value in received.items():
        present = into.setdefault(key, value)
        if policy is MetadataPolicy.RAISE and present is not value and not _same_scalar(present, value):
            raise MetadataConflict(f"metadata {key!r} is {present!r} in one message and {value!r} in another")


def _same_scalar(one: Any, other: Any) -> bool:
    """Compare plain values. Arrays compare by identity, which the caller has already checked."""
    plain = (str, bytes, int, float, bool, tuple)
    return isinstance(one, plain) and isinstance(other, plain) and one == other
