"""Recordings over the API: upload, list, deletion and their refusals."""

from __future__ import annotations

import base64
import hashlib
import time

import pytest

from services.api.problems import PROBLEM_JSON

CASE = "/v1/recordings/case-7"


def put(plane, body: bytes, role: str = "operator", path: str = CASE, **headers: str):
    digest = base64.b64encode(hashlib.sha256(body).digest()).decode()
    given = {"Content-Digest": f"sha-256=:{digest}:", "Content-Type": "application/octet-stream", **headers}
    return plane.ask("PUT", path, role, content=body, headers=given)


def settled(plane) -> dict:
    for _ in range(30_000):
        found = plane.ask("GET", CASE).json()
        if found["state"] != "uploaded":
            return found
        time.sleep(0.01)
    raise AssertionError("the check did not end")


def test_recording_upload_list_and_delete(plane):
    answer = put(plane, b"GOOD" * 500_000)
    assert (answer.status_code, answer.headers["location"]) == (201, CASE)
    assert answer.json()["digest"] == hashlib.sha256(b"GOOD" * 500_000).hexdigest()
    found = settled(plane)
    assert (found["state"], found["description"]["frames"], found["size_bytes"]) == ("ready", 3, 2_000_000)
    assert put(plane, b"GOOD" * 500_000).status_code == 200
    assert put(plane, b"GOOD other").status_code == 409
    assert [each["name"] for each in plane.ask("GET", "/v1/recordings", "viewer").json()] == ["case-7"]
    plane.parts.recordings.used.add("case-7")
    assert plane.ask("DELETE", CASE, "operator").status_code == 409
    plane.parts.recordings.used.clear()
    assert plane.ask("DELETE", CASE, "operator").status_code == 204
    assert plane.ask("GET", CASE).status_code == 404
    assert list(plane.control.uploads_dir.iterdir()) == []
    assert [event for event in plane.events() if event[0].startswith("recording.")] == [
        ("recording.upload", "case-7", "done"), ("recording.upload", "case-7", "done"), ("recording.upload", "case-7", "refused"),
        ("recording.delete", "case-7", "refused"), ("recording.delete", "case-7", "done"),
    ]  # fmt: skip


def test_unusable_recording_is_rejected_by_its_check(plane):
    assert put(plane, b"BAD").status_code == 201
    assert settled(plane)["state"] == "rejected"


@pytest.mark.slow
def test_recording_upload_refuses_wrong_size_digest_and_type(new_plane):
    plane = new_plane(limits={"recording_bytes": 2**20})
    long = put(plane, bytes(2**20 + 1))
    assert (long.status_code, long.headers["content-type"]) == (413, PROBLEM_JSON)
    assert put(plane, b"GOOD", **{"Content-Digest": "sha-256=:AAAA:"}).status_code == 400
    other = base64.b64encode(hashlib.sha256(b"other").digest()).decode()
    assert put(plane, b"GOOD", **{"Content-Digest": f"sha-256=:{other}:"}).status_code == 422
    assert put(plane, b"GOOD", **{"Content-Type": "application/zip"}).status_code == 415
    assert put(plane, b"").status_code == 422
    assert plane.ask("GET", "/v1/recordings").json() == []


def test_recording_upload_refuses_invalid_names(plane):
    for name in ("Case", "a_b", "-a", 41 * "a", "..", "%2e%2e", "a%2fb"):
        assert put(plane, b"GOOD", path=f"/v1/recordings/{name}").status_code in (404, 405, 422)


def test_viewers_cannot_upload_or_delete_recordings(plane):
    assert put(plane, b"GOOD", "viewer").status_code == 403
    assert plane.ask("DELETE", CASE, "viewer").status_code == 403
