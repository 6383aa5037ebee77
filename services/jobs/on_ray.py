"""Attempts on a Ray cluster (extra `ray`).

All machines need this program and must see recordings and results under the same paths as the pool.
Attempts report through their folders, as on one machine.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from services.errors import StoreUnavailable
from services.jobs.task import Task
from services.private_files import keep_files_private

ATTEMPTS_OF_A_PROCESS = 20
"""Attempts after which Ray starts a new worker process, which bounds memory leaks."""


def _attempt(values: dict[str, Any]) -> None:
    """Run an attempt in a Ray worker process."""
    from services.jobs.work import work

    keep_files_private()
    work(Task(**values))


class OnRay:
    """Runner on a Ray cluster.

    Raises:
        StoreUnavailable: if Ray is missing or does not answer.
    """

    def __init__(self, address: str) -> None:
        """Connect to Ray.

        Args:
            address: head of a cluster, or `local` for a cluster in this process.
        """
        try:
            import ray
        except ImportError as error:
            raise StoreUnavailable(
                "jobs.ray is set and Ray is not installed; install the extra `ray`, or leave it out"
            ) from error
        self._ray = ray
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # no usage statistics are sent
        try:
            ray.init(address, log_to_driver=False, include_dashboard=False if address == "local" else None)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            raise StoreUnavailable(f"Ray at {address} cannot be used: {error}; check that it runs") from error
        self._attempts: dict[Any, str] = {}
        """Job id per attempt."""

    def start(self, task: Task) -> None:
        """See `Runner`."""
        # Ray never retries an attempt; the pool does, if it still holds the claim.
        remote = self._ray.remote(
            max_retries=0, max_calls=ATTEMPTS_OF_A_PROCESS,
            num_cpus=task.threads, num_gpus=1 if task.options.get("device") == "cuda" else 0,
        )(_attempt)  # fmt: skip
        self._attempts[remote.remote(asdict(replace(task, niceness=0)))] = task.id

    def ended(self) -> Mapping[str, str]:
        """See `Runner`."""
        if not self._attempts:
            return {}
        done, _ = self._ray.wait(list(self._attempts), num_returns=len(self._attempts), timeout=0)
        return {self._attempts.pop(attempt): self._how(attempt) for attempt in done}

    def kill(self, job_id: str) -> None:
        """See `Runner`."""
        for attempt, job in self._attempts.items():
            if job == job_id:
                self._ray.cancel(attempt, force=True)

    def close(self) -> None:
        """See `Runner`."""
        for attempt in self._attempts:
            self._ray.cancel(attempt, force=True)
        self._attempts.clear()
        self._ray.shutdown()

    def _how(self, attempt: Any) -> str:
        try:
            self._ray.get(attempt)
        except (self._ray.exceptions.RayError, self._ray.exceptions.TaskCancelledError) as error:
            return f"{type(error).__name__} of Ray"
        return "exit code 0"
