"""Models over the API: upload, activation, rollback, deletion and their refusals."""

from __future__ import annotations

import base64
import hashlib
import time

import pytest

from services.api.problems import PROBLEM_JSON

VERSIONS = "/v1/models/liver/versions"


def digest_header(body: bytes) -> dict[str, str]:
    digest = base64.b64encode(hashlib.sha256(body).digest()).decode()
    return {"Content-Digest": f"sha-256=:{digest}:", "Content-Type": "application/octet-stream"}


def put(plane, body: bytes, role: str = "operator", **headers: str):
    return plane.ask("PUT", VERSIONS, role, content=body, headers={**digest_header(body), **headers})


@pytest.mark.parametrize(
    ("start", "query", "kind"),
    [
        (b"ply\nformat", "", "ply"),
        (b"\x1f\x8b\x08", "", "spz"),
        (b"NGSP", "", "spz"),
        (b"ply\nformat", "?format=splat", "splat"),
        (bytes(32), "?format=splat", "splat"),
    ],
)
def test_uploaded_splat_file_is_converted_to_model(plane, start, query, kind):
    body = start + bytes(64)
    answer = plane.ask("PUT", VERSIONS + query, "operator", content=body, headers=digest_header(body))
    assert answer.status_code == 201 and answer.json()["name"] == f"liver-{kind}"
    assert ("model.upload", "liver", "done") in plane.events()


def test_model_upload_with_unknown_format_returns_422(plane):
    answer = plane.ask("PUT", f"{VERSIONS}?format=obj", "operator", content=b"v 0", headers=digest_header(b"v 0"))
    assert answer.status_code == 422 and not plane.parts.models.kept


def settled(plane, number: int) -> dict:
    for _ in range(30_000):
        version = plane.ask("GET", f"{VERSIONS}/{number}").json()
        if version["state"] != "uploaded":
            return version
        time.sleep(0.01)
    raise AssertionError("the check did not end")


def test_model_upload_activate_rollback_and_delete(plane):
    bodies = [b"GOOD" + bytes([n]) * 3_000_000 for n in range(2)]
    for number, body in enumerate(bodies, start=1):
        answer = put(plane, body)
        assert (answer.status_code, answer.headers["location"]) == (201, f"{VERSIONS}/{number}")
        assert answer.json()["digest"] == hashlib.sha256(body).hexdigest()
        assert answer.json()["uploaded_by"].startswith("test-operator (")
        assert settled(plane, number)["state"] == "ready"
    assert plane.parts.models.bytes["liver", 2] == bodies[1]
    assert list(plane.control.uploads_dir.iterdir()) == []
    assert plane.ask("GET", "/v1/models").json() == [{"name": "liver", "active": None}]

    def activate(version, expected):
        wanted = {"version": version, "expected_current": expected}
        return plane.ask("POST", "/v1/models/liver/activate", "operator", json=wanted)

    assert activate(1, None).json()["state"] == "active"
    stale = activate(2, None)
    assert (stale.status_code, stale.headers["content-type"]) == (409, PROBLEM_JSON)
    assert "was expected" in stale.json()["detail"]
    assert activate(2, 1).status_code == 200
    assert plane.ask("GET", "/v1/models").json()[0]["active"] == 2
    assert plane.ask("POST", "/v1/models/liver/rollback", "operator").json()["version"] == 1
    assert plane.ask("POST", "/v1/models/liver/rollback", "operator").status_code == 409
    assert plane.ask("DELETE", f"{VERSIONS}/1").status_code == 409
    assert plane.ask("DELETE", f"{VERSIONS}/2").status_code == 204
    assert [version["version"] for version in plane.ask("GET", VERSIONS).json()] == [1]
    mine = [event for event in plane.events() if event[0].startswith("model.") and event[0] != "model.check"]
    assert mine == [
        ("model.upload", "liver", "done"),
        ("model.upload", "liver", "done"),
        ("model.activate", "liver/1", "done"),
        ("model.activate", "liver/2", "refused"),
        ("model.activate", "liver/2", "done"),
        ("model.rollback", "liver", "done"),
        ("model.rollback", "liver", "refused"),
        ("model.delete", "liver/1", "refused"),
        ("model.delete", "liver/2", "done"),
    ]


def test_bad_model_is_rejected_with_reason(plane):
    assert put(plane, b"BAD").json()["state"] == "uploaded"
    version = settled(plane, 1)
    assert (version["state"], version["reason"]) == ("rejected", "it is not good")


@pytest.mark.parametrize(
    ("header", "status"),
    [
        ("", 400),
        ("sha-256=abc", 400),
        ("sha-256=:abc:", 400),
        ("md5=:1B2M2Y8AsgTpgAmY7PhCfg==:", 400),
        (
            "sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:, sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:",
            400,
        ),
        ("sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:", 422),
    ],
)
def test_model_upload_with_wrong_digest_is_refused_and_not_kept(plane, header, status):
    answer = put(plane, b"GOOD", **{"Content-Digest": header})
    assert (answer.status_code, answer.headers["content-type"]) == (status, PROBLEM_JSON)
    assert plane.parts.models.kept == {} and list(plane.control.uploads_dir.iterdir()) == []


@pytest.mark.slow
def test_model_upload_refuses_wrong_body_size_type_role_and_name(new_plane):
    plane = new_plane(limits={"model_bytes": 2**20})
    assert put(plane, b"").status_code == 422
    assert put(plane, b"GOOD", **{"Content-Type": "text/html"}).status_code == 415
    assert put(plane, bytes(2**20 + 1)).status_code == 413
    assert put(plane, b"GOOD", "viewer").status_code == 403

    def chunks():
        for _ in range(20):
            yield bytes(2**16)

    answer = plane.ask("PUT", VERSIONS, content=chunks(), headers=digest_header(b""))
    assert answer.status_code == 413 and "more than" in answer.json()["detail"]
    for name in ("Liver", "..%2f", "a" * 41, "li ver"):
        answer = plane.ask("PUT", f"/v1/models/{name}/versions", content=b"GOOD", headers=digest_header(b"GOOD"))
        assert answer.status_code in (404, 422), name
    assert plane.parts.models.kept == {} and list(plane.control.uploads_dir.iterdir()) == []


def test_model_upload_returns_507_if_disk_full_and_429_if_busy(plane, monkeypatch):
    monkeypatch.setattr("services.api.uploads.SPARE_BYTES", 2**60)
    full = put(plane, b"GOOD")
    assert (full.status_code, full.json()["title"]) == (507, "Insufficient storage")
    monkeypatch.undo()
    plane.control.uploads._value = 0
    busy = put(plane, b"GOOD")
    assert busy.status_code == 429 and int(busy.headers["retry-after"]) >= 1


def test_version_routes_return_404_if_missing_and_422_for_bad_number(plane):
    for path in (VERSIONS, f"{VERSIONS}/1"):
        assert plane.ask("GET", path).status_code == 404
    assert plane.ask("GET", f"{VERSIONS}/0").status_code == 422
    assert plane.ask("GET", f"{VERSIONS}/{2**70}").status_code == 422


def test_registry_exception_returns_500_without_its_text(plane, monkeypatch, caplog):
    def broken():
        raise RuntimeError("secret of the registry")

    monkeypatch.setattr(plane.parts.models, "models", broken)
    answer = plane.ask("GET", "/v1/models")
    assert (answer.status_code, answer.headers["content-type"]) == (500, PROBLEM_JSON)
    assert "secret" not in answer.text and "Traceback" not in answer.text
    assert answer.headers["x-request-id"] in answer.json()["instance"]
    assert "x-content-type-options" in answer.headers
    assert "secret of the registry" in caplog.text


def test_startup_removes_uploads_of_killed_server(new_plane, tmp_path):
    (tmp_path / "data0" / "uploads").mkdir(parents=True)
    (tmp_path / "data0" / "uploads" / "upload-x").write_bytes(b"half")
    plane = new_plane()
    assert list(plane.control.uploads_dir.iterdir()) == []
