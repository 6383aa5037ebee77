"""Stored snapshots: the newest of each stream, complete or absent."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from services.errors import CommandRefused, Conflict, NoSnapshot
from services.exports.snapshots import Snapshot, SnapshotStore, StreamSnapshots, described

SAID = {"seq": 7, "model_version": 3, "gaussians": 12, "time_window_s": [1.0, 2.0], "pause_ms": 0.4, "more": 1}


def take_snapshot(store: SnapshotStore, stream: str = "a", number: int = 0) -> Snapshot:
    with store.new() as new:
        folder = new / "model"
        folder.mkdir()
        (folder / "manifest.json").write_text(f"{{{number}}}")
        (folder / "model.safetensors").write_bytes(bytes(90))
        made = described(folder, stream, "somebody", SAID)
        store.keep(folder, made)
    return made


def test_snapshot_is_stored_with_its_description(tmp_path):
    store = SnapshotStore(tmp_path)
    made = take_snapshot(store)
    assert store.get("a", made.id) == made and store.all("a") == [made]
    assert (made.seq, made.gaussians, made.size_bytes, made.taken_by) == (7, 12, 93, "somebody")
    names = {path.name for path in store.folder_of("a", made.id).iterdir()}
    assert names == {"manifest.json", "model.safetensors", "snapshot.json"}
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert SnapshotStore(tmp_path).get("a", made.id) == made


def test_store_keeps_newest_snapshots_of_each_stream(tmp_path):
    store = SnapshotStore(tmp_path, most=3)
    made = [take_snapshot(store, number=number) for number in range(5)]
    other = take_snapshot(store, "b")
    assert {each.id for each in store.all("a")} <= {each.id for each in made}
    assert len(store.all("a")) == 3 and store.all("b") == [other]
    assert len({each.digest for each in made}) == 5


def test_snapshot_store_raises_for_unknown_or_invalid_id(tmp_path):
    store = SnapshotStore(tmp_path)
    made = take_snapshot(store)
    store.delete("a", made.id)
    assert store.all("a") == store.all("nobody") == []
    for number in (made.id, "..", "../a", "x" * 16, ""):
        for ask in (store.get, store.folder_of, store.delete):
            with pytest.raises(NoSnapshot, match="no such snapshot"):
                ask("a", number)


def test_failed_snapshot_leaves_no_files(tmp_path):
    store = SnapshotStore(tmp_path)
    with pytest.raises(RuntimeError), store.new() as new:
        (new / "model").mkdir()
        raise RuntimeError("the engine died")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".new-1").mkdir()
    SnapshotStore(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damaged", ["", '{"id": ', "[]", "null", '{"id": "1"}', "\xff"])
def test_damaged_snapshot_record_hides_only_its_snapshot(tmp_path, damaged):
    store = SnapshotStore(tmp_path)
    lost, kept = take_snapshot(store), take_snapshot(store, number=1)
    (store.folder_of("a", lost.id) / "snapshot.json").write_bytes(damaged.encode("latin-1"))
    assert store.all("a") == [kept]
    with pytest.raises(NoSnapshot):
        store.get("a", lost.id)
    assert take_snapshot(store, number=2) in store.all("a")
    store.delete("a", lost.id)
    assert not (tmp_path / "a" / lost.id).exists()


def test_keep_succeeds_if_oldest_snapshot_is_deleted_concurrently(tmp_path, monkeypatch):
    store = SnapshotStore(tmp_path, most=1)
    oldest = take_snapshot(store)
    listed = store.all

    def deleted_after_the_list(stream: str) -> list[Snapshot]:
        found = listed(stream)
        SnapshotStore.delete(store, stream, oldest.id)
        return found

    monkeypatch.setattr(store, "all", deleted_after_the_list)
    newest = take_snapshot(store, number=1)
    assert listed("a") == [newest]


def test_snapshot_refusal_omits_server_path(tmp_path):
    async def refuse(*_: object, folder: str, **__: object) -> None:
        raise CommandRefused(f"cannot write the model to {folder}: No space left on device; free space")

    streams = SimpleNamespace(engine=lambda stream: SimpleNamespace(command=refuse))
    snapshots = StreamSnapshots(cast(Any, streams), cast(Any, None), SnapshotStore(tmp_path))
    with pytest.raises(Conflict, match="No space left") as caught:
        asyncio.run(snapshots.take("a", None, "somebody"))
    assert str(tmp_path) not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
