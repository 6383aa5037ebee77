"""Implementation of `intrasplat reconstruct`."""

from __future__ import annotations

from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings
from services.cli.runs import report_run


def reconstruct_command(settings: ReplaySettings, steps: int, *, as_json: bool) -> int:
    """Reconstruct offline, write the reports and print their paths.

    Returns:
        The exit code.
    """
    return report_run(lambda *callbacks: reconstruct(settings, steps, *callbacks), settings.out, as_json=as_json)
