"""Problems found in a recording, raised by `open_recording` or listed by `validate_recording`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gsplat_core.errors import RecordingInvalid, RecordingMissing


def printable(name: Path | str) -> str:
    """Return a name encodable as UTF-8; undecodable bytes become question marks."""
    return str(name).encode("utf-8", "replace").decode("utf-8")


@dataclass(frozen=True)
class Finding:
    """Problem or warning about one file."""

    file: str
    message: str
    """Description of the defect with the observed value."""
    advice: str
    """Remedy for the defect, addressed to the user."""
    missing: bool = False
    """True if the file does not exist (RecordingMissing), False if it is wrong (RecordingInvalid)."""

    def __str__(self) -> str:
        return f"{self.file}: {self.message}. {self.advice}."


@dataclass
class Findings:
    """Collector of problems and warnings; with `strict`, the first problem is raised.

    Checks are written independently of `strict`.
    """

    strict: bool = False
    problems: list[Finding] = field(default_factory=list)
    warnings: list[Finding] = field(default_factory=list)

    def problem(self, file: Path | str, message: str, advice: str, *, missing: bool = False) -> None:
        """Record a defect that makes the recording unusable."""
        self._add_problem(Finding(printable(file), printable(message), advice, missing))

    def warn(self, file: Path | str, message: str, advice: str) -> None:
        """Record a fallback or an oddity that does not prevent reading."""
        self.warnings.append(Finding(printable(file), printable(message), advice))

    def add(self, others: Findings) -> None:
        """Append the findings of another collector in order; a strict collector raises the first problem."""
        self.warnings.extend(others.warnings)
        for finding in others.problems:
            self._add_problem(finding)

    def taken(self) -> Findings:
        """Move all findings into a new collector, leaving this one empty."""
        found = Findings(problems=self.problems, warnings=self.warnings)
        self.problems, self.warnings = [], []
        return found

    def _add_problem(self, finding: Finding) -> None:
        self.problems.append(finding)
        if self.strict:
            raise (RecordingMissing if finding.missing else RecordingInvalid)(str(finding))


@dataclass(frozen=True)
class ValidationReport:
    """Result of `validate_recording`."""

    facts: dict[str, object]
    """JSON-serialisable facts: frames, size, fps, available sidecars, source of the calibration, …"""
    problems: list[Finding]
    warnings: list[Finding]

    @property
    def ok(self) -> bool:
        """True if the recording can be read from the first frame to the last."""
        return not self.problems
