"""Recording store: upload, check, deletion, expiry by age and size, recovery after a crash."""

from __future__ import annotations

import sys
import zipfile
from datetime import timedelta

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from gsplat_core.io.recordings import open_recording
from services.errors import CheckFailed, Conflict, NotFound, Rejected
from services.recordings.store import METADATA, RECORDINGS, State
from services.registry.records import now

VERDICT = """
import json, pathlib, sys
folder, name = sys.argv[1], sys.argv[5]
pathlib.Path(folder, name).write_bytes(bytes(1000))
print(json.dumps({"stage": "ready", "frames": 3}))
"""
QUICK = (sys.executable, "-c", VERDICT)
"""A check that looks at nothing."""


def path_of(store, name):
    with store._database.reading() as connection:
        return store.path_of(connection, name)


def test_recording_migrations_create_table_of_metadata(new_store, database_url):
    store = new_store(database_url=database_url)
    options = {"version_table": "alembic_version_recordings"}
    with store._database.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection, opts=options), METADATA) == []


@pytest.mark.parametrize("top", ["", "case/", "a folder/"])
def test_checked_archive_becomes_ready_recording(new_store, add, packed, recording, top):
    store = new_store()
    record, is_new = add(store, "case-1", packed(top))
    assert is_new and record.state is State.UPLOADED and record.kind == "archive"
    with pytest.raises(Conflict, match="uploaded, not ready"):
        path_of(store, "case-1")
    record = store.check("case-1")
    assert record.state is State.READY and record.reason is None
    assert record.description["frames"] == 3 and record.description["layout"] == "endonerf"
    path = path_of(store, "case-1")
    assert open_recording(path).digest == open_recording(recording).digest
    assert path.name == "case-1" and record.kept_bytes >= sum(p.stat().st_size for p in path.rglob("*.png"))
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["case-1"]


def test_checked_video_is_stored_unchanged(new_store, add, video_file):
    store = new_store()
    content = video_file.read_bytes()
    add(store, "clip", video_file)
    record = store.check("clip")
    assert (record.state, record.kind, record.description["layout"]) == (State.READY, "video", "video")
    assert path_of(store, "clip").read_bytes() == content and path_of(store, "clip").name == "clip.mp4"


@pytest.fixture
def video_file(tmp_path):
    """A video of two frames."""
    import av
    import numpy as np

    with av.open(str(tmp_path / "v.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width = stream.height = 32
        for value in (50, 200):
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), value, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return tmp_path / "v.mp4"


def test_unreadable_recording_is_rejected_with_reason_and_not_kept(new_store, add, packed, tmp_path):
    store = new_store()
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("images/000000.png", b"no picture")
    add(store, "broken", tmp_path / "x.zip")
    record = store.check("broken")
    assert record.state is State.REJECTED and "images/000000.png" in record.reason
    assert str(tmp_path) not in record.reason and list((tmp_path / "store").iterdir()) == []
    assert store.check("broken") == record
    store.delete("broken")
    with pytest.raises(NotFound):
        store.get("broken")


@pytest.mark.parametrize("content", [b"", b"\x80\x04pickle", b"#EXTM3U\nfile:///etc/passwd", b"PK"])
def test_add_rejects_file_that_is_neither_video_nor_archive(new_store, add, tmp_path, content):
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(Rejected, match="neither a video"):
        add(new_store(), "x", tmp_path / "x")
    assert list((tmp_path / "store").iterdir()) == []


def test_add_accepts_same_file_again_and_refuses_other_file(new_store, add, packed, tmp_path):
    store = new_store(check_program=QUICK)
    first, _ = add(store, "case", packed())
    again, is_new = add(store, "case", packed())
    assert not is_new and again == first and len(list((tmp_path / "store").iterdir())) == 1
    with pytest.raises(Conflict, match="another recording case"):
        add(store, "case", packed("other/"))


def test_recording_in_use_is_not_deleted_or_expired(new_store, add, packed):
    used = {"b"}
    store = new_store(check_program=QUICK, in_use=lambda connection, name: name in used)
    for name in "abc":
        add(store, name, packed(name=name))
        store.check(name)
    with pytest.raises(Conflict, match="has not ended uses"):
        store.delete("b")
    assert [each.name for each in store.expire(None, 1)] == ["a", "c"]
    used.clear()
    assert [(each.name, "take more than 1 bytes" in each.why) for each in store.expire(None, 1)] == [("b", True)]


def test_expire_removes_oldest_recordings_until_within_limits(new_store, add, packed):
    store = new_store(check_program=QUICK)
    for age, name in enumerate("cba"):
        add(store, name, packed(name=name))
        store.check(name)
        with store._database.writing() as connection:
            values = {"uploaded_at": (now() - timedelta(days=age)).isoformat(), "kept_bytes": 100}
            connection.execute(sa.update(RECORDINGS).where(RECORDINGS.c.name == name).values(values))
    assert store.expire(None, None) == [] and store.expire(10 * 86400, 300) == []
    assert [(each.name, each.why) for each in store.expire(1.5 * 86400, None)] == [("a", "it is older than 1.5 days")]
    assert [each.name for each in store.expire(None, 150)] == ["b"]
    assert [record.name for record in store.all()] == ["c"]


def test_unchecked_recording_is_not_expired(new_store, add, packed):
    store = new_store()
    add(store, "case", packed())
    assert store.expire(0.0, 1) == []


def test_recover_removes_leftovers_and_returns_unchecked_recordings(new_store, add, packed, tmp_path):
    store = new_store(check_program=QUICK)
    add(store, "ready", packed(name="1"))
    store.check("ready")
    add(store, "waits", packed(name="2"))
    (tmp_path / "store" / "half-0123").mkdir()
    (tmp_path / "store" / "half-0123" / "upload").write_bytes(b"x")
    assert new_store(check_program=QUICK).recover() == ["waits"]
    assert sorted(path.name.split("-")[0] for path in (tmp_path / "store").iterdir()) == ["ready", "waits"]


def test_recording_stays_uploaded_if_check_program_fails(new_store, add, packed):
    store = new_store(check_program=(sys.executable, "-c", "raise SystemExit(3)"))
    add(store, "case", packed())
    with pytest.raises(CheckFailed, match="code 3"):
        store.check("case")
    assert store.get("case").state is State.UPLOADED
    assert new_store().check("case").state is State.READY


@pytest.mark.slow
def test_check_over_cpu_limit_rejects_recording(new_store, add, packed):
    store = new_store(check_program=(sys.executable, "-c", BURNS))
    add(store, "case", packed())
    record = store.check("case")
    assert record.state is State.REJECTED and "SIGXCPU" in record.reason


BURNS = "import resource\nresource.setrlimit(resource.RLIMIT_CPU, (1, 2))\nwhile True: pass"
