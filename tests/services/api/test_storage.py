"""A full disk: refused changes, /readyz, metrics, and recovery once there is space."""

from __future__ import annotations

import asyncio
import base64
import errno
import hashlib
import os
import shutil
from collections import namedtuple

import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from services.api import Parts, new_app, state
from services.audit import AuditLog, verify
from services.audit.log import AUDIT_FILE
from services.settings import ServiceSettings

Usage = namedtuple("Usage", "total used free")
WANTED = {"name": "room", "source": "synthetic:", "start": False}


@pytest.fixture
def full_disk(monkeypatch):
    """Return a function that simulates a full disk under the head of the audit log, or frees it."""
    real = os.replace

    def refuse(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(source))

    def set_full(full):
        monkeypatch.setattr(os, "replace", refuse if full else real)

    return set_full


def test_changes_return_503_while_audit_log_is_unwritable(plane, full_disk):
    before = plane.events()
    full_disk(True)
    answer = plane.ask("POST", "/v1/streams", json=WANTED)
    assert answer.status_code == 503 and "No space left on device" in answer.json()["detail"]
    assert "was carried out, but its audit entry could not be written" in answer.json()["detail"]
    ready = plane.client.get("/readyz?verbose")
    assert (ready.status_code, ready.json()["status"]) == (503, "not ready")
    assert "No space left on device" in ready.json()["checks"]["audit"]["detail"]
    assert "intrasplat_audit_writable 0.0" in plane.ask("GET", "/metrics").text
    assert plane.client.get("/livez").status_code == 200
    full_disk(False)
    assert plane.client.get("/readyz").json() == {"status": "ready"}
    assert "intrasplat_audit_writable 1.0" in plane.ask("GET", "/metrics").text
    assert plane.ask("DELETE", "/v1/streams/room").status_code == 204
    assert plane.events() == [*before, ("audit.writable", "audit", "done"), ("stream.delete", "room", "done")]
    assert verify(plane.control.settings.data_dir / AUDIT_FILE).intact


def test_shutdown_with_full_disk_logs_warning_and_closes_audit_log(tmp_path, full_disk, caplog):
    app = new_app(ServiceSettings(paths={"data": tmp_path}), Parts())
    with TestClient(app):
        full_disk(True)
    full_disk(False)
    assert "the end of the service is not in the audit log" in caplog.text
    AuditLog(tmp_path / AUDIT_FILE).close()  # it was closed: nothing else holds it
    assert verify(tmp_path / AUDIT_FILE).intact


@pytest.mark.parametrize(
    ("free", "status"), [(state.SPARE_BYTES, "ready"), (state.SPARE_BYTES - 1, "degraded"), (0, "degraded")]
)
def test_disk_check_is_degraded_below_spare_bytes(plane, monkeypatch, free, status):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: Usage(10 * state.SPARE_BYTES, 0, free))
    ready = plane.client.get("/readyz?verbose").json()
    assert ready["status"] == status and f"data: {free // 2**20} MiB free" in ready["checks"]["disk"]["detail"]
    families = text_string_to_metric_families(plane.ask("GET", "/metrics").text)
    samples = {family.name: family.samples for family in families}
    for name, value in (("intrasplat_disk_free_bytes", free), ("intrasplat_disk_bytes", 10 * state.SPARE_BYTES)):
        assert {sample.labels["folder"]: sample.value for sample in samples[name]} == {
            folder: value for folder in ("data", "recordings", "replays")
        }


def test_disk_check_is_degraded_if_any_folder_is_full_or_unreadable(tmp_path, monkeypatch):
    """Independent of the order of the folders."""
    audit = AuditLog(tmp_path / AUDIT_FILE)
    audit.close()
    free = {tmp_path / "a": 5 * state.SPARE_BYTES, tmp_path / "b": 2**20, tmp_path / "c": 5 * state.SPARE_BYTES}
    for folder in free:
        folder.mkdir()

    def usage(folder):
        if folder in broken:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return Usage(10 * state.SPARE_BYTES, 0, free[folder])

    def disk(*names):
        check = asyncio.run(state.Storage({name: tmp_path / name for name in names}, audit).disk())
        return check.ok, check.detail

    monkeypatch.setattr(shutil, "disk_usage", usage)
    enough, broken = 5 * state.SPARE_BYTES // 2**20, set()
    assert disk("a", "c") == (True, f"a: {enough} MiB free; c: {enough} MiB free")
    for names in ("ab", "ba"):
        ok, detail = disk(*names)
        assert not ok and "b: 1 MiB free" in detail and detail.endswith("; free space on that disk")
    broken = {tmp_path / "c"}
    for names in ("ac", "ca"):
        ok, detail = disk(*names)
        assert not ok and f"c: {os.strerror(errno.EIO)}" in detail and f"a: {enough} MiB free" in detail


def test_disk_check_covers_configured_recordings_folder(new_plane, tmp_path, monkeypatch):
    asked = []

    def usage(folder):
        asked.append(folder)
        return Usage(10 * state.SPARE_BYTES, 0, 0 if folder == tmp_path / "elsewhere" else 5 * state.SPARE_BYTES)

    (tmp_path / "elsewhere").mkdir()
    plane = new_plane(uploaded_recordings={"folder": tmp_path / "elsewhere" / "not" / "made"})
    monkeypatch.setattr(shutil, "disk_usage", usage)
    ready = plane.client.get("/readyz?verbose").json()
    assert ready["status"] == "degraded" and "recordings: 0 MiB free" in ready["checks"]["disk"]["detail"]


@pytest.mark.parametrize(
    ("number", "status"),
    [(errno.ENOSPC, 507), (errno.EDQUOT, 507), (errno.EROFS, 503), (errno.EIO, 503), (errno.EMFILE, 503)],
)
@pytest.mark.parametrize("store", ["keys", "registry", "streams"])
def test_disk_errors_of_stores_return_507_or_503_without_traceback(plane, monkeypatch, caplog, store, number, status):
    """The response names the error of the disk."""

    def refuse(*_, **__):
        raise OSError(number, os.strerror(number), "/secret/path")

    if store == "keys":
        monkeypatch.setattr(plane.control.keys, "create", refuse)
        answer = plane.ask("POST", "/v1/keys", json={"name": "new", "role": "viewer"})
    elif store == "registry":
        monkeypatch.setattr(plane.parts.models, "rollback", refuse)
        answer = plane.ask("POST", "/v1/models/liver/rollback")
    else:
        monkeypatch.setattr(plane.parts.streams, "create", refuse)
        answer = plane.ask("POST", "/v1/streams", json={"name": "x", "source": "synthetic:"})
    assert answer.status_code == status and os.strerror(number) in answer.json()["detail"]
    assert ("free space" in answer.json()["detail"]) == (status == 507)
    assert "/secret" not in answer.text and "Traceback" not in caplog.text


@pytest.mark.parametrize("gone", ["missing", "a file"])
def test_upload_returns_503_if_uploads_folder_is_missing(plane, gone):
    folder = plane.control.uploads_dir
    folder.rmdir()
    if gone == "a file":
        folder.touch()
    digest = base64.b64encode(hashlib.sha256(b"GOOD").digest()).decode()
    headers = {"Content-Type": "application/octet-stream", "Content-Digest": f"sha-256=:{digest}:"}
    answer = plane.ask("PUT", "/v1/models/liver/versions", content=b"GOOD", headers=headers)
    assert answer.status_code == 503 and "a folder of the service is gone" in answer.json()["detail"]
    if gone == "a file":
        folder.unlink()
    folder.mkdir()
