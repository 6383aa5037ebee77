"""Streams that show a model follow the registry: the active version is shown, and one that an engine gave up is rolled back."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from services.bus.errors import BusError
from services.control.system_events import SystemEvents
from services.registry.errors import RegistryError
from services.registry.models import ModelRegistry
from services.server.streams import Stream, SupervisedStreams

log = logging.getLogger(__name__)
LOOK_S = 0.25
MOST_MS = 200.0
"""A model whose pictures take longer again and again gives way to the one before it."""
PREPARE_S = 60.0
"""How long loading a model and drawing its first picture may take."""
AGAIN_S = 5.0
"""After a refusal an engine is asked again so much later."""


GivenUp = tuple[tuple[str, int, str], ...]


@dataclass(frozen=True)
class Asked:
    """What an engine was asked to show, and which models it had taken back by then."""

    name: str
    version: int
    given_up_before: GivenUp


class ShownModels:
    """Looks four times a second whether each stream shows what it is to show. An engine that is started again is told again."""

    def __init__(self, streams: SupervisedStreams, registry: ModelRegistry, events: SystemEvents | None = None) -> None:
        self._streams, self._registry = streams, registry
        self._events = events or SystemEvents()
        self._refused: dict[tuple[str, str, int], float] = {}
        """When an engine refused a version, by stream, model and version."""
        self._asked: dict[str, Asked] = {}
        """What each stream's engine was asked for last."""

    @asynccontextmanager
    async def following(self) -> AsyncIterator[None]:
        """Follow until the block is left."""
        task = asyncio.create_task(self._follow(), name="shown models")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _follow(self) -> None:
        while True:
            for stream in self._streams.running_streams():
                try:
                    await self.look_at(stream)
                except (BusError, RegistryError) as error:
                    log.warning("%s does not show what it is to: %s", stream.wanted.name, error)
            await asyncio.sleep(LOOK_S)

    async def look_at(self, stream: Stream) -> None:
        """Have one stream show the active version of its model. Raises BusError, RegistryError."""
        kind, _, name = stream.wanted.show.partition(" ")
        supervisor = stream.supervisor
        if kind != "model" or supervisor is None:
            return
        engine = supervisor.state().engine
        if engine.state != "running":
            return
        await self._roll_back_if_given_up(stream.wanted.name, engine.figures)
        active = await asyncio.to_thread(self._registry.active, name)
        shown = engine.figures.get("model") or {}
        if active is None or (shown.get("name"), shown.get("version")) == (name, active.version):
            return
        now_s, which = asyncio.get_running_loop().time(), (stream.wanted.name, name, active.version)
        if now_s - self._refused.get(which, -AGAIN_S) < AGAIN_S:
            return
        folder = await asyncio.to_thread(self._registry.folder_of, name, active.version)
        wanted = {"folder": str(folder), "version": active.version, "name": name, "most_ms": MOST_MS}
        try:
            await supervisor.command("engine", "show_model", timeout_s=PREPARE_S, **wanted)
        except BusError:
            self._refused[which] = now_s
            raise
        self._asked[stream.wanted.name] = Asked(name, active.version, _given_up(engine.figures))
        log.info("%s shows %s/%d", stream.wanted.name, name, active.version)

    async def _roll_back_if_given_up(self, stream: str, figures: Mapping[str, Any]) -> None:
        """Have the registry serve the version before, where the engine found that the one it was asked for cannot be shown."""
        asked, given_up = self._asked.get(stream), _given_up(figures)
        if asked is None or given_up == asked.given_up_before:
            return
        name, version, reason = given_up[-1]
        if (name, version) != (asked.name, asked.version):
            return
        del self._asked[stream]
        change = await asyncio.to_thread(
            self._registry.rollback, name, "engine", expected_current=version, reason=reason
        )
        self._events.tell("model.rollback", name, given_up=version, version=change.version, stream=stream)
        log.error("%s/%d was rolled back to %d: %s", name, version, change.version, reason)


def _given_up(figures: Mapping[str, Any]) -> GivenUp:
    """The newest models that an engine took back, the newest last."""
    return tuple((each["name"], each["version"], each["reason"]) for each in figures.get("gave_way") or ())
