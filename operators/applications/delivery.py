"""From a run to its output folder: everything that one run has made appears there together, or nothing does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from operators.applications.result import RunOutcome
from operators.errors import RunFailed
from operators.output_folder import OutputFolder

Report = Callable[[RunOutcome, Path], None]
"""Writes what it makes of an outcome into a folder, beside the outcome's own files."""


class HasFolders(Protocol):
    """Settings of a run: a frozen dataclass with `out`, the folder of its results."""

    @property
    def out(self) -> Path: ...

    @property
    def inputs(self) -> Sequence[Path]:
        """What the run reads from the disk."""


Settings = TypeVar("Settings", bound=HasFolders)


def delivered(
    settings: Settings,
    command: str,
    run: Callable[[Settings, list[str]], RunOutcome],
    report: Report | None = None,
) -> RunOutcome:
    """Let `run` write into a folder of its own, add the report, and put all of it in the place of an earlier run's results.

    run: takes the settings with that folder as `out`, and a list for the notes of its report. A run that ends with RunFailed delivers
    what it had reached; after any other exception the earlier results are there as before.

    Raises as `OutputFolder` and as `run`; a RunFailed carries the outcome with the final paths.
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
