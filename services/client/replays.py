"""Client methods for recordings and replays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from services.client.requests import Requests, waited_for
from services.schemas.models import VersionView
from services.schemas.replays import BatchView, RecordingView, ReplayView, Submitted

OPEN = ("queued", "running")


class ReplayMethods(Requests):
    """Mixin of `Client` for recordings and replays."""

    def recordings(self) -> list[RecordingView]:
        """Return every uploaded recording."""
        return TypeAdapter(list[RecordingView]).validate_python(self._ask("GET", "/v1/recordings"))

    def recording(self, name: str) -> RecordingView:
        """Return one recording."""
        return RecordingView.model_validate(self._ask("GET", f"/v1/recordings/{name}"))

    def upload_recording(self, name: str, file: Path) -> RecordingView:
        """Upload a video, or a zip archive of a recording's folder. The server checks it
        afterwards; `checked_recording` waits for that.

        Raises:
            ClientError: if the file cannot be read.
        """
        return RecordingView.model_validate(self._put_file(f"/v1/recordings/{name}", file))

    def checked_recording(self, name: str, *, within_s: float = 3600.0) -> RecordingView:
        """Wait until the server has checked a recording.

        Returns:
            The recording, `ready` or `rejected` with a reason.

        Raises:
            ClientError: after `within_s` seconds.
        """
        return waited_for(
            lambda: self.recording(name), lambda found: found.state != "uploaded", within_s, f"the check of {name}"
        )

    def delete_recording(self, name: str) -> None:
        """Delete a recording that no replay uses."""
        self._ask("DELETE", f"/v1/recordings/{name}")

    def start_replay(
        self, recording: str, options: Mapping[str, Any] | None = None, *, idempotency_key: str | None = None
    ) -> ReplayView:
        """Queue a replay with options of `intrasplat replay`, by name."""
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
        """Return the newest replays."""
        query = {"count": count, "batch": batch, "state": state}
        chosen = {name: value for name, value in query.items() if value is not None}
        return TypeAdapter(list[ReplayView]).validate_python(self._ask("GET", "/v1/replays", params=chosen))

    def replay(self, job_id: str) -> ReplayView:
        """Return one replay."""
        return ReplayView.model_validate(self._ask("GET", f"/v1/replays/{job_id}"))

    def batch(self, batch: str) -> BatchView:
        """Return the progress of a batch."""
        return BatchView.model_validate(self._ask("GET", f"/v1/batches/{batch}"))

    def ended_replay(self, job_id: str, *, within_s: float = 24 * 3600.0) -> ReplayView:
        """Wait until a replay is done, failed or cancelled.

        Raises:
            ClientError: after `within_s` seconds.
        """
        return waited_for(
            lambda: self.replay(job_id), lambda found: found.state not in OPEN, within_s, f"the replay {job_id}"
        )

    def cancel_replay(self, job_id: str) -> ReplayView:
        """Cancel an unfinished replay."""
        return ReplayView.model_validate(self._ask("POST", f"/v1/replays/{job_id}/cancel"))

    def delete_replay(self, job_id: str) -> None:
        """Delete an ended replay with its results."""
        self._ask("DELETE", f"/v1/replays/{job_id}")

    def result(self, job_id: str, name: str, file: Path, *, overwrite: bool = False) -> None:
        """Download a result file such as `report.html`. An existing file is replaced only with
        `overwrite`."""
        self._get_file(f"/v1/replays/{job_id}/results/{name}", file, overwrite=overwrite)

    def keep_model(self, job_id: str, model: str) -> VersionView:
        """Store a replay's model in the registry as the next version of `model`."""
        return VersionView.model_validate(self._ask("POST", f"/v1/replays/{job_id}/keep", json={"model": model}))


def _header(idempotency_key: str | None) -> dict[str, str]:
    return {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
