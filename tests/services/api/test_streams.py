"""Streams over the API."""

from __future__ import annotations

import pytest

ENDOSCOPE = {"name": "endoscope", "source": "synthetic:?moving=1"}


def test_stream_create_stop_start_set_options_and_delete(plane):
    made = plane.ask("POST", "/v1/streams", "operator", json=ENDOSCOPE)
    assert (made.status_code, made.json()["state"]) == (201, "live")
    assert plane.ask("POST", "/v1/streams", "operator", json=ENDOSCOPE).status_code == 409
    assert [stream["name"] for stream in plane.ask("GET", "/v1/streams", "viewer").json()] == ["endoscope"]
    assert plane.ask("POST", "/v1/streams/endoscope/stop", "operator").json()["state"] == "stopped"
    assert plane.ask("POST", "/v1/streams/endoscope/start", "operator").json()["state"] == "live"
    changed = plane.ask("PATCH", "/v1/streams/endoscope/options", "operator", json={"options": {"tool_mask": "none"}})
    assert changed.json()["options"] == {"tool_mask": "none"}
    refused = plane.ask("PATCH", "/v1/streams/endoscope/options", "operator", json={"options": {"unknown": 1}})
    assert refused.status_code == 422 and "nearest" in refused.json()["detail"]
    assert plane.ask("DELETE", "/v1/streams/endoscope", "operator").status_code == 403
    assert plane.ask("DELETE", "/v1/streams/endoscope").status_code == 204
    assert plane.ask("GET", "/v1/streams/endoscope").status_code == 404
    assert [event[0] for event in plane.events()][-7:] == [
        "stream.create", "stream.create", "stream.stop", "stream.start", "stream.options", "stream.options", "stream.delete",
    ]  # fmt: skip


def test_source_passwords_are_hidden_in_responses_and_audit_log(new_plane):
    address = "rtsp://user:pa55@10.0.0.5/stream?token=s3cret&fps=30"
    plane = new_plane(
        sources={"networks": ["10.0.0.0/8"]},
        streams={"camera": {"source": address}},
        registry={"database": "postgresql://u:dbpass@db/x", "blob_options": {"secret": "s3key"}},
    )
    made = plane.ask("POST", "/v1/streams", json={"name": "camera", "source": address})
    assert made.status_code == 201
    assert plane.parts.streams.created["camera"].source == address
    for answer in (made, plane.ask("GET", "/v1/streams/camera"), plane.ask("GET", "/v1/config")):
        assert not any(secret in answer.text for secret in ("pa55", "s3cret", "dbpass", "s3key"))
        assert "10.0.0.5" in answer.text
    log = plane.control.audit.path.read_text()
    assert not any(secret in log for secret in ("pa55", "s3cret", "10.0.0.5"))


@pytest.mark.parametrize(
    "change",
    [
        {"name": "Endoscope"}, {"name": "../x"}, {"source": None}, {"show": "model ../x"}, {"device": "tpu"}, {"more": 1},
        {"options": {"a": [1]}}, {"options": {str(n): n for n in range(51)}}, {"start": "perhaps"},
    ],
)  # fmt: skip
def test_post_stream_returns_422_for_invalid_values(plane, change):
    answer = plane.ask("POST", "/v1/streams", json={**ENDOSCOPE, **change})
    assert answer.status_code == 422 and answer.json()["errors"]
    assert plane.parts.streams.kept == {}


@pytest.mark.parametrize("source", ["\x00:", "\n:x", "a\x7fb:", "[]{}:", "ä:", ":", "", 'a"b:'])
def test_source_with_invalid_characters_returns_422_and_is_audited(plane, source):
    answer = plane.ask("POST", "/v1/streams", json={"name": "x", "source": source})
    assert answer.status_code == 422 and ("stream.create", "x", "refused") in plane.events()


def test_viewer_sets_virtual_camera_of_stream(plane):
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    path = "/v1/streams/endoscope/camera"
    answer = plane.ask("PUT", path, "viewer", json={"azimuth_deg": 20})
    assert (answer.status_code, answer.json()) == (200, {"azimuth_deg": 20, "elevation_deg": 0, "zoom": 1})
    assert plane.parts.streams.camera == answer.json()
    for wrong in ({"azimuth_deg": 80}, {"zoom": 0}, {"roll_deg": 3}, {"zoom": "near"}):
        assert plane.ask("PUT", path, json=wrong).status_code == 422
    assert plane.ask("PUT", "/v1/streams/nobody/camera", json={}).status_code == 404
