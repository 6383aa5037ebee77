"""Implementation of `intrasplat replay`."""

from __future__ import annotations

from operators.applications.replay import ReplaySettings, replay
from services.cli.runs import report_run


def replay_command(settings: ReplaySettings, *, as_json: bool) -> int:
    """Replay, write the reports and print their paths.

    Returns:
        The exit code.
    """
    return report_run(lambda *callbacks: replay(settings, *callbacks), settings.out, as_json=as_json)
