"""The API as methods. One `Client` is for one thread at a time."""

from __future__ import annotations

import base64
import hashlib
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx2
from pydantic import TypeAdapter

from services.client.errors import ClientError, Refused, Unreachable
from services.client.pictures import Picture, pictures, tls_context
from services.client.snapshots import SnapshotMethods
from services.control.routes.audit import AuditPage
from services.control.routes.keys import KeyView, MadeKey
from services.control.routes.models import ModelView, VersionView
from services.control.routes.streams import StreamView

TIMEOUT_S = 30.0
CHUNK_BYTES = 1 << 20
WAITING = ("uploaded", "validated")


class Client(SnapshotMethods):
    """A server's API, with one key.

        with Client("http://127.0.0.1:8000", key) as client:
            version = client.upload("liver", Path("liver.isplat"))
            client.checked("liver", version.version)
            client.activate("liver", version.version, expected_current=None)

    Methods raise Unreachable and Refused.
    """

    def __init__(self, url: str, key: str, *, timeout_s: float = TIMEOUT_S, verify: bool | str = True) -> None:
        """verify: whether the server's certificate is checked, or the file of the authority that signed it."""
        self.url = url.rstrip("/")
        self._key = key.strip()
        self._verify = verify
        self._http = httpx2.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {self._key}"},
            timeout=timeout_s,
            verify=tls_context(verify),
        )

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
        try:
            digest, size = _digest_of(file)
            with file.open("rb") as content:
                answer = self._ask(
                    "PUT",
                    f"/v1/models/{name}/versions",
                    content=iter(lambda: content.read(CHUNK_BYTES), b""),
                    headers={
                        "Content-Type": "application/octet-stream",
                        "Content-Length": str(size),
                        "Content-Digest": f"sha-256=:{digest}:",
                    },
                )
        except OSError as error:
            raise ClientError(f"{file} cannot be read: {error.strerror or error}") from error
        return VersionView.model_validate(answer)

    def checked(self, name: str, number: int, *, within_s: float = 300.0) -> VersionView:
        """A version once the server has checked it: `ready`, or `rejected` with a reason. Raises ClientError when that takes too long."""
        until_s, wait_s = time.monotonic() + within_s, 0.1
        while True:
            found = self.version(name, number)
            if found.state not in WAITING:
                return found
            if time.monotonic() > until_s:
                raise ClientError(f"{name}/{number} is still {found.state} after {within_s:g} s; ask again later")
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, 2.0)

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

    def make_key(self, name: str, role: str) -> MadeKey:
        """Make a key; a name may have two, while its callers change over. It is shown this once."""
        return MadeKey.model_validate(self._ask("POST", "/v1/keys", json={"name": name, "role": role}))

    def revoke_key(self, key_id: str) -> None:
        """End a key at once."""
        self._ask("DELETE", f"/v1/keys/{key_id}")

    def audit(self, count: int = 100, before: int | None = None) -> AuditPage:
        """Entries of the audit log, the newest first; with `before`, those before that number."""
        wanted = {"count": count} | ({} if before is None else {"before": before})
        return AuditPage.model_validate(self._ask("GET", "/v1/audit", params=wanted))

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

    def _ask(self, method: str, path: str, **options: Any) -> Any:
        answer = self._answer(method, path, **options)
        return answer.json() if answer.content else None

    def _answer(self, method: str, path: str, **options: Any) -> httpx2.Response:
        try:
            answer = self._http.request(method, path, **options)
        except httpx2.HTTPError as error:
            raise Unreachable(
                f"{self.url} does not answer: {error or type(error).__name__}; check the address, and that the server runs"
            ) from error
        if answer.is_success:
            return answer
        try:
            said = answer.json()
            sentence = str(said.get("detail") or said.get("title"))
        except (ValueError, AttributeError):
            sentence = f"an answer that is no problem document; is {self.url} an IntraSplat server?"
        raise Refused(answer.status_code, sentence)


def _digest_of(file: Path) -> tuple[str, int]:
    """SHA-256 in base64, and the size."""
    with file.open("rb") as content:
        digest = hashlib.file_digest(content, "sha256").digest()
        return base64.b64encode(digest).decode(), content.tell()
