"""Atomic delivery of a run's results to its output folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from operators.applications.result import RunOutcome
from operators.errors import RunFailed
from operators.output_folder import OutputFolder

Report = Callable[[RunOutcome, Path], None]
"""Writes report files made from the outcome into a folder, next to the run's own files."""


class HasFolders(Protocol):
    """Settings of a run: a frozen dataclass with the output folder `out`."""

    @property
    def out(self) -> Path: ...

    @property
    def inputs(self) -> Sequence[Path]:
        """Paths that the run reads."""


Settings = TypeVar("Settings", bound=HasFolders)


def delivered(
    settings: Settings,
    command: str,
    run: Callable[[Settings, list[str]], RunOutcome],
    report: Report | None = None,
) -> RunOutcome:
    """Run `run` in a staging folder, add the report, and replace an earlier run's results by the
    new ones.

    A run that ends with RunFailed delivers its partial results. After any other exception the
    earlier results are unchanged.

    Args:
        settings: settings of the run.
        command: name of the command, for the marker of the output folder.
        run: called with the settings, whose `out` is the staging folder, and a list of notes for
            the report.
        report: writes the report files; None for no report.

    Returns:
        The outcome with the final paths of the outputs.

    Raises:
        OutputError: as `OutputFolder` raises it.
        RunFailed: the run ended early; carries the outcome with the final paths.
    """
    with OutputFolder(settings.out, command, settings.inputs) as output:
        notes = ["the output folder held an earlier run; this one replaces its files"] if output.earlier else []

        def deliver(outcome: RunOutcome) -> RunOutcome:
            if outcome.outputs:
                if report is not None:
                    report(outcome, output.path)
                output.publish()
            paths = {name: settings.out / path.relative_to(output.path) for name, path in outcome.outputs.items()}
            return replace(outcome, outputs=paths)

        try:
            return deliver(run(replace(settings, out=output.path), notes))  # type: ignore[type-var]
        except RunFailed as failed:
            assert isinstance(failed.result, RunOutcome)
            raise RunFailed(str(failed), deliver(failed.result)) from failed.__cause__
