"""Resource budgets of an uploaded recording and its check."""

from __future__ import annotations

from dataclasses import dataclass, fields

GIB = 1 << 30


@dataclass(frozen=True)
class RecordingLimits:
    """Inclusive limits for one recording."""

    unpacked_bytes: int = 64 * GIB
    """Total unpacked size of an archive in bytes."""
    entry_bytes: int = 16 * GIB
    """Unpacked size of one file in bytes."""
    entries: int = 65_000
    """Number of files and folders in an archive."""
    ratio: int = 100
    """Largest compression ratio of a file above one megabyte."""
    check_memory_bytes: int = 4 * GIB
    """Memory of the check beyond its libraries, in bytes."""
    check_s: float = 3600.0
    """Processor time of the check in seconds. Exceeding it rejects the recording."""
    check_passed_s: float = 4 * 3600.0
    """Wall-clock time of the check in seconds. Exceeding it means that the machine is too busy, and
    the recording is not rejected."""
    checks_at_once: int = 1
    """Number of concurrent checks; further checks wait."""

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"RecordingLimits.{field.name} must be positive, got {getattr(self, field.name)!r}")
