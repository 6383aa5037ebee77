"""Streams that show a model follow the registry; the registry rolls back versions that an engine gives up."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from services.bus.runtime import RuntimeFolder
from services.errors import CommandRefused, Conflict, NotFound
from services.settings import StreamSettings
from services.supervisor.stream import ShownModels, Stream
from services.supervisor.worker import specs_of
from tests.services.supervisor.test_overall import process


class Registry:
    """Registry with one model and its versions 1 and 2."""

    def __init__(self) -> None:
        self.current: int | None = 1
        self.rolled_back: list[tuple] = []

    def active(self, name):
        return None if self.current is None else SimpleNamespace(version=self.current)

    def folder_of(self, name, version):
        return f"/models/{name}/{version}"

    def rollback(self, name, by, *, expected_current, reason):
        if expected_current != 2:
            raise Conflict("nothing was active before")
        self.rolled_back.append((name, by, expected_current, reason))
        self.current = 1
        return SimpleNamespace(version=1)


class Engine:
    """Engine that shows every requested model."""

    def __init__(self) -> None:
        self.figures: dict = {"model": None, "gave_way": []}
        self.engine_state, self.asked, self.refuses = "running", [], False

    @property
    def state(self):
        return SimpleNamespace(state=self.engine_state, figures=self.figures)

    async def command(self, command, *, timeout_s, **arguments):
        self.asked.append((command, arguments["folder"]))
        if self.refuses:
            raise CommandRefused("no room")
        self.figures = {**self.figures, "model": {"name": arguments["name"], "version": arguments["version"]}}

    def gives_up(self, version, reason, instead):
        taken_back = {"name": "wall", "version": version, "reason": reason}
        shown = None if instead is None else {"name": "wall", "version": instead}
        self.figures = {"model": shown, "gave_way": [*self.figures["gave_way"], taken_back]}


@pytest.fixture
def parts():
    registry, engine = Registry(), Engine()
    settings = SimpleNamespace(show="model wall")
    stream = SimpleNamespace(
        name="theatre", settings=settings, engine=engine, processes={"engine": engine}, model_fault=None
    )
    return SimpleNamespace(
        registry=registry, engine=engine, stream=stream, models=ShownModels(SimpleNamespace(), registry)
    )


def show_active_times(parts, times=1):
    async def look():
        for _ in range(times):
            await parts.models.show_active(parts.stream)

    asyncio.run(look())


def test_show_active_sends_command_only_for_new_version_or_engine(parts):
    show_active_times(parts, 3)
    assert parts.engine.asked == [("show_model", "/models/wall/1")]
    parts.registry.current = 2
    show_active_times(parts, 2)
    assert parts.engine.asked[1:] == [("show_model", "/models/wall/2")]
    parts.engine.figures = {"model": None, "gave_way": []}
    show_active_times(parts, 2)
    assert len(parts.engine.asked) == 3


@pytest.mark.parametrize("why", ["live", "stopped", "starting", "none active"])
def test_show_active_sends_no_command_if_live_stopped_or_inactive(parts, why):
    if why == "live":
        parts.stream.settings.show = "live"
    elif why == "stopped":
        parts.stream.processes = {}
    elif why == "starting":
        parts.engine.engine_state = "starting"
    else:
        parts.registry.current = None
    show_active_times(parts)
    assert parts.engine.asked == []


def test_version_given_up_by_engine_is_rolled_back_once(parts):
    parts.registry.current = 2
    show_active_times(parts)
    parts.engine.gives_up(2, "its picture is not finite", instead=1)
    show_active_times(parts, 3)
    assert parts.registry.rolled_back == [("wall", "engine", 2, "its picture is not finite")]
    assert parts.registry.current == 1 and len(parts.engine.asked) == 1
    parts.registry.current = 2
    show_active_times(parts, 3)
    assert len(parts.registry.rolled_back) == 1 and parts.engine.asked[-1][1] == "/models/wall/2"
    parts.engine.gives_up(2, "it took 300.0 ms", instead=1)
    show_active_times(parts)
    assert len(parts.registry.rolled_back) == 2


def test_first_version_given_up_by_engine_raises_conflict(parts):
    show_active_times(parts)
    parts.engine.gives_up(1, "its picture is not finite", instead=None)
    with pytest.raises(Conflict):
        show_active_times(parts)


def test_first_version_given_up_is_not_shown_again_by_the_same_engine(parts):
    show_active_times(parts)
    parts.engine.gives_up(1, "it took 399 ms", instead=None)
    follow_times(parts, 5)
    assert len(parts.engine.asked) == 1
    assert "wall/1 was given up (it took 399 ms)" in parts.stream.model_fault
    parts.registry.current = 2
    follow_times(parts, 2)
    assert parts.engine.asked[-1][1] == "/models/wall/2" and parts.stream.model_fault is None
    parts.registry.current = 1
    follow_times(parts, 2)
    assert parts.engine.asked[-1][1] == "/models/wall/1", "it was activated again"
    parts.engine.gives_up(1, "it took 398 ms", instead=None)
    follow_times(parts, 3)
    assert len(parts.engine.asked) == 3
    parts.engine.figures = {"model": None, "gave_way": []}
    follow_times(parts, 2)
    assert len(parts.engine.asked) == 4, "a new engine tries it"


def test_show_active_does_not_repeat_refused_command(parts):
    parts.engine.refuses = True
    with pytest.raises(CommandRefused):
        show_active_times(parts)

    async def look_twice():
        with pytest.raises(CommandRefused):
            await parts.models.show_active(parts.stream)
        await parts.models.show_active(parts.stream)

    parts.models._refused.clear()
    asyncio.run(look_twice())
    assert len(parts.engine.asked) == 2


def follow_times(parts, times):
    async def follow():
        for _ in range(times):
            await parts.models.follow(parts.stream)

    asyncio.run(follow())


def test_model_fault_is_kept_and_logged_once(parts, caplog):
    parts.registry.active = lambda name: (_ for _ in ()).throw(NotFound(f"there is no model {name!r}"))
    follow_times(parts, 5)
    assert parts.stream.model_fault == "there is no model 'wall'"
    assert caplog.text.count("there is no model 'wall'") == 1
    del parts.registry.active
    parts.registry.current = None
    follow_times(parts, 1)
    assert parts.stream.model_fault == "no version of 'wall' is active; activate one"
    parts.registry.current = 1
    follow_times(parts, 2)
    assert parts.stream.model_fault is None


def test_stream_view_reason_contains_model_fault(tmp_path):
    settings = StreamSettings(source="synthetic:", device="cpu", show="model wall")
    stream = Stream(settings, specs_of("theatre", settings), RuntimeFolder(tmp_path))
    states = {"capture": process("live"), "engine": process("running", "live")}
    stream.processes = {role: SimpleNamespace(state=state) for role, state in states.items()}
    stream.model_fault = "there is no model 'wall'"
    view = stream.view()
    assert (view.state, view.reason) == ("live", "the model wall is not shown: there is no model 'wall'")
    stream.model_fault = None
    assert stream.view().reason is None
