"""Recordings and replays as methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from services.client.requests import Requests, waited_for
from services.control.routes.jobs import BatchView, ReplayView, Submitted
from services.control.routes.models import VersionView
from services.control.routes.recordings import RecordingView

OPEN = ("queued", "running")


class ReplayMethods(Requests):
    """Methods of `Client` for recordings and replays."""

    def recordings(self) -> list[RecordingView]:
        """Every uploaded recording."""
        return TypeAdapter(list[RecordingView]).validate_python(self._ask("GET", "/v1/recordings"))

    def recording(self, name: str) -> RecordingView:
        """One recording."""
        return RecordingView.model_validate(self._ask("GET", f"/v1/recordings/{name}"))

    def upload_recording(self, name: str, file: Path) -> RecordingView:
        """Upload a video, or a zip archive of a recording's folder; the server checks it afterwards (`checked_recording` waits for that). Raises
        ClientError for a file that cannot be read."""
        return RecordingView.model_validate(self._put_file(f"/v1/recordings/{name}", file))

    def checked_recording(self, name: str, *, within_s: float = 3600.0) -> RecordingView:
        """A recording once the server has checked it: `ready`, or `rejected` with a reason. Raises ClientError when that takes too long."""
        return waited_for(
            lambda: self.recording(name), lambda found: found.state != "uploaded", within_s, f"the check of {name}"
        )

    def delete_recording(self, name: str) -> None:
        """Delete a recording that no replay uses."""
        self._ask("DELETE", f"/v1/recordings/{name}")

    def start_replay(
        self, recording: str, options: Mapping[str, Any] | None = None, *, idempotency_key: str | None = None
    ) -> ReplayView:
        """Queue a replay. options: those of `intrasplat replay`, by name."""
        wanted = {"recording": recording, "options": dict(options or {})}
        made = Submitted.model_validate(self._ask("POST", "/v1/replays", json=wanted, headers=_header(idempotency_key)))
        return self.replay(str(made.id))

    def start_replays(
        self, recordings: Sequence[str], options: Mapping[str, Any] | None = None, *, idempotency_key: str | None = None
    ) -> Submitted:
        """Queue a replay of each recording, as one batch."""
        wanted = {"recordings": list(recordings), "options": dict(options or {})}
        return Submitted.model_validate(self._ask("POST", "/v1/replays", json=wanted, headers=_header(idempotency_key)))

    def replays(self, *, count: int = 100, batch: str | None = None, state: str | None = None) -> list[ReplayView]:
        """The newest replays."""
        query = {"count": count, "batch": batch, "state": state}
        chosen = {name: value for name, value in query.items() if value is not None}
        return TypeAdapter(list[ReplayView]).validate_python(self._ask("GET", "/v1/replays", params=chosen))

    def replay(self, job_id: str) -> ReplayView:
        """One replay."""
        return ReplayView.model_validate(self._ask("GET", f"/v1/replays/{job_id}"))

    def batch(self, batch: str) -> BatchView:
        """How far a batch has come."""
        return BatchView.model_validate(self._ask("GET", f"/v1/batches/{batch}"))

    def ended_replay(self, job_id: str, *, within_s: float = 24 * 3600.0) -> ReplayView:
        """A replay once it is done, failed or cancelled. Raises ClientError when that takes too long."""
        return waited_for(
            lambda: self.replay(job_id), lambda found: found.state not in OPEN, within_s, f"the replay {job_id}"
        )

    def cancel_replay(self, job_id: str) -> ReplayView:
        """Cancel a replay that has not ended."""
        return ReplayView.model_validate(self._ask("POST", f"/v1/replays/{job_id}/cancel"))

    def delete_replay(self, job_id: str) -> None:
        """Delete a replay that has ended, with its results."""
        self._ask("DELETE", f"/v1/replays/{job_id}")

    def result(self, job_id: str, name: str, file: Path, *, overwrite: bool = False) -> None:
        """Download a file that a replay has made, such as `report.html`. A file that is there is replaced with `overwrite` alone."""
        self._get_file(f"/v1/replays/{job_id}/results/{name}", file, overwrite=overwrite)

    def keep_model(self, job_id: str, model: str) -> VersionView:
        """Keep a replay's model in the registry as the next version of `model`."""
        return VersionView.model_validate(self._ask("POST", f"/v1/replays/{job_id}/keep", json={"model": model}))


def _header(idempotency_key: str | None) -> dict[str, str]:
    return {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
