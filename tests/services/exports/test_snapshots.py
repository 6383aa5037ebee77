"""Snapshots that are kept: the newest of each stream, whole or not there."""

from __future__ import annotations

import pytest

from services.errors import NoSnapshot
from services.exports.snapshots import Snapshot, SnapshotStore, described

SAID = {"seq": 7, "model_version": 3, "gaussians": 12, "time_window_s": [1.0, 2.0], "pause_ms": 0.4, "more": 1}


def taken(store: SnapshotStore, stream: str = "a", number: int = 0) -> Snapshot:
    with store.new() as new:
        folder = new / "model"
        folder.mkdir()
        (folder / "manifest.json").write_text(f"{{{number}}}")
        (folder / "model.safetensors").write_bytes(bytes(90))
        made = described(folder, stream, "somebody", SAID)
        store.keep(folder, made)
    return made


def test_a_snapshot_is_what_was_said_of_it(tmp_path):
    store = SnapshotStore(tmp_path)
    made = taken(store)
    assert store.get("a", made.id) == made and store.all("a") == [made]
    assert (made.seq, made.gaussians, made.size_bytes, made.taken_by) == (7, 12, 93, "somebody")
    names = {path.name for path in store.folder_of("a", made.id).iterdir()}
    assert names == {"manifest.json", "model.safetensors", "snapshot.json"}
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert SnapshotStore(tmp_path).get("a", made.id) == made


def test_the_newest_stay(tmp_path):
    store = SnapshotStore(tmp_path, most=3)
    made = [taken(store, number=number) for number in range(5)]
    other = taken(store, "b")
    assert {each.id for each in store.all("a")} <= {each.id for each in made}
    assert len(store.all("a")) == 3 and store.all("b") == [other]
    assert len({each.digest for each in made}) == 5


def test_what_is_not_there_is_said(tmp_path):
    store = SnapshotStore(tmp_path)
    made = taken(store)
    store.delete("a", made.id)
    assert store.all("a") == store.all("nobody") == []
    for number in (made.id, "..", "../a", "x" * 16, ""):
        for ask in (store.get, store.folder_of, store.delete):
            with pytest.raises(NoSnapshot, match="no such snapshot"):
                ask("a", number)


def test_what_fails_leaves_nothing(tmp_path):
    store = SnapshotStore(tmp_path)
    with pytest.raises(RuntimeError), store.new() as new:
        (new / "model").mkdir()
        raise RuntimeError("the engine died")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".new-1").mkdir()
    SnapshotStore(tmp_path)
    assert list(tmp_path.iterdir()) == []
