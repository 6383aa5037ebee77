"""Synchronisation of streams with the registry: the active version is displayed, and a version that
the engine rejects is rolled back."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from services.audit.system_events import SystemEvents
from services.errors import BusError, RegistryError
from services.registry.models import ModelRegistry
from services.server.streams import Stream, SupervisedStreams

log = logging.getLogger(__name__)
LOOK_S = 0.25
MOST_MS = 200.0
"""Time limit per picture in milliseconds. A model that repeatedly exceeds it is replaced by the
previous one."""
PREPARE_S = 60.0
"""Seconds allowed for loading a model and rendering its first picture."""
AGAIN_S = 5.0
"""Seconds before a refused request to an engine is repeated."""


GivenUp = tuple[tuple[str, int, str], ...]


@dataclass(frozen=True)
class Asked:
    """Last request to an engine, and the models it had rolled back by then."""

    name: str
    version: int
    given_up_before: GivenUp


class ShownModels:
    """Polls four times a second that each stream displays its configured model. A restarted engine
    gets the request again."""

    def __init__(self, streams: SupervisedStreams, registry: ModelRegistry, events: SystemEvents | None = None) -> None:
        self._streams, self._registry = streams, registry
        self._events = events or SystemEvents()
        self._refused: dict[tuple[str, str, int], float] = {}
        """Time of an engine's refusal, by stream, model and version."""
        self._asked: dict[str, Asked] = {}
        """Last request to each stream's engine."""

    @asynccontextmanager
    async def following(self) -> AsyncIterator[None]:
        """Synchronise while the block runs."""
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
        """Make a stream display the active version of its model.

        Raises:
            BusError: if the engine does not answer.
            RegistryError: if the registry fails.
        """
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
        """Roll back the active version if the engine reports that it cannot be displayed."""
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
    """Return the models that an engine rolled back, newest last."""
    return tuple((each["name"], each["version"], each["reason"]) for each in figures.get("gave_way") or ())
