"""Runner interface for attempts: local processes (`forks`) or Ray (`on_ray`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from services.jobs.task import Task


class Runner(Protocol):
    """Runner of concurrent tasks. Attempts report through their folder (`Task`); the runner only
    starts and ends them."""

    def start(self, task: Task) -> None:
        """Start an attempt."""

    def ended(self) -> Mapping[str, str]:
        """Return the attempts that ended since the last call: job id and description of the end."""
        ...

    def kill(self, job_id: str) -> None:
        """Kill an attempt; `ended` reports it. No effect on an ended attempt."""

    def close(self) -> None:
        """Kill all attempts."""
