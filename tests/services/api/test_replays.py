"""Replays over the API: idempotent start, progress, cancellation, deletion, results."""

from __future__ import annotations

from pathlib import Path

import pytest
from control_fakes import NotNow, NotThere, fake_parts
from starlette.testclient import WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from services.api.app import ERRORS
from services.api.problems import PROBLEM_JSON, Conflicting, Missing
from services.api.replays import REPORT_POLICY
from services.errors import NotFound
from services.jobs.results import Replays, Results
from services.jobs.store import Claims, JobProgress, JobState, JobStore

REPLAYS = "/v1/replays"


class Worker:
    """Worker that runs jobs on request of the test."""

    def __init__(self, store: JobStore, results: Path) -> None:
        self.claims = Claims(store.database, "worker", 60, 3, lambda folder: False)
        self._results = results

    def finish(self, job_id: str) -> None:
        assert self.claims.take().id == job_id
        folder = self._results / job_id
        folder.mkdir()
        for name, content in (
            ("report.html", b"<h1>"),
            ("model.isplat", b"GOOD"),
            ("reconstruction.mp4", bytes(range(100))),
        ):
            (folder / name).write_bytes(content)
        self.claims.end(job_id, JobState.DONE)


@pytest.fixture
def worker_and_plane(new_plane, tmp_path):
    """A worker, and a control plane with real replays."""

    def find(connection, name):
        if name == "unknown":
            raise NotFound("there is no recording 'unknown'")
        return Path("/recordings") / name

    store = JobStore(f"sqlite:///{tmp_path / 'jobs.sqlite'}", find)
    parts = fake_parts(
        jobs=Replays(store, Results(tmp_path / "results")), errors={**ERRORS, NotThere: Missing, NotNow: Conflicting}
    )
    yield Worker(store, tmp_path / "results"), new_plane(parts)
    store.close()


@pytest.fixture
def plane(worker_and_plane):
    return worker_and_plane[1]


@pytest.fixture
def worker(worker_and_plane):
    return worker_and_plane[0]


def start(plane, role="operator", key=None, **wanted):
    headers = {} if key is None else {"Idempotency-Key": key}
    return plane.ask("POST", REPLAYS, role, json=wanted or {"recording": "case-7"}, headers=headers)


def test_replay_start_finish_keep_and_delete(plane, worker):
    answer = start(plane, recording="case-7", options={"steps_per_frame": 2, "seed": 0})
    job_id = answer.json()["id"]
    assert (answer.status_code, answer.headers["location"]) == (202, f"{REPLAYS}/{job_id}")
    found = plane.ask("GET", f"{REPLAYS}/{job_id}", "viewer").json()
    assert (found["state"], found["recording"], found["options"]) == ("queued", "case-7", {"steps_per_frame": 2})
    assert plane.ask("GET", f"{REPLAYS}/{job_id}/results/report.html").status_code == 404
    assert plane.ask("POST", f"{REPLAYS}/{job_id}/keep", json={"model": "liver"}).status_code == 409
    assert plane.ask("DELETE", f"{REPLAYS}/{job_id}").status_code == 409
    worker.finish(job_id)
    found = plane.ask("GET", f"{REPLAYS}/{job_id}").json()
    assert (found["state"], found["results"]) == ("done", ["report.html", "reconstruction.mp4", "model.isplat"])
    kept = plane.ask("POST", f"{REPLAYS}/{job_id}/keep", "operator", json={"model": "liver"})
    assert (kept.status_code, kept.headers["location"]) == (201, "/v1/models/liver/versions/1")
    assert plane.parts.models.bytes["liver", 1] == b"GOOD"
    assert plane.ask("POST", f"{REPLAYS}/{job_id}/cancel").status_code == 409
    assert plane.ask("DELETE", f"{REPLAYS}/{job_id}").status_code == 204
    assert plane.ask("GET", f"{REPLAYS}/{job_id}").status_code == 404
    events = [(event, outcome) for event, _, outcome in plane.events() if event.startswith("replay.")]
    assert events == [
        ("replay.start", "done"), ("replay.keep", "refused"), ("replay.delete", "refused"), ("replay.keep", "done"),
        ("replay.cancel", "refused"), ("replay.delete", "done"),
    ]  # fmt: skip


def test_replays_of_recording_list_form_one_batch(plane, worker):
    answer = start(plane, recordings=["a", "b", "c"])
    made = answer.json()
    assert (answer.status_code, made["id"], len(made["ids"])) == (202, None, 3)
    worker.finish(made["ids"][0])
    found = plane.ask("GET", answer.headers["location"], "viewer").json()
    assert found["states"] == {"queued": 2, "running": 0, "done": 1, "failed": 0, "cancelled": 0}
    assert [each["recording"] for each in plane.ask("GET", f"{REPLAYS}?batch={made['batch']}").json()] == [
        "c",
        "b",
        "a",
    ]
    assert [each["recording"] for each in plane.ask("GET", f"{REPLAYS}?state=done").json()] == ["a"]
    assert plane.ask("GET", f"{REPLAYS}?state=lost").status_code == 422
    assert plane.ask("GET", "/v1/batches/0123456789abcdef").status_code == 404


def test_post_replay_with_same_idempotency_key_starts_one_replay(plane):
    first, again = start(plane, key="k1"), start(plane, key="k1")
    assert first.status_code == again.status_code == 202 and first.json() == again.json()
    assert start(plane, key="k1", recording="other").status_code == 422
    assert start(plane, key="k2").json()["id"] != first.json()["id"]
    assert len(plane.ask("GET", REPLAYS).json()) == 2


@pytest.mark.parametrize(
    "wanted",
    [
        {"recording": "a", "recordings": ["b"]}, {"recordings": []}, {"options": {}}, {"recording": "A"}, {"recording": "../a"},
        {"recording": "a", "options": {"out": "/etc"}}, {"recording": "a", "options": {"engine": "holoscan"}},
        {"recording": "a", "options": {"steps_per_frame": 0}}, {"recording": "a", "options": {"scale": 1e9}},
        {"recording": "a", "options": {"device": "cuda:0; rm"}}, {"recording": "a", "out": "x"}, {"recordings": ["a"] * 2001},
    ],
)  # fmt: skip
def test_post_replay_returns_422_for_invalid_request(plane, wanted):
    assert start(plane, **wanted).status_code == 422
    assert plane.ask("GET", REPLAYS).json() == []


def test_post_replay_returns_404_for_unknown_recording(plane):
    assert start(plane, recordings=["a", "unknown"]).status_code == 404
    assert plane.ask("GET", REPLAYS).json() == []


def test_viewers_cannot_start_or_cancel_replays(plane):
    job_id = start(plane).json()["id"]
    assert start(plane, "viewer").status_code == 403
    assert plane.ask("POST", f"{REPLAYS}/{job_id}/cancel", "viewer").status_code == 403
    assert plane.ask("DELETE", f"{REPLAYS}/{job_id}", "operator").status_code == 403
    assert plane.ask("POST", f"{REPLAYS}/{job_id}/cancel", "operator").json()["state"] == "cancelled"


def test_only_report_result_has_sandbox_content_security_policy(plane, worker):
    job_id = start(plane).json()["id"]
    worker.finish(job_id)
    report = plane.ask("GET", f"{REPLAYS}/{job_id}/results/report.html", "viewer")
    assert report.headers["content-security-policy"] == REPORT_POLICY
    assert "sandbox" in REPORT_POLICY and "script" not in REPORT_POLICY and "http" not in REPORT_POLICY
    assert (
        report.headers["content-type"].startswith("text/html") and report.headers["x-content-type-options"] == "nosniff"
    )
    video = plane.ask("GET", f"{REPLAYS}/{job_id}/results/reconstruction.mp4", headers={"Range": "bytes=10-19"})
    assert (video.status_code, video.content) == (206, bytes(range(10, 20)))
    assert "sandbox" not in video.headers["content-security-policy"]
    model = plane.ask("GET", f"{REPLAYS}/{job_id}/results/model.isplat")
    assert model.headers["content-disposition"].startswith("attachment") and model.content == b"GOOD"


def test_keep_returns_409_while_queued_and_503_if_result_is_lost(plane, worker, tmp_path):
    job_id = start(plane).json()["id"]
    early = plane.ask("POST", f"{REPLAYS}/{job_id}/keep", json={"model": "liver"})
    assert early.status_code == 409 and "the replay is queued" in early.json()["detail"]
    worker.finish(job_id)
    (tmp_path / "results").rename(tmp_path / "elsewhere")
    gone = plane.ask("POST", f"{REPLAYS}/{job_id}/keep", json={"model": "liver"})
    assert gone.status_code == 503 and "is not on the disk; restore it from a backup" in gone.json()["detail"]


@pytest.mark.parametrize("given", ["lines=0-1", "bytes=x-y", "bytes=9-1", "", "zork"])
def test_malformed_range_header_returns_whole_result(plane, worker, given):
    job_id = start(plane).json()["id"]
    worker.finish(job_id)
    video = plane.ask("GET", f"{REPLAYS}/{job_id}/results/reconstruction.mp4", headers={"Range": given})
    whole = plane.ask("GET", f"{REPLAYS}/{job_id}/results/reconstruction.mp4")
    assert (video.status_code, video.content) == (200, whole.content)


@pytest.mark.parametrize("given", ["bytes=99999-", "bytes=-0"])
def test_unsatisfiable_range_returns_416(plane, worker, given):
    job_id = start(plane).json()["id"]
    worker.finish(job_id)
    path = f"{REPLAYS}/{job_id}/results/reconstruction.mp4"
    size = len(plane.ask("GET", path).content)
    refused = plane.ask("GET", path, headers={"Range": given})
    assert (refused.status_code, refused.headers["content-type"]) == (416, PROBLEM_JSON)
    assert refused.headers["content-range"] == f"bytes */{size}" and f"has {size} bytes" in refused.json()["detail"]


@pytest.mark.parametrize("file", ["log", "..%2fjobs.sqlite", "../jobs.sqlite", ".intrasplat.json", "report.json"])
def test_results_route_returns_404_or_422_for_other_files(plane, worker, file):
    job_id = start(plane).json()["id"]
    worker.finish(job_id)
    assert plane.ask("GET", f"{REPLAYS}/{job_id}/results/{file}").status_code in (404, 422)


def test_result_is_downloadable_once_per_ticket(plane, worker):
    job_id = start(plane).json()["id"]
    worker.finish(job_id)
    path = f"{REPLAYS}/{job_id}/results/report.html"
    ticket = plane.ask("POST", "/v1/tickets", "viewer", json={"path": path}).json()["ticket"]
    assert plane.client.get(f"{path}?ticket={ticket}").status_code == 200
    assert plane.client.get(f"{path}?ticket={ticket}").status_code == 401
    assert plane.client.get(path).status_code == 401


def test_progress_websocket_sends_updates_until_replay_ends(plane, worker):
    job_id = start(plane).json()["id"]
    path = f"{REPLAYS}/{job_id}/progress"
    ticket = plane.ask("POST", "/v1/tickets", "viewer", json={"path": path}).json()["ticket"]
    with plane.client.websocket_connect(f"{path}?ticket={ticket}") as socket:
        assert socket.receive_json()["state"] == "queued"
        assert worker.claims.take().id == job_id
        worker.claims.renew({job_id: JobProgress(4, 9, 30.5, 29.5, 28.5)})
        views = [socket.receive_json()]
        if views[-1]["frames_done"] == 0:  # it was seen between the two
            views.append(socket.receive_json())
        assert (views[-1]["state"], views[-1]["frames_done"], views[-1]["psnr_db"]) == ("running", 4, 30.5)
        assert (views[-1]["previous_frame_db"], views[-1]["next_frame_db"]) == (29.5, 28.5)
        worker.claims.end(job_id, JobState.FAILED, "its recording is empty")
        assert socket.receive_json()["reason"] == "its recording is empty"
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_json()
    assert ended.value.code == 1000


@pytest.mark.parametrize("job_id", ["0123456789abcdef", "x"])
def test_progress_websocket_refuses_missing_ticket_and_unknown_replay(plane, job_id):
    path = f"{REPLAYS}/{job_id}/progress"
    ticket = plane.ask("POST", "/v1/tickets", "viewer", json={"path": path}).json()["ticket"]
    for query in ("", "?ticket=x", f"?ticket={ticket}"):
        with (
            pytest.raises((WebSocketDenialResponse, WebSocketDisconnect)),
            plane.client.websocket_connect(path + query),
        ):
            pass
