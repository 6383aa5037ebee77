"""What runs the attempts of a pool: processes of this machine (`forks`), or Ray (`on_ray`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from services.jobs.task import Task


class Runner(Protocol):
    """Runs tasks beside each other. An attempt says what it does in its folder (`Task`); here it only lives and ends."""

    def start(self, task: Task) -> None:
        """Begin an attempt."""

    def ended(self) -> Mapping[str, str]:
        """Attempts that have ended since this was asked last, by the job's id: how, in words."""
        ...

    def kill(self, job_id: str) -> None:
        """End an attempt at once; `ended` tells of it. Without effect on one that has ended."""

    def close(self) -> None:
        """End all of them."""
