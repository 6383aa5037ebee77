"""The API as methods. One `Client` is for one thread at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx2
from pydantic import TypeAdapter, ValidationError

from services.client.errors import ClientError
from services.client.pictures import Picture, pictures
from services.client.replays import ReplayMethods
from services.client.requests import refused_by, waited_for
from services.client.snapshots import SnapshotMethods
from services.control.health import Readiness
from services.control.routes.audit import AuditPage
from services.control.routes.keys import KeyView, MadeKey, Myself
from services.control.routes.models import ModelView, VersionView
from services.control.routes.streams import StreamView

TIMEOUT_S = 30.0
WAITING = ("uploaded", "validated")


class Client(ReplayMethods, SnapshotMethods):
    """A server's API, with one key.

        with Client("http://127.0.0.1:8000", key) as client:
            version = client.upload("liver", Path("liver.isplat"))
            client.checked("liver", version.version)
            client.activate("liver", version.version, expected_current=None)

    Methods raise Unreachable and Refused.
    """

    def __init__(self, url: str, key: str, *, timeout_s: float = TIMEOUT_S, verify: bool | str = True) -> None:
        """verify: whether the server's certificate is checked, or the file of the authority that signed it."""
        super().__init__(url, key, timeout_s, verify)

    def streams(self) -> list[StreamView]:
        """Every stream."""
        return TypeAdapter(list[StreamView]).validate_python(self._ask("GET", "/v1/streams"))

    def stream(self, name: str) -> StreamView:
        """One stream."""
        return StreamView.model_validate(self._ask("GET", f"/v1/streams/{name}"))

    def create_stream(
        self, name: str, source: str, *, show: str = "live", device: str = "auto", start: bool = True,
        options: Mapping[str, Any] | None = None,
    ) -> StreamView:  # fmt: skip
        """Make a stream. source: an address that the server's settings allow."""
        wanted = dict(name=name, source=source, show=show, device=device, start=start, options=dict(options or {}))
        return StreamView.model_validate(self._ask("POST", "/v1/streams", json=wanted))

    def start_stream(self, name: str) -> StreamView:
        """Start a stream."""
        return StreamView.model_validate(self._ask("POST", f"/v1/streams/{name}/start"))

    def stop_stream(self, name: str) -> StreamView:
        """Stop a stream."""
        return StreamView.model_validate(self._ask("POST", f"/v1/streams/{name}/stop"))

    def delete_stream(self, name: str) -> None:
        """Stop a stream and forget it."""
        self._ask("DELETE", f"/v1/streams/{name}")

    def turn_camera(self, stream: str, azimuth_deg: float = 0, elevation_deg: float = 0, zoom: float = 1) -> None:
        """Turn a stream's virtual camera, whose view is the picture `orbit`."""
        wanted = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg, "zoom": zoom}
        self._ask("PUT", f"/v1/streams/{stream}/camera", json=wanted)

    def pictures(self, stream: str, kind: str = "shown", quality: int = 75) -> Iterator[Picture]:
        """What a stream shows, as it comes, until the stream or the server ends. Close the iterator to leave."""
        path = f"/v1/streams/{stream}/display"
        ticket = self._ask("POST", "/v1/tickets", json={"path": path})["ticket"]
        return pictures(self.url, path, ticket, kind, quality, self._verify)

    def models(self) -> list[ModelView]:
        """Every model, with its active version."""
        return TypeAdapter(list[ModelView]).validate_python(self._ask("GET", "/v1/models"))

    def versions(self, name: str) -> list[VersionView]:
        """The versions of a model."""
        return TypeAdapter(list[VersionView]).validate_python(self._ask("GET", f"/v1/models/{name}/versions"))

    def version(self, name: str, number: int) -> VersionView:
        """One version."""
        return VersionView.model_validate(self._ask("GET", f"/v1/models/{name}/versions/{number}"))

    def upload(self, name: str, file: Path) -> VersionView:
        """Upload a file that `intrasplat pack` made; the server checks it afterwards (`checked` waits for that). Raises ClientError for a file
        that cannot be read."""
        return VersionView.model_validate(self._put_file(f"/v1/models/{name}/versions", file))

    def checked(self, name: str, number: int, *, within_s: float = 300.0) -> VersionView:
        """A version once the server has checked it: `ready`, or `rejected` with a reason. Raises ClientError when that takes too long."""
        return waited_for(
            lambda: self.version(name, number), lambda found: found.state not in WAITING, within_s, f"{name}/{number}"
        )

    def activate(self, name: str, number: int, expected_current: int | None) -> VersionView:
        """Let a version be shown in place of `expected_current` (None: no one is active)."""
        wanted = {"version": number, "expected_current": expected_current}
        return VersionView.model_validate(self._ask("POST", f"/v1/models/{name}/activate", json=wanted))

    def rollback(self, name: str) -> VersionView:
        """Show the version before again."""
        return VersionView.model_validate(self._ask("POST", f"/v1/models/{name}/rollback"))

    def delete_version(self, name: str, number: int) -> None:
        """Delete a version that is not active."""
        self._ask("DELETE", f"/v1/models/{name}/versions/{number}")

    def about(self) -> dict[str, Any]:
        """The server's version, and which parts it has."""
        return dict(self._ask("GET", "/v1/version"))

    def keys(self) -> list[KeyView]:
        """Every API key, without what makes it one."""
        return TypeAdapter(list[KeyView]).validate_python(self._ask("GET", "/v1/keys"))

    def make_key(
        self, name: str, role: str, *, expires_at: datetime | None = None, streams: Sequence[str] | None = None
    ) -> MadeKey:
        """Make a key, which is shown this once. A name may have two valid ones, while its callers change over.

        Args:
            name: whom it is for.
            role: viewer, operator or admin.
            expires_at: from when on it is refused, with a time zone; None: never.
            streams: names of the streams that it is limited to; None: not limited.
        """
        wanted = {
            "name": name,
            "role": role,
            "expires_at": None if expires_at is None else expires_at.isoformat(),
            "streams": None if streams is None else list(streams),
        }
        return MadeKey.model_validate(self._ask("POST", "/v1/keys", json=wanted))

    def myself(self) -> Myself:
        """Name, role and limits of this client's key."""
        return Myself.model_validate(self._ask("GET", "/v1/me"))

    def ready(self) -> Readiness:
        """Each check of /readyz, whether the server is ready or not."""
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
        """End a key at once."""
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
        """Return entries of the audit log, the newest first.

        Args:
            count: at most so many.
            before: those before that number.
            event: as `model.activate`, or `model` for all of its events.
            actor: part of the actor.
            subject: part of the subject.
            outcome: done, refused or failed.
            since: from this moment on, with a time zone.
            until: before this moment.
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
        """Yield the lines of the audit log as `jsonl` or `csv`, the oldest entry first. The filter is that of `audit`."""
        wanted = {"format": form} | _filter(event, actor, subject, outcome, since, until)
        given = {name: value for name, value in wanted.items() if value is not None}
        try:
            with self._http.stream("GET", "/v1/audit/export", params=given) as answer:
                if not answer.is_success:
                    answer.read()
                    raise refused_by(answer, self.url)
                yield from answer.iter_lines()
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error

    def metrics(self) -> str:
        """What is measured, in Prometheus' format."""
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
