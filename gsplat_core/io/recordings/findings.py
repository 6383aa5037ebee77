"""What is wrong with a recording: found once, raised by `open_recording`, listed by `validate_recording`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gsplat_core.errors import RecordingInvalid, RecordingMissing


def printable(name: Path | str) -> str:
    """A name that can be written as UTF-8 whatever its bytes are: those that are no UTF-8 become question marks."""
    return str(name).encode("utf-8", "replace").decode("utf-8")


@dataclass(frozen=True)
class Finding:
    """One thing wrong with one file."""

    file: str
    message: str
    """What is wrong, with the value that was seen."""
    advice: str
    """What to do about it."""
    missing: bool = False
    """The file or folder is not there (RecordingMissing), rather than wrong (RecordingInvalid)."""

    def __str__(self) -> str:
        return f"{self.file}: {self.message}. {self.advice}."


@dataclass
class Findings:
    """Collects what the checks find. A strict one raises at the first problem; the checks themselves do not know."""

    strict: bool = False
    problems: list[Finding] = field(default_factory=list)
    warnings: list[Finding] = field(default_factory=list)

    def problem(self, file: Path | str, message: str, advice: str, *, missing: bool = False) -> None:
        """Note a fault that makes the recording unusable."""
        self._add_problem(Finding(printable(file), printable(message), advice, missing))

    def warn(self, file: Path | str, message: str, advice: str) -> None:
        """Note a stated fallback, or something odd that does not stop the recording from being read."""
        self.warnings.append(Finding(printable(file), printable(message), advice))

    def add(self, others: Findings) -> None:
        """Note what another collector has found, in its order; a strict one raises at the first problem."""
        self.warnings.extend(others.warnings)
        for finding in others.problems:
            self._add_problem(finding)

    def taken(self) -> Findings:
        """What was found since the last call, in a collector of its own; this one is empty then."""
        found = Findings(problems=self.problems, warnings=self.warnings)
        self.problems, self.warnings = [], []
        return found

    def _add_problem(self, finding: Finding) -> None:
        self.problems.append(finding)
        if self.strict:
            raise (RecordingMissing if finding.missing else RecordingInvalid)(str(finding))


@dataclass(frozen=True)
class ValidationReport:
    """What `validate_recording` saw."""

    facts: dict[str, object]
    """JSON-able: frames, size, fps, which sidecars there are, where the calibration comes from, …"""
    problems: list[Finding]
    warnings: list[Finding]

    @property
    def ok(self) -> bool:
        """The recording can be read from the first frame to the last."""
        return not self.problems
