"""Recordings and replays of a running service: upload, replay, results, kept models, and killed processes."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from services.client import Client, Refused
from tests.system.browsers import chromium_by_playwright

pytestmark = pytest.mark.slow

WITHIN_S = 300.0
QUICK = {"steps_per_frame": 2}
LONG = {"steps_per_frame": 300}
"""Some seconds of work on six small frames: time to be killed."""


class Server:
    """`intrasplat serve` without streams. Its folder outlives the process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder / "log"
        config = folder / "service.yaml"
        config.write_text(
            f"server: {{port: 0}}\npaths: {{data: {folder}/data, runtime: {folder}/run}}\nlog: {{format: text}}\nstreams: {{}}\n"
            "jobs: {workers: 1, threads: 1}\n"
        )

    def start(self) -> Client:
        """Start the server and return a client with the administrator's key."""
        with self.log.open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "services.cli", "serve", "--config", self.folder / "service.yaml"],
                stdout=output, stderr=output,
            )  # fmt: skip
        self.url = self.until(lambda: re.search(r"IntraSplat is on (http://\S+?)(?:/\S*)?\n", self.log.read_text()))[1]
        self.client = Client(self.url, (self.folder / "data" / "admin.key").read_text())
        return self.client

    def until(self, found):
        """Poll `found` until its result is true and return the result."""
        end_s = time.monotonic() + WITHIN_S
        while time.monotonic() < end_s:
            result = found()
            if result:
                return result
            time.sleep(0.05)
        raise AssertionError(f"condition not met within {WITHIN_S} s:\n{self.log.read_text()[-4000:]}")

    def pool(self) -> int | None:
        """Return the process id of the pool, or None."""
        return next((pid for pid in children(self.process.pid) if b"services.jobs.pool" in command(pid)), None)

    def attempt(self) -> int | None:
        """Return the process id of the running attempt, or None."""
        pool = self.pool()
        return None if pool is None else next(iter(children(pool)), None)


def children(pid: int) -> list[int]:
    """Return the process ids of a process's children."""
    try:
        return [
            int(each)
            for task in Path(f"/proc/{pid}/task").iterdir()
            for each in (task / "children").read_text().split()
        ]
    except FileNotFoundError:
        return []


def command(pid: int) -> bytes:
    """Return the command line of a process."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except FileNotFoundError:
        return b""


@pytest.fixture(scope="module")
def server(tiny, tmp_path_factory):
    """A service that has the recording `tiny`."""
    server = Server(tmp_path_factory.mktemp("served"))
    client = server.start()
    upload = server.folder / "tiny.zip"
    with zipfile.ZipFile(upload, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(tiny.rglob("*")):
            archive.write(path, f"tiny/{path.relative_to(tiny)}")
    assert client.upload_recording("tiny", upload).state == "uploaded"
    assert client.checked_recording("tiny").state == "ready"
    yield server
    server.client.close()
    server.process.kill()
    server.process.wait()


def running(server, job_id):
    """Wait until an attempt of the replay runs. Return its process id."""
    server.until(lambda: server.client.replay(job_id).state == "running")
    return server.until(server.attempt)


def results(server):
    """Return every report on the disk by id of its replay. Check that no attempt left files."""
    folder = server.folder / "data" / "replays"
    assert list((folder / ".running").glob("*/*-*")) == []
    return {
        path.name: json.loads((path / "report.json").read_text()) for path in folder.iterdir() if path.name[0] != "."
    }


def test_service_replays_recording_and_serves_results(server, tmp_path):
    job = server.client.start_replay("tiny", QUICK, idempotency_key="first")
    assert server.client.start_replay("tiny", QUICK, idempotency_key="first").id == job.id
    done = server.client.ended_replay(job.id, within_s=WITHIN_S)
    assert (done.state, done.frames_done, done.frames, done.attempts) == ("done", 6, 6, 1)
    for name in done.results:
        server.client.result(job.id, name, tmp_path / name)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["recording"]["name"] == "tiny" and report["frames"]["displayed"] == 6
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")
    assert (tmp_path / "reconstruction.mp4").read_bytes()[4:8] == b"ftyp"
    version = server.client.keep_model(job.id, "tiny")
    assert server.client.checked("tiny", version.version).state == "ready"
    with pytest.raises(Refused, match="no recording"):
        server.client.start_replay("nobody")


def test_failed_replay_has_reason(server):
    job = server.client.ended_replay(server.client.start_replay("tiny", {"scale": 0.01}).id, within_s=WITHIN_S)
    assert job.state == "failed" and "scale" in job.reason and job.results == []


def test_recording_in_use_is_kept_and_cancelled_replay_leaves_no_files(server):
    job = server.client.start_replay("tiny", LONG)
    attempt = running(server, job.id)
    with pytest.raises(Refused, match="has not ended uses"):
        server.client.delete_recording("tiny")
    server.client.cancel_replay(job.id)
    cancelled = server.client.ended_replay(job.id, within_s=WITHIN_S)
    assert cancelled.state == "cancelled" and "admin" in cancelled.reason
    server.until(lambda: not Path(f"/proc/{attempt}").exists())
    assert job.id not in results(server)


def test_ctl_uploads_replays_keeps_and_deletes_recording(server, tiny, tmp_path, monkeypatch, intrasplat):
    monkeypatch.setenv("INTRASPLAT_URL", server.url)
    monkeypatch.setenv("INTRASPLAT_KEY", server.client._key)
    added = intrasplat("ctl", "add-recording", "from-a-folder", tiny)
    assert (added.code, "ready" in added.out) == (0, True), added.err
    (tmp_path / "x.mp4").write_bytes(b"no video")
    assert "neither a video" in intrasplat("ctl", "add-recording", "x", tmp_path / "x.mp4").err
    options = ("--option", "steps-per-frame=2", "--option", "heldout=true")
    done = intrasplat("ctl", "replay", "from-a-folder", *options, "--wait")
    assert (done.code, "done" in done.out) == (0, True), done.err
    job_id = re.search(r"\b[0-9a-f]{16}\b", done.out)[0]
    assert server.client.replay(job_id).options == {"steps_per_frame": 2, "heldout": True}
    assert intrasplat("ctl", "result", job_id, "report.html", "--out", tmp_path / "report.html").code == 0
    assert "from-a-folder" in (tmp_path / "report.html").read_text()
    assert intrasplat("ctl", "keep", job_id, "kept").code == 0
    assert job_id in intrasplat("ctl", "replays").out
    refused = intrasplat("ctl", "cancel", job_id)
    assert (refused.code, "cannot be cancelled" in refused.err) == (2, True)
    assert intrasplat("ctl", "delete", "recording", "from-a-folder", "--yes").code == 0
    assert "from-a-folder" not in intrasplat("ctl", "recordings").out


@pytest.fixture(scope="module")
def page(server):
    """The console in Chromium, signed in."""
    with chromium_by_playwright() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(1000 * WITHIN_S)
        said: list[str] = []
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        own = (server.url, "data:", "blob:")
        page.on("request", lambda asked: None if asked.url.startswith(own) else said.append(asked.url))
        page.goto(f"{server.url}/#key={server.client._key}")
        page.wait_for_selector("#stream", state="attached")
        yield page
        assert said == [], "the page failed, or asked for something from elsewhere"


def test_console_uploads_and_replays_recording(server, page):
    page.click("#tab-recordings")
    page.fill("#recording-name", "by-hand")
    page.set_input_files("#recording-file", server.folder / "tiny.zip")
    page.click("#add-recording >> text=Upload")
    mine = page.locator("#recording-rows tr", has_text="by-hand")
    mine.get_by_text("ready").wait_for()
    assert "6 frames of 64×48" in mine.inner_text()
    mine.get_by_text("Replay").click()
    page.wait_for_selector("#replays:not([hidden])")
    assert page.input_value("#replay-recording") == "by-hand"
    page.fill("[data-option=steps_per_frame]", "2")
    page.click("text=Start a replay")
    replay = page.locator("#replay-rows tr", has_text="by-hand")
    replay.get_by_text("done").wait_for()  # over the WebSocket: nothing renews the page
    assert "6 of 6 frames" in replay.inner_text() and "steps per frame 2" in replay.inner_text()


def test_console_keeps_chosen_recording_while_list_loads(server, page):
    """A list requested before the choice may arrive later and lack the chosen recording."""
    held: list = []
    page.click("#tab-recordings")
    row = page.locator("#recording-rows tr", has_text="by-hand")
    row.wait_for()
    page.evaluate("document.getElementById('replay-recording').replaceChildren()")
    page.route("**/v1/recordings", lambda route: held.append(route))
    page.click("#tab-replays")
    wait_until_true(lambda: len(held) == 1, page)
    page.evaluate("for (const id of ['recordings', 'replays']) document.getElementById(id).hidden = id === 'replays'")
    row.get_by_text("Replay").click()
    assert page.input_value("#replay-recording") == "by-hand"
    wait_until_true(lambda: len(held) == 2, page)
    held[0].fulfill(json=[])
    page.wait_for_timeout(200)
    assert page.input_value("#replay-recording") == "by-hand"
    held[1].continue_()
    page.unroute("**/v1/recordings")
    wait_until_true(lambda: page.evaluate("document.getElementById('replay-recording').options.length") >= 2, page)
    assert page.input_value("#replay-recording") == "by-hand"


def wait_until_true(found, page):
    """Wait until `found` returns true while the page keeps running."""
    end_s = time.monotonic() + WITHIN_S
    while not found():
        assert time.monotonic() < end_s, f"condition not met within {WITHIN_S} s"
        page.wait_for_timeout(20)


def test_console_shows_report_and_video_of_replay(server, page):
    replay = page.locator("#replay-rows tr", has_text="by-hand")
    with page.context.expect_page() as opened:
        replay.get_by_text("Report", exact=True).click()
    report = opened.value
    report.wait_for_selector("h1 >> text=by-hand")
    # Its own style and pictures are shown, and it is from nowhere.
    assert report.evaluate("getComputedStyle(document.querySelector('main')).maxWidth") != "none"
    assert report.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert report.evaluate("document.images.length") > 0 and report.evaluate("self.origin") == "null"
    report.close()
    replay.get_by_text("Video", exact=True).click()
    page.wait_for_selector("#replay-player:not([hidden])")
    end_s = time.monotonic() + WITHIN_S
    while page.evaluate("document.getElementById('replay-video').readyState") < 2 and time.monotonic() < end_s:
        time.sleep(0.1)
    assert page.evaluate("document.getElementById('replay-video').videoWidth") >= 128


def test_console_keeps_model_of_replay_by_keyboard(server, page):
    replay = page.locator("#replay-rows tr", has_text="by-hand")
    replay.get_by_text("Keep model").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#keep-model[open]")
    page.fill("#keep-name", "from-a-replay")
    page.keyboard.press("Enter")
    page.wait_for_selector("#replay-said >> text=from-a-replay/1")
    assert server.client.checked("from-a-replay", 1).state == "ready"


def test_console_sha256_of_pieces_matches_hashlib(page):
    content = bytes(range(256)) * 1001 + b"end"
    found = page.evaluate(
        """async (sizes) => { const { Sha256 } = await import("/console/sha256.js");
        return sizes.map(([length, step]) => { const sum = new Sha256();
          const bytes = Uint8Array.from({ length }, (_, index) => (index < 256256 ? index % 256 : [101, 110, 100][index - 256256]));
          for (let at = 0; at < length; at += step) sum.add(bytes.subarray(at, at + step));
          return [...sum.digest()].map((byte) => byte.toString(16).padStart(2, "0")).join(""); }); }""",
        [[len(content), 1000], [0, 1], [55, 55], [56, 7], [64, 64], [119, 64], [128, 1]],
    )
    lengths = (len(content), 0, 55, 56, 64, 119, 128)
    assert found == [hashlib.sha256(content[:length]).hexdigest() for length in lengths]


@pytest.mark.parametrize("who", ["attempt", "pool", "server"])
def test_replay_with_killed_process_is_made_once(server, who):
    job = server.client.start_replay("tiny", LONG)
    attempt = running(server, job.id)
    os.kill({"attempt": attempt, "pool": server.pool(), "server": server.process.pid}[who], signal.SIGKILL)
    server.until(lambda: not Path(f"/proc/{attempt}").exists())
    if who == "server":
        server.process.wait()
        server.client.close()
        server.start()
    done = server.client.ended_replay(job.id, within_s=WITHIN_S)
    assert (done.state, done.frames_done, done.reason) == ("done", 6, None) and done.attempts >= 1
    assert results(server)[job.id]["frames"]["displayed"] == 6


def test_sigterm_ends_service_and_job_pool(server):
    job = server.client.start_replay("tiny", LONG)
    running(server, job.id)
    pool = server.pool()
    assert pool is not None
    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(WITHIN_S) == 0, server.log.read_text()
    assert not Path(f"/proc/{pool}").exists()
    assert all(report["frames"]["displayed"] == 6 for report in results(server).values())
