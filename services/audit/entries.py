"""One entry of the audit log, and the digest that chains it to the one before."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

FIRST = 64 * "0"
"""What the first entry has as the digest of the one before."""
MOST_LINE_BYTES = 8192
_DIGEST = re.compile(r"[0-9a-f]{64}")
_PLAIN = re.compile(r"[\w .:@/+*=,;()'?&#%|-]{0,400}", re.ASCII)

Outcome = Literal["done", "refused", "failed"]
Detail = dict[str, str | int | float | bool | None]


@dataclass(frozen=True)
class Entry:
    """What was done. It names a key, never a person, and an object by its name in the service, never a recording's file or a patient."""

    seq: int
    at: str
    """Wall clock, UTC, ISO 8601."""
    event: str
    """`resource.verb`, as in `model.activate`."""
    actor: str
    """Name and id of the API key, `system` for the service itself."""
    role: str
    subject: str
    """What it was done to, as in `liver/3`."""
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
        """The entry with its digest as a line of JSON."""
        values = asdict(self)
        return _canonical(values | {"digest": digest_of(values)}) + b"\n"


def parse_line(line: bytes) -> tuple[Entry, str]:
    """An entry and the digest that its line states; raises ValueError for anything but a line that `Entry.line` wrote."""
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
    """SHA-256 over an entry's values, the digest of the one before among them."""
    return hashlib.sha256(_canonical(values)).hexdigest()


def digest_of_entry(entry: Entry) -> str:
    """The digest that an entry's line should state."""
    return digest_of(asdict(entry))


def _canonical(values: dict[str, Any]) -> bytes:
    return json.dumps(values, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode()
