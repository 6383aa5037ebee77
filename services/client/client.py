"""API client class. Use one `Client` per thread."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx2
from pydantic import TypeAdapter, ValidationError

from services.client.requests import Picture, Requests, check_origin, pictures, refused_by, waited_for
from services.errors import ClientError
from services.schemas import (
    AuditPage,
    BatchView,
    CallerView,
    KeyView,
    MadeKey,
    ModelView,
    Readiness,
    RecordingView,
    ReplayView,
    SnapshotView,
    StreamView,
    Submitted,
    VersionView,
)

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
        """Download a result file such as `report.html`. An existing file is replaced only with `overwrite`."""
        self._get_file(f"/v1/replays/{job_id}/results/{name}", file, overwrite=overwrite)

    def keep_model(self, job_id: str, model: str) -> VersionView:
        """Store a replay's model in the registry as the next version of `model`."""
        return VersionView.model_validate(self._ask("POST", f"/v1/replays/{job_id}/keep", json={"model": model}))


def _header(idempotency_key: str | None) -> dict[str, str]:
    return {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}


EXPORT_S = 330.0
"""Timeout of an export in seconds."""


class SnapshotMethods(Requests):
    """Mixin of `Client` for snapshots and exports."""

    def take_snapshot(
        self, stream: str, model: str | None = None, *, idempotency_key: str | None = None
    ) -> SnapshotView:
        """Take a snapshot of a stream's live model, stored as a file or as the next version of `model`."""
        headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
        wanted = {} if model is None else {"model": model}
        answer = self._ask("POST", f"/v1/streams/{stream}/snapshots", json=wanted, headers=headers)
        return SnapshotView.model_validate(answer)

    def snapshots(self, stream: str) -> list[SnapshotView]:
        """Return the stored snapshots of a stream, newest first."""
        return TypeAdapter(list[SnapshotView]).validate_python(self._ask("GET", f"/v1/streams/{stream}/snapshots"))

    def delete_snapshot(self, stream: str, number: str) -> None:
        """Delete a snapshot."""
        self._ask("DELETE", f"/v1/streams/{stream}/snapshots/{number}")

    def export_version(
        self, name: str, number: int, format_name: str, file: Path, overwrite: bool = False, **wish: Any
    ) -> int:
        """Export a version of a model to a file. `wish`: `time_s`, or `times` of a sequence.

        Returns:
            Size of the file in bytes.
        """
        return self._download(f"/v1/models/{name}/versions/{number}/exports/{format_name}", file, wish, overwrite)

    def render_version(
        self,
        name: str,
        number: int,
        format_name: str,
        file: Path,
        overwrite: bool = False,
        *,
        view: str = "recorded",
        time_s: float | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> int:
        """Render a version of a model to a picture (`png`) or a video (`mp4`).

        Args:
            name: name of the model.
            number: the version.
            format_name: `png` or `mp4`.
            file: path of the result.
            overwrite: replace an existing file.
            view: `recorded`, `orbit` or `stereo`.
            time_s: time of a picture in seconds; None for the end of the model's window.
            options: options of `intrasplat render`, such as `outputs`, by name.

        Returns:
            Size of the file in bytes.
        """
        wanted = {"format": format_name, "view": view, "time_s": time_s, "options": dict(options or {})}
        path = f"/v1/models/{name}/versions/{number}/render"
        return self._get_file(path, file, overwrite=overwrite, method="POST", json=wanted, timeout=EXPORT_S)

    def export_snapshot(
        self, stream: str, number: str, format_name: str, file: Path, overwrite: bool = False, **wish: Any
    ) -> int:
        """Export a snapshot to a file.

        Returns:
            Size of the file in bytes.
        """
        return self._download(f"/v1/streams/{stream}/snapshots/{number}/exports/{format_name}", file, wish, overwrite)

    def _download(self, path: str, file: Path, wish: dict[str, Any], overwrite: bool) -> int:
        """Download an export with the longer timeout EXPORT_S; see `Requests._get_file`."""
        given = {name: value for name, value in wish.items() if value is not None}
        return self._get_file(path, file, overwrite=overwrite, params=given, timeout=EXPORT_S)


TIMEOUT_S = 30.0
WAITING = ("uploaded", "validated")


class Client(ReplayMethods, SnapshotMethods):
    """Client of one server with one API key.

        with Client("http://127.0.0.1:8000", key) as client:
            version = client.upload("liver", Path("liver.isplat"))
            client.checked("liver", version.version)
            client.activate("liver", version.version, expected_current=None)

    All methods raise Unreachable if the server does not answer, and Refused if it rejects the request.
    """

    def __init__(self, url: str, key: str, *, timeout_s: float = TIMEOUT_S, verify: bool | str = True) -> None:
        """Create a client.

        Args:
            url: address of the server.
            key: API key.
            timeout_s: timeout of one read in seconds.
            verify: check the server's certificate, or path of a CA certificate to check against.
        """
        super().__init__(url, key, timeout_s, verify)

    def streams(self) -> list[StreamView]:
        """Return the streams that the key may access."""
        return TypeAdapter(list[StreamView]).validate_python(self._ask("GET", "/v1/streams"))

    def stream(self, name: str) -> StreamView:
        """Return one stream."""
        return StreamView.model_validate(self._ask("GET", f"/v1/streams/{name}"))

    def create_stream(
        self, name: str, source: str, *, show: str = "live", device: str = "auto", start: bool = True,
        options: Mapping[str, Any] | None = None,
    ) -> StreamView:  # fmt: skip
        """Create a stream.

        Args:
            name: name of the stream.
            source: address that the server's settings allow.
            show: `live` or `model NAME`.
            device: auto, cpu, cuda or cuda:N.
            start: start the stream.
            options: source and reconstruction options.
        """
        wanted = dict(name=name, source=source, show=show, device=device, start=start, options=dict(options or {}))
        return StreamView.model_validate(self._ask("POST", "/v1/streams", json=wanted))

    def start_stream(self, name: str) -> StreamView:
        """Start a stream."""
        return StreamView.model_validate(self._ask("POST", f"/v1/streams/{name}/start"))

    def stop_stream(self, name: str) -> StreamView:
        """Stop a stream."""
        return StreamView.model_validate(self._ask("POST", f"/v1/streams/{name}/stop"))

    def set_stream_options(self, name: str, options: Mapping[str, Any]) -> StreamView:
        """Change options of a stream, whose affected process restarts. Options that are not given keep their values, and None
        restores the default.
        """
        answer = self._ask("PATCH", f"/v1/streams/{name}/options", json={"options": dict(options)})
        return StreamView.model_validate(answer)

    def delete_stream(self, name: str) -> None:
        """Stop and delete a stream."""
        self._ask("DELETE", f"/v1/streams/{name}")

    def turn_camera(self, stream: str, azimuth_deg: float = 0, elevation_deg: float = 0, zoom: float = 1) -> None:
        """Set the position of a stream's virtual camera, from which its pictures of kind `orbit` are rendered.

        The position is absolute: each call replaces the one before. The camera orbits the point at the centre of the
        endoscope's picture.

        Args:
            stream: name of the stream.
            azimuth_deg: rotation to the right from the endoscope's view, in degrees.
            elevation_deg: rotation upwards from the endoscope's view, in degrees.
            zoom: magnification.
        """
        wanted = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg, "zoom": zoom}
        self._ask("PUT", f"/v1/streams/{stream}/camera", json=wanted)

    def pictures(self, stream: str, kind: str = "shown", quality: int = 75) -> Iterator[Picture]:
        """Yield a stream's pictures until the stream or the server stops. Close the iterator to unsubscribe."""
        path = f"/v1/streams/{stream}/display"
        ticket = self._ask("POST", "/v1/tickets", json={"path": path})["ticket"]
        return pictures(self.url, path, ticket, kind, quality, self._verify)

    def models(self) -> list[ModelView]:
        """Return every model with its active version."""
        return TypeAdapter(list[ModelView]).validate_python(self._ask("GET", "/v1/models"))

    def versions(self, name: str) -> list[VersionView]:
        """Return the versions of a model."""
        return TypeAdapter(list[VersionView]).validate_python(self._ask("GET", f"/v1/models/{name}/versions"))

    def version(self, name: str, number: int) -> VersionView:
        """Return one version."""
        return VersionView.model_validate(self._ask("GET", f"/v1/models/{name}/versions/{number}"))

    def upload(self, name: str, file: Path) -> VersionView:
        """Upload a file of `intrasplat pack`, or a `.ply`, `.splat` or `.spz` file of another program.

        The server checks it afterwards; `checked` waits for that.

        Raises:
            ClientError: if the file cannot be read.
        """
        suffix = file.suffix.lower().removeprefix(".")
        converted: dict[str, Any] = {}
        if suffix in ("ply", "splat", "spz"):  # converted before the answer
            converted = {"params": {"format": suffix}, "timeout": EXPORT_S}
        return VersionView.model_validate(self._put_file(f"/v1/models/{name}/versions", file, **converted))

    def checked(self, name: str, number: int, *, within_s: float = 300.0) -> VersionView:
        """Wait until the server has checked a version.

        Returns:
            The version, `ready` or `rejected` with a reason.

        Raises:
            ClientError: after `within_s` seconds.
        """
        return waited_for(
            lambda: self.version(name, number), lambda found: found.state not in WAITING, within_s, f"{name}/{number}"
        )

    def activate(self, name: str, number: int, expected_current: int | None) -> VersionView:
        """Activate a version in place of `expected_current` (None if no version is active).

        The server refuses if another version is active.
        """
        wanted = {"version": number, "expected_current": expected_current}
        return VersionView.model_validate(self._ask("POST", f"/v1/models/{name}/activate", json=wanted))

    def rollback(self, name: str) -> VersionView:
        """Activate the previous version again."""
        return VersionView.model_validate(self._ask("POST", f"/v1/models/{name}/rollback"))

    def delete_version(self, name: str, number: int) -> None:
        """Delete a version that is not active."""
        self._ask("DELETE", f"/v1/models/{name}/versions/{number}")

    def about(self) -> dict[str, Any]:
        """Return the server's version and its parts."""
        return dict(self._ask("GET", "/v1/version"))

    def keys(self) -> list[KeyView]:
        """Return every API key without its secret."""
        return TypeAdapter(list[KeyView]).validate_python(self._ask("GET", "/v1/keys"))

    def make_key(
        self, name: str, role: str, *, expires_at: datetime | None = None, streams: Sequence[str] | None = None
    ) -> MadeKey:
        """Create a key. The token is returned only here. A name may have two valid keys for a change-over.

        Args:
            name: owner.
            role: viewer, operator or admin.
            expires_at: expiry with a time zone, or None.
            streams: streams that the key is limited to, or None for all.
        """
        wanted = {
            "name": name,
            "role": role,
            "expires_at": None if expires_at is None else expires_at.isoformat(),
            "streams": None if streams is None else list(streams),
        }
        return MadeKey.model_validate(self._ask("POST", "/v1/keys", json=wanted))

    def myself(self) -> CallerView:
        """Return name, role and limits of this client's key."""
        return CallerView.model_validate(self._ask("GET", "/v1/me"))

    def ready(self) -> Readiness:
        """Return the checks of /readyz, also if the server is not ready."""
        try:
            answer = self._http.request("GET", "/readyz", params={"verbose": "1"})
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error
        if answer.status_code not in (200, 503):
            raise refused_by(answer, self.url)
        try:
            return Readiness.model_validate_json(answer.content)
        except ValidationError as error:
            raise ClientError(f"{self.url}/readyz answers with something else; is it an IntraSplat server?") from error

    def revoke_key(self, key_id: str) -> None:
        """Revoke a key at once."""
        self._ask("DELETE", f"/v1/keys/{key_id}")

    def audit(
        self,
        count: int = 100,
        before: int | None = None,
        *,
        event: str | None = None,
        actor: str | None = None,
        subject: str | None = None,
        outcome: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
    ) -> AuditPage:
        """Return entries of the audit log, newest first.

        Args:
            count: maximum number of entries.
            before: return only entries below this number.
            event: event name such as `model.activate`, or `model` for all its events.
            actor: part of the actor.
            subject: part of the subject.
            outcome: done, refused or failed.
            since: earliest time, with a time zone.
            until: end of the time range, exclusive.
        """
        wanted = {"count": count, "before": before} | _filter(event, actor, subject, outcome, since, until)
        given = {name: value for name, value in wanted.items() if value is not None}
        return AuditPage.model_validate(self._ask("GET", "/v1/audit", params=given))

    def export_audit(
        self,
        form: str = "jsonl",
        *,
        event: str | None = None,
        actor: str | None = None,
        subject: str | None = None,
        outcome: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
    ) -> Iterator[str]:
        """Yield the lines of the audit log as `jsonl` or `csv`, oldest first. The filter is that of `audit`."""
        wanted = {"format": form} | _filter(event, actor, subject, outcome, since, until)
        given = {name: value for name, value in wanted.items() if value is not None}
        try:
            with self._http.stream("GET", "/v1/audit/export", params=given) as answer:
                if not answer.is_success:
                    answer.read()
                    raise refused_by(answer, self.url)
                check_origin(answer, self.url)
                yield from answer.iter_lines()
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error

    def metrics(self) -> str:
        """Return the metrics in the Prometheus format."""
        return self._answer("GET", "/metrics").text

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _filter(
    event: str | None,
    actor: str | None,
    subject: str | None,
    outcome: str | None,
    since: datetime | None,
    until: datetime | None,
) -> dict[str, str | None]:
    times = {name: None if time is None else time.isoformat() for name, time in (("since", since), ("until", until))}
    return {"event": event, "actor": actor, "subject": subject, "outcome": outcome, **times}
