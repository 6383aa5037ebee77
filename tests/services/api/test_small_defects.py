"""Unknown parameters, concurrent slow uploads, versions deleted during their check, and one log format."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import logging
import subprocess
import sys
import threading

import pytest
from control_fakes import FakeModels, FakeRecordings, NotNow, NotThere, fake_parts

from services.jobs.pool import relayed

OCTETS = "application/octet-stream"


@pytest.mark.parametrize(
    ("path", "near"),
    [
        ("/v1/models/a/versions/1/exports/ply?time=nan", "time_s"),
        ("/v1/models/a/versions/1/exports/ply?time_s=0&time=inf", "time_s"),
        ("/v1/streams/x/snapshots/1f0c9a3b5d7e8f20/exports/ply?Time_s=1", "time"),
        ("/v1/audit?limt=3", "it takes"),
        ("/v1/streams?x=1", "it has none"),
        ("/v1/replays?ticket=x", "it takes"),
        ("/metrics?name[]=up", "it has none"),
        ("/v1/audit?count=1&count=2", "count is given 2 times"),
        ("/v1/models/a/versions/1/exports/ply?time_s=0&time_s=1", "time_s is given 2 times"),
    ],
)
def test_unknown_or_repeated_query_parameter_returns_422(plane, path, near):
    answer = plane.ask("GET", path)
    assert answer.status_code == 422 and near in answer.json()["detail"]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "NaN", "1e400"])
@pytest.mark.parametrize("where", ["models/a/versions/1", "streams/endoscope/snapshots/1f0c9a3b5d7e8f20"])
def test_export_returns_422_for_non_finite_time_s(plane, where, value):
    assert plane.ask("GET", f"/v1/{where}/exports/ply?time_s={value}").status_code == 422


def test_livez_and_readyz_ignore_unknown_parameters(plane):
    assert plane.client.get("/livez?x=1").status_code == 200 == plane.client.get("/readyz?x=1").status_code


def digest(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


def test_slow_uploads_of_one_key_do_not_block_other_keys(new_plane):
    """Two uploads of the operator hang. The operator's third is refused and the administrator's accepted."""

    class SlowModels(FakeModels):
        def __init__(self) -> None:
            super().__init__()
            self.go_on = threading.Event()
            self.inside = threading.Semaphore(0)

        def upload(self, name, file, digest, by):
            if name == "slow":
                self.inside.release()
                assert self.go_on.wait(300)
            return super().upload(name, file, digest, by)

    models = SlowModels()
    plane = new_plane(fake_parts(models=models))

    def put(name: str, role: str):
        headers = {"Content-Type": OCTETS, "Content-Digest": digest(b"GOOD")}
        return plane.ask("PUT", f"/v1/models/{name}/versions", role, content=b"GOOD", headers=headers).status_code

    slow = [threading.Thread(target=put, args=("slow", "operator")) for _ in range(2)]
    for each in slow:
        each.start()
        assert models.inside.acquire(timeout=300)
    assert put("quick", "operator") == 429
    assert put("quick", "admin") == 201
    models.go_on.set()
    for each in slow:
        each.join()
    assert put("quick", "operator") == 201 and not plane.control.uploads_of


@pytest.mark.parametrize("raised", [NotThere, NotNow, OSError], ids=["gone", "files gone", "a bug"])
@pytest.mark.parametrize("deleted", [True, False])
@pytest.mark.parametrize("what", ["models", "recordings"])
def test_deletion_during_upload_check_is_not_logged_as_error(new_plane, caplog, what, deleted, raised):
    base = FakeModels if what == "models" else FakeRecordings
    checked = threading.Event()

    class Deleted(base):
        def check(self, *name):
            if deleted:
                self.delete(*name, *(["system"] if what == "models" else []))
            checked.set()
            raise raised("the files are not there")

    caplog.set_level(logging.INFO)
    plane = new_plane(fake_parts(**{what: Deleted()}))
    path = "/v1/models/liver/versions" if what == "models" else "/v1/recordings/case"
    headers = {"Content-Type": OCTETS, "Content-Digest": digest(b"GOOD")}
    assert plane.ask("PUT", path, content=b"GOOD", headers=headers).status_code == 201
    assert checked.wait(300)
    while plane.control.tasks:
        plane.client.get("/livez")
    errors = [record for record in caplog.records if record.levelno >= logging.ERROR]
    if raised is OSError:
        assert errors[0].exc_info
    elif deleted or raised is NotThere:
        assert deleted == ("was deleted during its check" in caplog.text) or raised is NotThere
        assert not deleted or not errors
    else:
        assert len(errors) == 1 and errors[0].exc_info is None


NOISY = """
import logging, sys, threading, warnings
from services.api.observability import log_to_stderr, say_start
from services.settings import LogSettings
log_to_stderr(LogSettings(format="json", level=sys.argv[1]))
say_start("IntraSplat is on http://127.0.0.1:1/", "a second line")
warnings.warn("a warning\\nof two lines", stacklevel=1)
logging.getLogger("uvicorn.error").error("of uvicorn\\n{not json}")
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
raise KeyError("uncaught")
"""


@pytest.mark.slow
@pytest.mark.parametrize("level", ["info", "error"])
def test_every_stderr_line_is_json_in_json_log_format(level):
    done = subprocess.run([sys.executable, "-W", "always", "-c", NOISY, level], capture_output=True, text=True)
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    said = [line["message"] for line in lines]
    assert said[:2] == ["IntraSplat is on http://127.0.0.1:1/", "a second line"]
    assert "of uvicorn\n{not json}" in said and any("a warning" in each for each in said) == (level == "info")
    assert [line["exception"].splitlines()[-1] for line in lines if "exception" in line] == [
        "ZeroDivisionError: division by zero", "KeyError: 'uncaught'",
    ]  # fmt: skip


def test_relayed_logs_every_line_of_pool_output(caplog):
    caplog.set_level(logging.INFO)

    async def run() -> None:
        reader = asyncio.StreamReader(limit=100)
        lines = [
            b"INFO services.jobs: began\n",
            b"\n",
            b"ERROR x: no\n",
            500 * b"a" + b"\n",
            b"Traceback (most\n",
            b"\xff end",
        ]
        reader.feed_data(b"".join(lines))
        reader.feed_eof()
        await relayed(reader)

    asyncio.run(run())
    levels = [(record.levelname, record.getMessage()[:12]) for record in caplog.records]
    assert levels[:2] == [("INFO", "INFO service"), ("ERROR", "ERROR x: no")] and levels[-1] == ("INFO", "\ufffd end")
    assert ("ERROR", "Traceback (m") in levels


@pytest.mark.parametrize(
    "moment", ["9999-12-31T23:59:59-14:00", "9999-12-31T23:59:59-00:01", "0001-01-01T00:00:00+14:00", "0001-01-01T00:00:00+00:01"]
)  # fmt: skip
def test_timestamps_outside_utc_range_return_422(plane, moment):
    quoted = moment.replace("+", "%2B")
    for path in (f"/v1/audit?since={quoted}", f"/v1/audit?until={quoted}", f"/v1/audit/export?since={quoted}"):
        assert plane.ask("GET", path).status_code == 422, path
    wanted = {"name": "key", "role": "viewer", "expires_at": moment}
    assert plane.ask("POST", "/v1/keys", json=wanted).status_code == 422


@pytest.mark.parametrize(
    "options",
    [{name: value} for name in ("steps_per_frame", "seed", "max_frames", "scale") for value in (True, "1", "nan")]
    + [{"heldout": value} for value in (0, 1, "yes", "true")]
    + [{"steps_per_frame": 1.0}, {"seed": 2.0}],
)
def test_post_replay_does_not_convert_option_types(plane, options):
    answer = plane.ask("POST", "/v1/replays", json={"recording": "case-7", "options": options})
    assert answer.status_code == 422


@pytest.mark.parametrize("name", ["azimuth_deg", "elevation_deg", "zoom"])
@pytest.mark.parametrize("value", [True, "1", None, [], 1e9])
def test_put_camera_returns_422_for_non_numbers(plane, name, value):
    assert plane.ask("PUT", "/v1/streams/endoscope/camera", json={name: value}).status_code == 422
