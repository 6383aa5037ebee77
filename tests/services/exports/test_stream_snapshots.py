"""Snapshots stored or uploaded to the registry, and exports of versions and snapshots."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from gsplat_core.errors import InvalidSetting
from services.errors import CommandRefused, Conflict, Rejected
from services.exports import snapshots as parts
from services.exports.files import ALL, ExportWish
from services.exports.snapshots import ModelExports, StreamSnapshots
from services.registry.records import State


@pytest.fixture
def taking(tmp_path, monkeypatch):
    """Stream snapshots with fakes that record their calls in `calls`."""
    calls = []

    @contextmanager
    def new():
        yield tmp_path

    async def command(name, **arguments):
        calls.append((name, arguments))
        if refusal:
            raise CommandRefused(refusal[0])
        return "said"

    refusal: list[str] = []
    streams = SimpleNamespace(engine=lambda stream: SimpleNamespace(command=command))
    store = SimpleNamespace(
        new=new, keep=lambda *kept: calls.append(("keep", *kept)), delete=lambda *a: calls.append(a)
    )
    registry = SimpleNamespace(upload=lambda *given: calls.append(("upload", *given)) or "version")
    monkeypatch.setattr(parts, "described", lambda folder, stream, by, said: (folder, stream, by, said))
    monkeypatch.setattr(parts, "pack", lambda folder, file: calls.append(("pack", folder, file)))
    return SimpleNamespace(snapshots=StreamSnapshots(streams, registry, store), calls=calls, refusal=refusal)


def test_take_stores_snapshot_or_uploads_model_version(taking, tmp_path):
    folder = tmp_path / "model"
    taken = (folder, "a", "nurse", "said")
    assert asyncio.run(taking.snapshots.take("a", None, "nurse")) == (taken, None)
    name, arguments = taking.calls.pop(0)
    assert (name, arguments["folder"]) == ("snapshot", str(folder)) and arguments["timeout_s"] > 10
    assert taking.calls == [("keep", folder, taken)]
    del taking.calls[:]
    assert asyncio.run(taking.snapshots.take("a", "liver", "nurse")) == (taken, "version")
    packed = tmp_path / "model.isplat"
    assert taking.calls[1:] == [("pack", folder, packed), ("upload", "liver", packed, None, "nurse")]
    taking.snapshots.delete("a", "7")
    assert taking.calls[-1] == ("a", "7")


def test_take_raises_conflict_if_engine_refuses(taking):
    taking.refusal.append("nothing was learned yet")
    with pytest.raises(Conflict, match="nothing was learned yet"):
        asyncio.run(taking.snapshots.take("a", None, "nurse"))


@pytest.fixture
def exports():
    def get(digest, folder, wish):
        return digest, folder(), wish.time_s

    version = SimpleNamespace(state=State.READY, description={"time_window_s": [1.0, 2.0]}, digest="d")
    registry = SimpleNamespace(version=lambda name, number: version, folder_of=lambda *which: which)
    snapshot = SimpleNamespace(digest="s", time_window_s=(3.0, 4.0))
    store = SimpleNamespace(get=lambda *which: snapshot, folder_of=lambda *which: which)
    closed = []
    cache = SimpleNamespace(get=get, close=lambda: closed.append(True))
    made = ModelExports(registry, store, cache)
    made.version, made.closed = version, closed
    return made


def test_exports_reject_time_outside_time_window(exports):
    wish = lambda time_s: ExportWish(ALL["ply"], time_s, None)
    assert exports.of_version("liver", 2, wish(1.5)) == ("d", ("liver", 2), 1.5)
    assert exports.of_snapshot("a", "7", wish(3.5)) == ("s", ("a", "7"), 3.5)
    for ask in (lambda: exports.of_version("liver", 2, wish(3.5)), lambda: exports.of_snapshot("a", "7", wish(1.5))):
        with pytest.raises(Rejected) as error:
            ask()
        assert isinstance(error.value.__cause__, InvalidSetting)


@pytest.mark.parametrize("state", list(State))
def test_of_version_raises_conflict_unless_version_passed_check(exports, state):
    exports.version.state = state
    if state in (State.READY, State.ACTIVE, State.RETIRED):
        assert exports.of_version("liver", 2, ExportWish(ALL["ply"], 1.5, None))
    else:
        with pytest.raises(Conflict, match="only a version that passed its check"):
            exports.of_version("liver", 2, ExportWish(ALL["ply"], 1.5, None))


def test_running_closes_export_cache_at_exit(exports):
    async def run():
        async with exports.running():
            assert not exports.closed

    asyncio.run(run())
    assert exports.closed == [True]
