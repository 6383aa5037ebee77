"""In-memory parts of the control plane."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from services.api.problems import Conflicting, Missing, Unprocessable
from services.api.state import Parts
from services.display import EncodedPicture
from services.schemas import StreamView
from services.settings import StreamSettings


class NotThere(Exception):
    """Stand-in for a registry's not-found error."""


class NotNow(Exception):
    """Stand-in for a registry's temporary failure."""


@dataclass(frozen=True)
class FakeVersion:
    name: str
    version: int
    state: str
    digest: str
    size_bytes: int
    uploaded_by: str
    reason: str | None = None
    uploaded_at: str = "2026-01-01T00:00:00+00:00"


@dataclass(frozen=True)
class FakeModel:
    name: str
    active: int | None


class FakeModels:
    """Registry that accepts models beginning with `GOOD`."""

    def __init__(self) -> None:
        self.kept: dict[str, dict[int, FakeVersion]] = {}
        self.bytes: dict[tuple[str, int], bytes] = {}
        self.active: dict[str, list[int]] = {}

    def upload(self, name: str, file: Path, digest: str | None, by: str) -> FakeVersion:
        data = file.read_bytes()
        digest = digest or hashlib.sha256(data).hexdigest()
        numbers = self.kept.setdefault(name, {})
        number = max(numbers, default=0) + 1
        numbers[number] = FakeVersion(name, number, "uploaded", digest, len(data), by)
        self.bytes[name, number] = data
        return numbers[number]

    def upload_splats(self, name: str, file: Path, format_name: str, by: str) -> FakeVersion:
        return self.upload(f"{name}-{format_name}", file, None, by)

    def check(self, name: str, version: int) -> FakeVersion:
        good = self.bytes[name, version].startswith(b"GOOD")
        record = replace(
            self.version(name, version),
            state="ready" if good else "rejected",
            reason=None if good else "it is not good",
        )
        self.kept[name][version] = record
        return record

    def models(self) -> list[FakeModel]:
        return [FakeModel(name, (self.active.get(name) or [None])[-1]) for name in self.kept]

    def versions(self, name: str) -> list[FakeVersion]:
        if name not in self.kept:
            raise NotThere(f"there is no model {name}; PUT a version of it first")
        return list(self.kept[name].values())

    def version(self, name: str, number: int) -> FakeVersion:
        try:
            return self.kept[name][number]
        except KeyError:
            raise NotThere(f"there is no version {number} of {name}") from None

    def activate(self, name: str, version: int, expected_current: int | None, by: str) -> FakeVersion:
        record = self.version(name, version)
        current = (self.active.get(name) or [None])[-1]
        if current != expected_current or record.state == "rejected":
            raise NotNow(f"version {current} of {name} is active, {expected_current} was expected")
        self.active.setdefault(name, []).append(version)
        return replace(record, state="active")

    def rollback(self, name: str, by: str) -> FakeVersion:
        if len(self.active.get(name, [])) < 2:
            raise NotNow(f"there is nothing before the active version of {name}")
        self.active[name].pop()
        return replace(self.version(name, self.active[name][-1]), state="active")

    def delete(self, name: str, version: int, by: str) -> None:
        self.version(name, version)
        if version in self.active.get(name, [])[-1:]:
            raise NotNow(f"version {version} of {name} is active; activate another one first")
        del self.kept[name][version]


def stream_view(name: str, **values: Any) -> StreamView:
    """Return a stream with the given values."""
    about = {"source": "synthetic:", "show": "live", "device": "cpu", "options": {}, "state": "stopped", **values}
    return StreamView(name=name, **about)


class FakeStreams:
    def __init__(self) -> None:
        self.kept: dict[str, StreamView] = {}
        self.created: dict[str, StreamSettings] = {}

    def all(self) -> list[StreamView]:
        return list(self.kept.values())

    def get(self, name: str) -> StreamView:
        if name not in self.kept:
            raise Missing(f"there is no stream {name}")
        return self.kept[name]

    def create(self, name: str, settings: StreamSettings) -> StreamView:
        if name in self.kept:
            raise Conflicting(f"a stream named {name} already exists")
        self.created[name] = settings
        self.kept[name] = stream_view(name, **settings.model_dump(include={"source", "show", "device", "options"}))
        return self.kept[name]

    async def start(self, name: str) -> StreamView:
        return self._changed(name, state="live")

    async def stop(self, name: str) -> StreamView:
        return self._changed(name, state="stopped")

    async def set_options(self, name: str, options: Mapping[str, Any]) -> StreamView:
        if "unknown" in options:
            raise Unprocessable("there is no option unknown; the nearest is tool_mask")
        return self._changed(name, options={**self.get(name).options, **options})

    async def delete(self, name: str) -> None:
        self.get(name)
        del self.kept[name]

    async def set_camera(self, name: str, camera: Mapping[str, float]) -> Mapping[str, float]:
        self.get(name)
        self.camera = dict(camera)
        return camera

    def _changed(self, name: str, **values: Any) -> StreamView:
        self.kept[name] = self.get(name).model_copy(update=values)
        return self.kept[name]


class FakeDisplay:
    """Endless display with a picture every 5 ms that counts its open subscriptions."""

    def __init__(self, jpeg: bytes = b"\xff\xd8jpeg\xff\xd9", most: int | None = None) -> None:
        self.jpeg = jpeg
        self.most = most
        self.open = 0
        self.asked: list[tuple[str, str, int]] = []

    @asynccontextmanager
    async def subscribe(self, stream: str, kind: str, quality: int) -> AsyncIterator[AsyncIterator[EncodedPicture]]:
        self.asked.append((stream, kind, quality))
        self.open += 1
        try:
            yield self.pictures()
        finally:
            self.open -= 1

    async def pictures(self) -> AsyncIterator[EncodedPicture]:
        seq = 0
        while self.most is None or seq < self.most:
            yield EncodedPicture({"seq": seq, "state": "live"}, self.jpeg)
            seq += 1
            await asyncio.sleep(0.005)


class FakeRecordings:
    """Recording store that accepts files beginning with `GOOD`."""

    def __init__(self) -> None:
        self.kept: dict[str, FakeRecording] = {}
        self.used: set[str] = set()

    def add(self, name: str, file: Path, digest: str, by: str) -> tuple[FakeRecording, bool]:
        there = self.kept.get(name)
        if there is not None and there.digest != digest:
            raise NotNow(f"there is another recording {name}")
        state = "ready" if file.read_bytes().startswith(b"GOOD") else "rejected"
        made = FakeRecording(name, digest, file.stat().st_size, by, later=state)
        return self.kept.setdefault(name, made), there is None

    def check(self, name: str) -> FakeRecording:
        record = self.get(name)
        self.kept[name] = replace(record, state=record.later, description={"frames": 3, "layout": "video"})
        return self.kept[name]

    def all(self) -> list[FakeRecording]:
        return list(self.kept.values())

    def get(self, name: str) -> FakeRecording:
        if name not in self.kept:
            raise NotThere(f"there is no recording {name}")
        return self.kept[name]

    def delete(self, name: str) -> FakeRecording:
        if name in self.used:
            raise NotNow(f"a replay uses {name}")
        self.get(name)
        return self.kept.pop(name)


@dataclass(frozen=True)
class FakeRecording:
    name: str
    digest: str
    size_bytes: int
    uploaded_by: str
    kind: str = "video"
    state: str = "uploaded"
    reason: str | None = None
    kept_bytes: int = 0
    uploaded_at: str = "2026-01-01T00:00:00+00:00"
    description: Mapping[str, Any] = field(default_factory=dict)
    later: str = "ready"


def fake_parts(**other: Any) -> Parts:
    """Return the services that the routes need."""
    given: dict[str, Any] = {
        "streams": FakeStreams(),
        "models": FakeModels(),
        "display": FakeDisplay(),
        "recordings": FakeRecordings(),
    }
    return Parts(**{**given, "errors": {NotThere: Missing, NotNow: Conflicting}, **other})
