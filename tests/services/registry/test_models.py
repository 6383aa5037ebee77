"""Model versions on SQLite and PostgreSQL: upload, check, activation, rollback, deletion."""

import errno
import os
import shutil

import pytest

from gsplat_core.io.bundle import load_bundle
from services.errors import BlobDamaged, Conflict, NotFound, Rejected, StillActive, StoreUnavailable
from services.registry.models import ModelRegistry
from tests.services.registry.made import add_ready, assert_whole, packed_model, sha256
from tests.services.registry.stub_check import ALWAYS_READY, says


def test_version_is_uploaded_checked_and_activated(registry, files):
    file = packed_model(files)
    record = registry.upload("liver", file, sha256(file).upper(), "surgeon")
    assert (record.name, record.version, record.state, record.reason) == ("liver", 1, "uploaded", None)
    assert (record.digest, record.size_bytes, record.uploaded_by) == (sha256(file), file.stat().st_size, "surgeon")
    assert file.exists() and registry.active("liver") is None

    ready = registry.check("liver", 1)
    assert (ready.state, ready.description) == ("ready", {"gaussians": 5, "render_ms": 1.0})
    assert ready.changed_at >= ready.uploaded_at == record.uploaded_at

    change = registry.activate("liver", 1, None, "admin")
    assert change.entry() == {
        "action": "model.activate",
        "model": "liver",
        "version": 1,
        "state": "active",
        "object_digest": f"sha-256:{sha256(file)}",
        "by": "admin",
        "at": change.at.isoformat(),
        "active_before": None,
        "active_after": 1,
        "why": None,
    }
    assert registry.active("liver") == registry.version("liver", 1)
    assert vars(registry.version("liver", 1)).items() <= vars(change).items()
    assert load_bundle(registry.folder_of("liver", 1)).sha256() == load_bundle(files / "model-0").sha256()
    assert_whole(registry)


def test_reopened_registry_keeps_versions_and_models(new_registry, files):
    with new_registry() as registry:
        registry.activate("liver", add_ready(registry, files), None, "admin")
        before = registry.versions("liver"), registry.models()
    with new_registry() as registry:
        assert (registry.versions("liver"), registry.models()) == before
        assert_whole(registry)


def test_version_numbers_increase_and_are_not_reused(registry, files):
    assert [add_ready(registry, files, seed) for seed in (0, 1)] == [1, 2]
    registry.delete("liver", 2, "admin")
    assert add_ready(registry, files, 1) == 3
    assert registry.upload("spleen", packed_model(files), None, "surgeon").version == 1
    assert [(model.name, model.last_version, model.active) for model in registry.models()] == [
        ("liver", 3, None),
        ("spleen", 1, None),
    ]
    assert_whole(registry)


def test_activate_raises_conflict_unless_expected_version_is_active(registry, files):
    first, second = add_ready(registry, files, 0), add_ready(registry, files, 1)
    registry.activate("liver", first, None, "admin")
    with pytest.raises(Conflict, match="has version 1 active, not no version as expected"):
        registry.activate("liver", second, None, "admin")
    with pytest.raises(Conflict, match="version 1 of model 'liver' is active"):
        registry.activate("liver", first, first, "admin")
    change = registry.activate("liver", second, first, "admin")
    assert (change.active_before, change.active_after) == (first, second)
    assert [version.state for version in registry.versions("liver")] == ["retired", "active"]


def test_activate_raises_for_unchecked_or_rejected_version(new_registry, files):
    registry = new_registry(check_program=says("""print('{"stage": "rejected", "reason": "it is blue"}')"""))
    version = registry.upload("liver", packed_model(files), None, "surgeon").version
    with pytest.raises(Conflict, match="is uploaded; only one that is ready or retired"):
        registry.activate("liver", version, None, "admin")
    rejected = registry.check("liver", version)
    assert (rejected.state, rejected.reason) == ("rejected", "it is blue")
    with pytest.raises(Conflict, match=r"is rejected \(it is blue\)"):
        registry.activate("liver", version, None, "admin")
    assert registry.check("liver", version) == rejected


def test_rollback_reactivates_earlier_versions_in_order(registry, files):
    for seed in range(3):
        version = add_ready(registry, files, seed)
        registry.activate("liver", version, version - 1 or None, "admin")
    change = registry.rollback("liver", "engine", expected_current=3, reason="a picture held NaN")
    assert (change.action, change.active_before, change.active_after) == ("rollback", 3, 2)
    assert change.entry()["why"] == registry.version("liver", 3).reason == "a picture held NaN"
    with pytest.raises(Conflict, match="has version 2 active, not version 3"):
        registry.rollback("liver", "engine", expected_current=3)
    assert registry.rollback("liver", "admin").active_after == 1
    with pytest.raises(Conflict, match="no version that was active before 1"):
        registry.rollback("liver", "admin")
    assert [version.state for version in registry.versions("liver")] == ["active", "retired", "retired"]
    registry.activate("liver", 3, 1, "admin")
    assert registry.version("liver", 3).reason is None
    assert registry.rollback("liver", "admin").active_after == 1
    assert_whole(registry)


def test_rollback_skips_deleted_versions(registry, files):
    for seed in range(2):
        add_ready(registry, files, seed)
    for version, expected in ((1, None), (2, 1), (1, 2), (2, 1)):
        registry.activate("liver", version, expected, "admin")
    registry.delete("liver", 1, "admin")
    with pytest.raises(Conflict, match="no version that was active before 2"):
        registry.rollback("liver", "admin")


def test_rollback_raises_before_first_activation(registry, files):
    add_ready(registry, files)
    with pytest.raises(Conflict, match="no version that was active before any"):
        registry.rollback("liver", "admin")


def test_delete_removes_unshared_files_and_refuses_active_version(registry, files, tmp_path):
    first, second = add_ready(registry, files, 0), add_ready(registry, files, 1)
    same = add_ready(registry, files, 1)
    registry.activate("liver", first, None, "admin")
    with pytest.raises(StillActive, match="version 1 of model 'liver' is active"):
        registry.delete("liver", first, "admin")
    folder = registry.folder_of("liver", second)
    assert folder == registry.folder_of("liver", same)
    made = folder.stat().st_ino
    change = registry.delete("liver", second, "admin")
    assert (change.version, change.active_after) == (second, first)
    # Looked at before `folder_of` is asked, which would make it again: who shows version 3 has it open.
    assert folder.is_dir() and folder.stat().st_ino == made
    assert folder == registry.folder_of("liver", same)
    registry.delete("liver", same, "admin")
    assert not folder.exists() and len(list((tmp_path / "registry" / "blobs").iterdir())) == 1
    with pytest.raises(NotFound, match="'liver' has no version 2"):
        registry.version("liver", second)
    assert_whole(registry)


@pytest.mark.parametrize(
    "call",
    [
        lambda registry: registry.versions("x"),
        lambda registry: registry.version("x", 1),
        lambda registry: registry.active("x"),
        lambda registry: registry.folder_of("x", 1),
        lambda registry: registry.check("x", 1),
        lambda registry: registry.activate("x", 1, None, "a"),
        lambda registry: registry.rollback("x", "a"),
        lambda registry: registry.delete("x", 1, "a"),
    ],
)
def test_registry_calls_raise_not_found_for_unknown_model(sqlite_registry, call):
    with pytest.raises(NotFound, match="there is no model 'x'"):
        call(sqlite_registry)


def test_upload_with_wrong_digest_is_rejected_and_not_kept(sqlite_registry, files, tmp_path):
    with pytest.raises(Rejected, match=r"its sender said 0000.*; upload it again"):
        sqlite_registry.upload("liver", packed_model(files), 64 * "0", "surgeon")
    assert sqlite_registry.models() == []
    assert [list((tmp_path / "registry" / folder).iterdir()) for folder in ("incoming", "blobs")] == [[], []]


def test_upload_over_size_limit_is_rejected(tmp_path, files):
    file = packed_model(files)
    with ModelRegistry(tmp_path, most_upload_bytes=file.stat().st_size - 1) as registry:
        with pytest.raises(Rejected, match="more than"):
            registry.upload("liver", file, None, "surgeon")
        assert not list((tmp_path / "incoming").iterdir())


@pytest.mark.parametrize("name", ["", "Liver", "../liver", "a/b", "-a", "a.", 65 * "a", "lé", "a\n", "a\0"])
def test_upload_rejects_invalid_model_names(sqlite_registry, files, name):
    with pytest.raises(Rejected, match="cannot be the name of a model"):
        sqlite_registry.upload(name, packed_model(files), None, "surgeon")


@pytest.mark.parametrize("by", ["", 201 * "a", "a\nb"])
def test_upload_rejects_invalid_user_names(sqlite_registry, files, by):
    with pytest.raises(Rejected, match="`by` must be"):
        sqlite_registry.upload("liver", packed_model(files), None, by)


def test_changed_unpacked_copy_is_unpacked_again(sqlite_registry, files, caplog):
    version = add_ready(sqlite_registry, files)
    folder = sqlite_registry.folder_of("liver", version)
    tensors = folder / "model.safetensors"
    tensors.chmod(0o644)
    tensors.write_bytes(b"something else")
    assert sqlite_registry.folder_of("liver", version) == folder
    assert load_bundle(folder).sha256() == load_bundle(files / "model-0").sha256()
    assert "was changed; it is made again" in caplog.text


@pytest.mark.parametrize("damage", ["gone", "changed", "cut"])
def test_damaged_blob_is_not_activated_and_listed_by_recover(sqlite_registry, files, tmp_path, damage):
    versions = [add_ready(sqlite_registry, files, seed) for seed in (0, 1)]
    sqlite_registry.activate("liver", versions[1], None, "admin")
    shutil.rmtree(tmp_path / "registry" / "unpacked")
    (tmp_path / "registry" / "unpacked").mkdir()
    (blob,) = [
        path
        for path in (tmp_path / "registry" / "blobs").iterdir()
        if path.name.startswith(sha256(packed_model(files)))
    ]
    payload = blob.read_bytes()
    blob.unlink()
    if damage != "gone":
        blob.write_bytes(payload[:-600] if damage == "cut" else payload.replace(b"basis", b"basil"))
    with pytest.raises(BlobDamaged, match="the stored file of version 1 of model 'liver'"):
        sqlite_registry.activate("liver", versions[0], versions[1], "admin")
    assert sqlite_registry.active("liver").version == versions[1]
    found = sqlite_registry.recover()
    assert [each[:2] for each in found.damaged] == ([] if damage == "changed" else [("liver", 1)])
    assert sqlite_registry.version("liver", 1).state == "ready"


def test_rollback_raises_if_blob_of_earlier_version_is_missing(sqlite_registry, files, tmp_path):
    for version in (add_ready(sqlite_registry, files, 0), add_ready(sqlite_registry, files, 1)):
        sqlite_registry.activate("liver", version, version - 1 or None, "admin")
    shutil.rmtree(sqlite_registry.folder_of("liver", 1))
    for blob in (tmp_path / "registry" / "blobs").glob(f"{sha256(packed_model(files))}*"):
        blob.unlink()
    with pytest.raises(BlobDamaged):
        sqlite_registry.rollback("liver", "admin")
    assert sqlite_registry.active("liver").version == 2
    assert [version.state for version in sqlite_registry.versions("liver")] == ["retired", "active"]


def test_upload_raises_for_missing_file(sqlite_registry, tmp_path):
    with pytest.raises(StoreUnavailable, match=r"nothing\.isplat is missing"):
        sqlite_registry.upload("liver", tmp_path / "nothing.isplat", None, "surgeon")


def test_upload_on_full_disk_raises_and_keeps_nothing(sqlite_registry, files, tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreUnavailable, match="the upload cannot be kept: No space left on device; free space"):
        sqlite_registry.upload("liver", packed_model(files), None, "surgeon")
    monkeypatch.undo()
    assert sqlite_registry.models() == [] and not list((tmp_path / "registry" / "incoming").iterdir())


def test_recover_removes_leftovers_and_keeps_foreign_files(tmp_path, files):
    root = tmp_path / "registry"
    with ModelRegistry(root, check_program=ALWAYS_READY) as registry:
        add_ready(registry, files)
        registry.upload("liver", packed_model(files, 1), None, "surgeon")
        (root / "incoming" / "half.part").write_bytes(b"half")
        (root / "unpacked" / "half.part").mkdir()
        orphan = f"{64 * 'a'}-{16 * 'b'}.isplat"
        for name in (orphan, "notes.txt"):
            (root / "blobs" / name).write_bytes(b"x")
        found = registry.recover()
        assert found.removed == (
            "half-written upload half.part",
            f"upload {orphan} that no version names",
            "unpacked copy half.part",
        )
        assert (found.unchecked, found.damaged, found.skipped) == ((("liver", 2),), (), None)
        assert (root / "blobs" / "notes.txt").exists()
        assert registry.check("liver", 2).state == "ready"
        assert_whole(registry)


def test_recover_skips_removal_while_lock_is_held(sqlite_registry, tmp_path):
    (tmp_path / "registry" / "incoming" / "half.part").write_bytes(b"half")
    with sqlite_registry._lock.shared():
        found = sqlite_registry.recover(wait_s=0)
    assert found.removed == () and "another process is writing" in found.skipped
    assert sqlite_registry.recover().removed == ("half-written upload half.part",)
