"""Audit entries and the digests that chain them."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

FIRST = 64 * "0"
"""Predecessor digest of the first entry."""
MOST_LINE_BYTES = 8192
_DIGEST = re.compile(r"[0-9a-f]{64}")
_PLAIN = re.compile(r"[\w .:@/+*=,;()'?&#%|-]{0,400}", re.ASCII)

Outcome = Literal["done", "refused", "failed"]
Detail = dict[str, str | int | float | bool | None]


@dataclass(frozen=True)
class Entry:
    """Audit entry. It names keys and objects of the service, never persons, file names or patients."""

    seq: int
    at: str
    """Wall-clock time, UTC, ISO 8601."""
    event: str
    """Event as `resource.verb`, such as `model.activate`."""
    actor: str
    """Name and id of the API key, or `system` for the service itself."""
    role: str
    subject: str
    """Affected object, such as `liver/3`."""
    outcome: Outcome
    request_id: str = ""
    detail: Detail = field(default_factory=dict)
    previous: str = FIRST

    def __post_init__(self) -> None:
        for name in ("event", "actor", "role", "subject", "request_id", "at"):
            if not _PLAIN.fullmatch(getattr(self, name)):
                raise ValueError(f"audit: {name} is not a short plain text")
        for key, value in self.detail.items():
            if not _PLAIN.fullmatch(key) or not _PLAIN.fullmatch(str(value)):
                raise ValueError(f"audit: the detail {key:.40} is not a short plain value")

    def line(self) -> bytes:
        """Return the entry with its digest as a JSON line."""
        values = asdict(self)
        return _canonical(values | {"digest": digest_of(values)}) + b"\n"


def parse_line(line: bytes) -> tuple[Entry, str]:
    """Parse a line of `Entry.line`.

    Returns:
        The entry and the stated digest.

    Raises:
        ValueError: if the line has another format.
    """
    try:
        values = json.loads(line)
    except RecursionError as error:
        raise ValueError("it nests values too deep") from error
    if not isinstance(values, dict) or not _DIGEST.fullmatch(str(values.get("digest"))):
        raise ValueError("it has no digest")
    digest = values.pop("digest")
    seq, detail = values.get("seq"), values.get("detail")
    if not isinstance(seq, int) or isinstance(seq, bool) or not 0 <= seq < 1 << 63 or not isinstance(detail, dict):
        raise ValueError("its number or its detail is not that of an entry")
    try:
        entry = Entry(**values)
    except TypeError as error:
        raise ValueError("its keys are not those of an entry") from error
    if entry.line() != line.rstrip(b"\n") + b"\n" and digest == digest_of(values):
        raise ValueError("it is not written as an entry is")
    return entry, digest


def digest_of(values: dict[str, Any]) -> str:
    """Return the SHA-256 of an entry's values, including the predecessor's digest."""
    return hashlib.sha256(_canonical(values)).hexdigest()


def digest_of_entry(entry: Entry) -> str:
    """Return the correct digest of an entry."""
    return digest_of(asdict(entry))


def _canonical(values: dict[str, Any]) -> bytes:
    return json.dumps(values, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode()
