"""How much an uploaded recording and its check may take."""

from __future__ import annotations

from dataclasses import dataclass, fields

GIB = 1 << 30


@dataclass(frozen=True)
class RecordingLimits:
    """Bounds of one recording. Every bound is included."""

    unpacked_bytes: int = 64 * GIB
    """What all files of an archive hold together."""
    entry_bytes: int = 16 * GIB
    """What one of them holds."""
    entries: int = 65_000
    """Files and folders of an archive."""
    ratio: int = 100
    """So many times as long as it was packed a file of over a megabyte may be."""
    check_memory_bytes: int = 4 * GIB
    """What the check may take beside the libraries that it loads."""
    check_s: float = 3600.0
    """Processor time of the check. More rejects the recording."""
    check_passed_s: float = 4 * 3600.0
    """How long the check may last. More says that the machine is too busy, and nothing about the recording."""
    checks_at_once: int = 1
    """Further checks wait for their turn."""

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"RecordingLimits.{field.name} must be positive, got {getattr(self, field.name)!r}")
