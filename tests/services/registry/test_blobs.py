"""Blob stores: a folder, and an in-memory object store."""

from __future__ import annotations

import datetime
import errno
import hashlib
from pathlib import Path

import pytest

from services.errors import StoreUnavailable
from services.registry import folder
from services.registry.folder import FolderBlobs, RemoteBlobs, open_blobs


@pytest.fixture
def remote(request: pytest.FixtureRequest) -> RemoteBlobs:
    store = open_blobs(f"memory://{request.node.name}/blobs", Path("unused"))
    assert isinstance(store, RemoteBlobs)
    return store


def test_remote_blob_is_readable_until_removed(remote: RemoteBlobs, tmp_path: Path) -> None:
    (tmp_path / "staged").write_bytes(b"whole")
    assert remote.stored() == []
    remote.publish(tmp_path / "staged", "key")
    assert [(each.key, each.size) for each in remote.stored()] == [("key", 5)]
    with remote.local_file("key", tmp_path) as file:
        assert file.read_bytes() == b"whole" and file.name.endswith(".part")
    assert not file.exists(), "the fetched copy is removed"
    remote.remove("key")
    remote.remove("key")
    assert remote.stored() == []
    with pytest.raises(StoreUnavailable, match="restore it from a backup"), remote.local_file("key", tmp_path):
        pass


def test_remote_publish_raises_for_partial_upload(
    remote: RemoteBlobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "staged").write_bytes(b"whole")
    monkeypatch.setattr(remote._files, "info", lambda path: {"size": 4})
    with pytest.raises(StoreUnavailable, match="has 4 of 5 bytes of key; upload it again"):
        remote.publish(tmp_path / "staged", "key")


def test_remote_blob_is_abandoned_after_one_hour(monkeypatch: pytest.MonkeyPatch) -> None:
    moment = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    store = RemoteBlobs("memory://ages/blobs", {})
    described = [
        {"name": f"ages/blobs/{name}", "size": "3", "type": kind, **times}
        for name, kind, times in (
            ("new", "file", {"LastModified": moment - datetime.timedelta(seconds=3599)}),
            ("border", "file", {"LastModified": moment - datetime.timedelta(seconds=3600)}),
            ("old", "file", {"created": moment - datetime.timedelta(seconds=3601)}),
            ("seconds", "file", {"created": moment.timestamp() - 3601}),
            ("unknown", "file", {}),
            ("folder", "directory", {}),
        )
    ]
    monkeypatch.setattr(store._files, "ls", lambda path, detail: described)
    monkeypatch.setattr(folder.time, "time", moment.timestamp)
    assert {each.key: each.abandoned for each in store.stored()} == {
        "new": False, "border": False, "old": True, "seconds": True, "unknown": False,
    }  # fmt: skip
    assert {each.size for each in store.stored()} == {3}


def test_folder_blobs_are_stored_read_only(tmp_path: Path) -> None:
    store = open_blobs(None, tmp_path / "blobs")
    assert isinstance(store, FolderBlobs)
    assert store.folder.stat().st_mode & 0o777 == 0o700
    (tmp_path / "staged").write_bytes(b"whole")
    store.publish(tmp_path / "staged", "key")
    assert not (tmp_path / "staged").exists()
    assert (store.folder / "key").stat().st_mode & 0o777 == 0o400
    assert [(each.key, each.size, each.abandoned) for each in store.stored()] == [("key", 5, True)]
    store.remove("key")
    store.remove("key")
    assert store.stored() == []


class _Botocore(Exception):
    __module__ = "botocore.exceptions"


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file", "a.blob"), "has no a.blob; restore it"),
        (PermissionError(errno.EACCES, "Permission denied"), "cannot be used: Permission denied; check its space"),
        (_Botocore("no answer"), "does not answer: no answer; check its address"),
    ],
)
def test_store_errors_raise_store_unavailable_with_cause(error: Exception, why: str) -> None:
    with pytest.raises(StoreUnavailable, match=why), folder._store_errors("s3://x"):
        raise error


def test_store_errors_passes_other_exceptions_and_bad_url_is_refused() -> None:
    with pytest.raises(KeyError), folder._store_errors("s3://x"):
        raise KeyError("bug")
    with pytest.raises(StoreUnavailable, match="give s3://BUCKET/PREFIX"):
        open_blobs("nonsense://x", Path("unused"))


@pytest.mark.parametrize(
    ("change", "is_intact"),
    [
        ("none", True), ("linked folder", False), ("no folder", False), ("file", False), ("changed", False), ("missing", False),
        ("linked file", False), ("folder for a file", False),
    ],
)  # fmt: skip
def test_is_intact_only_for_regular_files_with_uploaded_digests(tmp_path, change, is_intact):
    """Links are refused because their targets may change."""
    model = tmp_path / "model"
    model.mkdir()
    row = {}
    for name, column in ((folder.MANIFEST, "manifest_sha256"), (folder.TENSORS, "tensors_sha256")):
        (model / name).write_bytes(name.encode())
        row[column] = hashlib.sha256(name.encode()).hexdigest()
    tensors, asked = model / folder.TENSORS, model
    if change == "linked folder":
        asked = tmp_path / "link"
        asked.symlink_to(model)
    elif change in ("no folder", "file"):
        asked = tmp_path / "other"
        if change == "file":
            asked.write_bytes(b"")
    elif change == "changed":
        tensors.write_bytes(b"changed")
    elif change != "none":
        tensors.rename(tmp_path / "tensors")
        if change == "linked file":
            tensors.symlink_to(tmp_path / "tensors")
        if change == "folder for a file":
            tensors.mkdir()
    assert folder._is_intact(asked, row) == is_intact
