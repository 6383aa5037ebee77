"""Requests that `intrasplat ctl` sends, and its output for the responses."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from services.cli import ctl as ctl_module
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK
from services.client import Client
from services.client import requests as client_requests

VERSION = {
    "name": "liver", "version": 3, "state": "ready", "digest": "ab", "size_bytes": 4, "uploaded_at": "then", "uploaded_by": "me",
    "description": {},
}  # fmt: skip
RECORDING = {
    "name": "case-7", "kind": "video", "state": "ready", "digest": "ab", "size_bytes": 4, "kept_bytes": 4, "uploaded_at": "then",
    "uploaded_by": "me",
}  # fmt: skip
SNAPSHOT = {
    "id": "1f0c", "stream": "theatre-1", "taken_at": "then", "taken_by": "me", "seq": 5, "model_version": 2, "gaussians": 7,
    "time_window_s": [0.0, 1.0], "pause_ms": 1.0, "size_bytes": 4, "digest": "ab",
}  # fmt: skip


def replay(job_id: str, state: str) -> dict[str, Any]:
    return {
        "id": job_id, "number": 1, "batch": "b", "recording": f"case-{job_id}", "options": {}, "state": state, "attempts": 1,
        "frames_done": 2, "created_by": "me", "created_at": "then", "reason": f"because of {job_id}",
    }  # fmt: skip


def entry(seq: int) -> dict[str, Any]:
    return {
        "seq": seq, "at": "then", "event": "model.activate", "actor": "me", "role": "admin", "subject": f"subject-{seq}",
        "outcome": "done", "request_id": "r", "detail": {},
    }  # fmt: skip


class Service:
    """Prepared responses of a service, and the requests it received."""

    def __init__(self) -> None:
        self.answers: dict[tuple[str, str], list[Any]] = {}
        self.requests: list[tuple[str, str, dict[str, Any]]] = []

    def take(self, method: str, path: str, options: dict[str, Any]) -> Any:
        self.requests.append((method, path, options))
        answers = self.answers.get((method, path), [None])
        return answers.pop(0) if len(answers) > 1 else answers[0]

    @property
    def asked(self) -> list[tuple[str, str]]:
        return [(method, path) for method, path, _ in self.requests]


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Service:
    made = Service()

    class Answered(Client):
        def _ask(self, method: str, path: str, **options: Any) -> Any:
            return made.take(method, path, options)

        def _put_file(self, path: str, file: Path, **options: Any) -> Any:
            return made.take("PUT", path, {**options, "file": file.read_bytes()})

        def _get_file(self, path: str, file: Path, *, method: str = "GET", **options: Any) -> int:
            made.take(method, path, options)
            return file.write_bytes(b"file")

    monkeypatch.setenv("INTRASPLAT_KEY", "intrasplat_0_0")
    monkeypatch.setattr("services.client.Client", Answered)
    monkeypatch.setattr(client_requests.time, "sleep", lambda _: None)
    return made


Ctl = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ctl(service: Service, capsys: pytest.CaptureFixture[str]) -> Ctl:
    def call(*arguments: str) -> tuple[int, str, str]:
        code = run(["ctl", *arguments])
        return code, *capsys.readouterr()

    return call


@pytest.mark.parametrize("state", ["ready", "rejected"])
def test_ctl_upload_waits_for_check_of_version(ctl: Ctl, service: Service, tmp_path: Path, state: str) -> None:
    (tmp_path / "liver.isplat").write_bytes(b"model")
    service.answers["PUT", "/v1/models/liver/versions"] = [{**VERSION, "state": "uploaded"}]
    checked = {**VERSION, "state": state, "reason": "it is torn"}
    service.answers["GET", "/v1/models/liver/versions/3"] = [{**VERSION, "state": "validated"}, checked]
    code, out, err = ctl("upload", "liver", str(tmp_path / "liver.isplat"))
    assert service.requests[0][2] == {"file": b"model"}
    assert service.asked[1:] == [("GET", "/v1/models/liver/versions/3")] * 2
    assert state in out and "liver" in out
    assert (code, "liver/3 was rejected: it is torn" in err) == ((OK, False) if state == "ready" else (BAD_INPUT, True))


@pytest.mark.parametrize(("suffix", "is_converted"), [("ply", True), ("SPLAT", True), ("isplat", False)])
def test_ctl_upload_requests_conversion_of_splat_files_only(
    ctl: Ctl, service: Service, tmp_path: Path, suffix: str, is_converted: bool
) -> None:
    file = tmp_path / f"liver.{suffix}"
    file.write_bytes(b"model")
    service.answers["PUT", "/v1/models/liver/versions"] = service.answers["GET", "/v1/models/liver/versions/3"] = [
        VERSION
    ]
    assert ctl("upload", "liver", str(file))[0] == OK
    assert service.requests[0][2].get("params") == ({"format": suffix.lower()} if is_converted else None)


@pytest.mark.parametrize("state", ["ready", "rejected"])
def test_ctl_add_recording_waits_for_check(ctl: Ctl, service: Service, tmp_path: Path, state: str) -> None:
    (tmp_path / "case.mp4").write_bytes(b"video")
    service.answers["PUT", "/v1/recordings/case-7"] = [{**RECORDING, "state": "uploaded"}]
    checked = {**RECORDING, "state": state, "reason": "it is torn"}
    service.answers["GET", "/v1/recordings/case-7"] = [{**RECORDING, "state": "uploaded"}, checked]
    code, out, err = ctl("add-recording", "case-7", str(tmp_path / "case.mp4"))
    assert service.asked[1:] == [("GET", "/v1/recordings/case-7")] * 2 and state in out
    assert (code, "case-7 was rejected: it is torn" in err) == ((OK, False) if state == "ready" else (BAD_INPUT, True))


@pytest.mark.parametrize("stored", [False, True])
def test_ctl_snapshot_with_model_waits_for_check_of_version(ctl: Ctl, service: Service, stored: bool) -> None:
    taken = {**SNAPSHOT, "id": None, "version": {**VERSION, "state": "uploaded"}} if stored else SNAPSHOT
    service.answers["POST", "/v1/streams/theatre-1/snapshots"] = [taken]
    service.answers["GET", "/v1/models/liver/versions/3"] = [VERSION]
    code, out, _ = ctl("snapshot", "theatre-1", *(["--model", "liver"] if stored else []))
    assert code == OK and service.requests[0][2]["json"] == ({"model": "liver"} if stored else {})
    assert ("ready" in out, "1f0c" in out) == (stored, not stored)
    assert len(service.requests) == 1 + stored


def test_ctl_render_export_and_fetch_write_new_files_only(ctl: Ctl, service: Service, tmp_path: Path) -> None:
    png, ply, packed = (str(tmp_path / name) for name in ("a.PNG", "b.ply", "c.isplat"))
    assert ctl("render", "liver", "3", png, "--view", "orbit", "--time", "1.5", "--option", "layout=row") == (
        OK, f"{png}\n", "",
    )  # fmt: skip
    assert ctl("export", "liver", "3", ply, "--time", "0.5") == (OK, f"{ply}\n", "")
    assert ctl("fetch", "theatre-1", "1f0c", packed) == (OK, f"{packed}\n", "")
    assert service.asked == [
        ("POST", "/v1/models/liver/versions/3/render"), ("GET", "/v1/models/liver/versions/3/exports/ply"),
        ("GET", "/v1/streams/theatre-1/snapshots/1f0c/exports/isplat"),
    ]  # fmt: skip
    wanted = service.requests[0][2]["json"]
    assert (wanted["format"], wanted["view"], wanted["time_s"]) == ("png", "orbit", 1.5)
    assert wanted["options"] == {"layout": "row"}
    assert service.requests[1][2]["params"] == {"time_s": 0.5} and service.requests[2][2]["params"] == {}
    sent = len(service.requests)
    code, _, err = ctl("render", "liver", "3", str(tmp_path / "a.gif"))
    assert code == BAD_INPUT and "a.gif ends in neither .png nor .mp4" in err
    for command in (
        ["render", "liver", "3", png],
        ["export", "liver", "3", ply],
        ["fetch", "theatre-1", "1f0c", packed],
    ):
        assert ctl(*command)[0] != OK, "an existing file is kept"
        assert len(service.requests) == sent, "nothing is asked for a file that cannot be written"


def test_ctl_camera_sends_angles_and_zoom(ctl: Ctl, service: Service) -> None:
    assert ctl("camera", "theatre-1", "--azimuth", "10", "--elevation", "-5", "--zoom", "2")[0] == OK
    wanted = {"azimuth_deg": 10.0, "elevation_deg": -5.0, "zoom": 2.0}
    assert service.requests == [("PUT", "/v1/streams/theatre-1/camera", {"json": wanted})]


@pytest.mark.parametrize(
    ("wait", "states", "code"),
    [(False, ["queued"], OK), (True, ["running", "done"], OK), (True, ["failed"], BAD_INPUT)],
)
def test_ctl_replay_waits_for_end_with_wait_option(
    ctl: Ctl, service: Service, wait: bool, states: list[str], code: int
) -> None:
    service.answers["POST", "/v1/replays"] = [{"id": None, "batch": "b", "ids": ["1", "2"]}]
    service.answers["GET", "/v1/replays/1"] = [replay("1", "done" if wait else "queued")]
    service.answers["GET", "/v1/replays/2"] = [replay("2", state) for state in states]
    found, out, err = ctl("replay", "case-1", "case-2", "--option", "steps_per_frame=20", *(["--wait"] if wait else []))
    assert found == code and states[-1] in out
    assert service.requests[0][2]["json"]["recordings"] == ["case-1", "case-2"]
    assert len(service.requests) == 2 + len(states)
    assert ("case-2: the replay is failed: because of 2" in err) == (code != OK)


@pytest.mark.parametrize(
    ("command", "listing", "target"),
    [
        (["delete", "snapshot", "theatre-1"], ("/v1/streams/theatre-1/snapshots", SNAPSHOT), "/v1/streams/theatre-1/snapshots/1f0c"),
        (["keys", "revoke"], ("/v1/keys", {"id": "1f0c", "name": "me", "role": "viewer", "created_at": "then"}), "/v1/keys/1f0c"),
    ],
    ids=["snapshot", "key"],
)  # fmt: skip
@pytest.mark.parametrize("number", ["1f0c", "2e1d"])
def test_ctl_deletes_only_existing_snapshots_and_keys(
    ctl: Ctl, service: Service, command: list[str], listing: tuple[str, dict[str, Any]], target: str, number: str
) -> None:
    path, row = listing
    service.answers["GET", path] = [[{**row, "id": "other"}, row]]
    code, out, err = ctl(*command, number, "--yes")
    if number == "1f0c":
        assert code == OK and "deleted" in out and service.asked == [("GET", path), ("DELETE", target)]
    else:
        assert code == BAD_INPUT and repr(number) in err and service.asked == [("GET", path)]


def test_ctl_delete_replay_looks_up_replay_first(ctl: Ctl, service: Service) -> None:
    service.answers["GET", "/v1/replays/1"] = [replay("1", "done")]
    assert ctl("delete", "replay", "1", "--yes")[0] == OK
    assert service.asked == [("GET", "/v1/replays/1"), ("DELETE", "/v1/replays/1")]


def test_ctl_keys_add_sends_limits_and_prints_key(ctl: Ctl, service: Service) -> None:
    made = {"id": "1", "name": "wall", "role": "viewer", "created_at": "then", "key": "intrasplat_1_2"}
    service.answers["POST", "/v1/keys"] = [made]
    begin = datetime.now(UTC)
    assert ctl("keys", "add", "wall", "--expires-days", "2", "--stream", "theatre-1") == (OK, "intrasplat_1_2\n", "")
    wanted = service.requests[0][2]["json"]
    assert (wanted["name"], wanted["role"], wanted["streams"]) == ("wall", "viewer", ["theatre-1"])
    assert (datetime.fromisoformat(wanted["expires_at"]) - begin).days in (1, 2)
    assert ctl("keys", "add", "wall")[0] == OK
    assert service.requests[1][2]["json"]["expires_at"] is service.requests[1][2]["json"]["streams"] is None


def page(entries: list[int], next_before: int | None, head: int) -> dict[str, Any]:
    return {
        "entries": [entry(seq) for seq in entries],
        "next_before": next_before,
        "head_seq": head,
        "head_digest": "ab",
    }


def test_ctl_audit_requests_pages_until_count_is_reached(ctl: Ctl, service: Service) -> None:
    service.answers["GET", "/v1/audit"] = [page([9, 8], 8, 9), page([5], 5, 9), page([2, 1], None, 9)]
    code, out, _ = ctl("audit", "--count", "5")
    assert code == OK
    assert [line.split("subject-")[1].split()[0] for line in out.splitlines()[1:]] == ["1", "2", "5", "8", "9"]
    asked = [options["params"] for _, _, options in service.requests]
    assert [(each["count"], each.get("before")) for each in asked] == [(5, None), (3, 8), (2, 5)]
    service.answers["GET", "/v1/audit"] = [page([9, 8], 8, 9)]
    assert ctl("audit", "--count", "2")[0] == OK and len(service.requests) == 4


def test_ctl_audit_follow_prints_entries_once_in_order(
    ctl: Ctl, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.answers["GET", "/v1/audit"] = [
        page([4, 3], 3, 4),
        page([4, 3], 3, 4),  # nothing new
        page([8, 7], 7, 8), page([6], 6, 8), page([5, 4], 4, 8),
        page([9, 8], 8, 9),
    ]  # fmt: skip
    waits = []

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) > 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(ctl_module.time, "sleep", sleep)
    _, out, _ = ctl("audit", "--count", "2", "--follow")
    lines = [line.split("subject-")[1].split()[0] for line in out.splitlines() if "subject-" in line]
    assert lines == ["3", "4", "5", "6", "7", "8", "9"]
    assert len(service.requests) == 6


def test_ctl_replays_filters_by_batch_and_prints_json(ctl: Ctl, service: Service) -> None:
    service.answers["GET", "/v1/replays"] = [[replay("1", "done")]]
    code, out, _ = ctl("replays", "--batch", "b", "--count", "3", "--json")
    assert code == OK and json.loads(out)[0]["recording"] == "case-1"
    assert service.requests[0][2]["params"] == {"count": 3, "batch": "b"}


def test_ctl_add_recording_uploads_folder_as_uncompressed_zip(ctl: Ctl, service: Service, tmp_path: Path) -> None:
    """Images are compressed already."""
    folder = tmp_path / "case"
    (folder / "images").mkdir(parents=True)
    contents = {"images/0.png": b"first" * 50, "images/1.png": b"second", "camera.json": b"{}"}
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    (folder / "again.png").symlink_to(folder / "images" / "1.png")
    service.answers["PUT", "/v1/recordings/case-7"] = service.answers["GET", "/v1/recordings/case-7"] = [RECORDING]
    assert ctl("add-recording", "case-7", str(folder))[0] == OK
    with zipfile.ZipFile(io.BytesIO(service.requests[0][2]["file"])) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == {**contents, "again.png": b"second"}
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
    (tmp_path / "secret").write_bytes(b"secret")
    (folder / "outside.png").symlink_to(tmp_path / "secret")
    code, _, err = ctl("add-recording", "case-7", str(folder))
    assert code == BAD_INPUT and "is a link to a file outside" in err and len(service.requests) == 2
