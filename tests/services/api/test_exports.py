"""Snapshots and exports over the API: roles, audit, digests, idempotency keys."""

from __future__ import annotations

import base64
import hashlib
import io
from types import SimpleNamespace
from typing import Any

import pytest
from control_fakes import FakeVersion, NotThere, fake_parts

from gsplat_core.choices import OUTPUTS, OUTPUTS_OF, RENDERERS, STANDARD
from services.api.problems import Conflicting

STREAM = "/v1/streams/endoscope"
ID = "1f0c9a3b5d7e8f20"
DATA = b"glTF" + bytes(600_000)


class FakeSnapshots:
    def __init__(self) -> None:
        self.taken = 0
        self.fails = False

    async def take(self, stream, model, by):
        if self.fails:
            raise Conflicting("no live reconstruction runs")
        self.taken += 1
        version = None if model is None else FakeVersion(model, 4, "uploaded", "ab", 9, by)
        return self.made(stream, by), version

    def made(self, stream, by="somebody"):
        return SimpleNamespace(
            id=ID, stream=stream, taken_at="2026-01-02T03:04:05+00:00", taken_by=by, seq=self.taken, model_version=3,
            gaussians=12, time_window_s=[1.0, 2.0], pause_ms=0.4, size_bytes=93, digest="cd" * 32,
        )  # fmt: skip

    def all(self, stream):
        return [self.made(stream)]

    def get(self, stream, number):
        if number != ID:
            raise NotThere("there is no such snapshot")
        return self.made(stream)

    def delete(self, stream, number):
        self.get(stream, number)


class FakeExports:
    def __init__(self) -> None:
        self.asked: list[tuple] = []
        self.wishes: list[Any] = []

    def of_version(self, name, number, wish):
        self.wishes.append(wish)
        self.asked.append((name, number, wish.format.name, wish.time_s, getattr(wish, "times", None)))
        return SimpleNamespace(file=io.BytesIO(DATA), sha256=hashlib.sha256(DATA).hexdigest(), size_bytes=len(DATA))

    of_snapshot = of_version


@pytest.fixture
def plane(new_plane):
    plane = new_plane(fake_parts(snapshots=FakeSnapshots(), exports=FakeExports()))
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    return plane


def test_post_snapshot_creates_listed_snapshot_and_audit_entry(plane):
    answer = plane.ask("POST", f"{STREAM}/snapshots", "operator", json={})
    assert answer.status_code == 201 and answer.headers["Location"] == f"{STREAM}/snapshots/{ID}"
    assert (answer.json()["id"], answer.json()["version"], answer.json()["pause_ms"]) == (ID, None, 0.4)
    assert plane.events()[-1] == ("snapshot.take", "endoscope", "done")
    assert plane.ask("GET", f"{STREAM}/snapshots", "viewer").json()[0]["id"] == ID
    assert plane.ask("GET", f"{STREAM}/snapshots/{ID}", "viewer").json()["gaussians"] == 12


@pytest.mark.slow
def test_post_snapshot_with_model_returns_model_version(plane):
    answer = plane.ask("POST", f"{STREAM}/snapshots", "operator", json={"model": "liver"})
    assert answer.status_code == 201 and answer.headers["Location"] == "/v1/models/liver/versions/4"
    assert answer.json()["id"] is None and answer.json()["version"]["version"] == 4


def test_post_snapshot_with_same_idempotency_key_is_done_once(plane):
    def ask(key, role="operator", **body):
        return plane.ask("POST", f"{STREAM}/snapshots", role, json=body, headers={"Idempotency-Key": key})

    first, second = ask("take 1"), ask("take 1")
    assert first.status_code == second.status_code == 201 and first.json() == second.json()
    assert plane.parts.snapshots.taken == 1
    assert ask("take 1", model="liver").status_code == 422
    assert ask("take 2").json()["seq"] == 2
    assert ask("take 1", role="admin").json()["seq"] == 3
    plane.parts.snapshots.fails = True
    assert ask("take 3").status_code == 409
    plane.parts.snapshots.fails = False
    assert ask("take 3").status_code == 201


def test_snapshot_routes_refuse_invalid_body_unknown_stream_and_id(plane):
    for body in ({"model": "No Name"}, {"name": "liver"}):
        assert plane.ask("POST", f"{STREAM}/snapshots", json=body).status_code == 422
    assert plane.ask("POST", "/v1/streams/nobody/snapshots", json={}).status_code == 404
    assert plane.ask("GET", f"{STREAM}/snapshots/{'0' * 16}").status_code == 404
    assert plane.ask("GET", f"{STREAM}/snapshots/..%2f..%2fkeys").status_code in (404, 422)
    plane.parts.snapshots.fails = True
    assert plane.ask("POST", f"{STREAM}/snapshots", json={}).status_code == 409
    assert plane.events()[-1] == ("snapshot.take", "endoscope", "refused")


def test_only_admin_deletes_snapshots(plane):
    assert plane.ask("DELETE", f"{STREAM}/snapshots/{ID}", "operator").status_code == 403
    assert plane.ask("DELETE", f"{STREAM}/snapshots/{ID}").status_code == 204
    assert plane.events()[-1] == ("snapshot.delete", f"endoscope/{ID}", "done")


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/v1/models/liver/versions/3/exports/glb?time_s=0.5", "liver-3.glb"),
        (f"{STREAM}/snapshots/{ID}/exports/glb?time_s=0.5", f"endoscope-{ID}.glb"),
    ],
)
def test_export_returns_file_with_content_digest(plane, path, name):
    answer = plane.ask("GET", path, "operator")
    assert answer.status_code == 200 and answer.content == DATA
    headers = answer.headers
    assert headers["Content-Type"] == "model/gltf-binary" and headers["Content-Length"] == str(len(DATA))
    assert headers["Content-Disposition"] == f'attachment; filename="{name}"'
    digest = base64.b64encode(hashlib.sha256(DATA).digest()).decode()
    assert headers["Content-Digest"] == f"sha-256=:{digest}:"
    assert plane.parts.exports.asked[-1][2:] == ("glb", 0.5, None)
    assert plane.events()[-1][0] in ("model.export", "snapshot.export") and plane.events()[-1][2] == "done"


def test_render_route_passes_view_time_and_options(plane):
    options = {"renderer": "stochastic", "samples": 4, "order": "pixel", "seed": 3, "outputs": ["image", "depth"]}
    wanted = {"format": "png", "view": "orbit", "time_s": 0.5, "options": options}
    answer = plane.ask("POST", "/v1/models/liver/versions/3/render", "operator", json=wanted)
    assert answer.status_code == 200 and answer.content == DATA
    assert answer.headers["Content-Type"] == "image/png"
    assert answer.headers["Content-Disposition"] == 'attachment; filename="liver-3.png"'
    wish = plane.parts.exports.wishes[-1]
    assert (wish.view, wish.time_s, wish.options.outputs) == ("orbit", 0.5, ("image", "depth"))
    assert wish.options.chosen() == options
    assert plane.events()[-1] == ("model.render", "liver/3", "done")


@pytest.mark.parametrize("output", [*STANDARD, *OUTPUTS])
def test_render_route_accepts_outputs_of_chosen_renderer_only(plane, output):
    path, options = "/v1/models/liver/versions/3/render", {"outputs": [output]}
    assert plane.ask("POST", path, json={"options": options}).status_code == 200
    assert plane.parts.exports.wishes[-1].options.outputs == (output,)
    for renderer in RENDERERS:
        answer = plane.ask("POST", path, json={"options": {**options, "renderer": renderer}})
        assert answer.status_code == (200 if output in OUTPUTS_OF[renderer] else 422)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"format": "gif"}, "png"),
        ({"format": "mp4", "time_s": 0.5}, "leave the time out"),
        ({"options": {"samples": 4}}, "choose renderer stochastic or points"),
        ({"options": {"renderer": "points", "outputs": ["normals"]}}, "choose renderer alpha"),
        ({"options": {"renderer": "points", "samples": 100_000}}, "1024"),
        ({"options": {"scale": 100}}, "4"),
        ({"options": {"device": "cuda"}}, "device"),
        ({"view": "/etc/passwd"}, "recorded"),
    ],
)
def test_render_route_returns_422_for_invalid_options(plane, wrong, message):
    answer = plane.ask("POST", "/v1/models/liver/versions/3/render", json=wrong)
    assert answer.status_code == 422 and message in answer.text
    assert not plane.parts.exports.wishes


@pytest.mark.parametrize(
    "wrong",
    ["obj", "glb?time_s=nan", "ply?times=3", "ply-sequence?time_s=1", "ply-sequence?times=5000", "isplat?time_s=1"],
)
def test_export_route_returns_422_for_invalid_format_or_time(plane, wrong):
    answer = plane.ask("GET", f"/v1/models/liver/versions/3/exports/{wrong}")
    assert answer.status_code == 422 and answer.headers["Content-Type"] == "application/problem+json"
    assert not plane.parts.exports.asked


def test_viewers_get_403_for_exports_renders_and_snapshots(plane):
    assert plane.ask("GET", "/v1/models/liver/versions/3/exports/ply", "viewer").status_code == 403
    assert plane.ask("POST", "/v1/models/liver/versions/3/render", "viewer", json={}).status_code == 403
    assert plane.ask("POST", f"{STREAM}/snapshots", "viewer", json={}).status_code == 403


def test_snapshots_and_exports_return_503_without_their_parts(new_plane):
    plane = new_plane()
    assert plane.ask("GET", f"{STREAM}/snapshots").status_code == 503
    assert plane.ask("GET", "/v1/models/liver/versions/3/exports/ply").status_code == 503
