"""`intrasplat ctl` against a control plane: tables, confirmations, keys, audit log, health and watch."""

from __future__ import annotations

import csv
import io
import json
import os
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest
import uvicorn
from control_fakes import fake_parts, stream_view

from gsplat_core.errors import InvalidSetting
from services.api import new_app
from services.cli import ctl as ctl_module
from services.cli.app import run
from services.cli.ctl import moment, stream_row
from services.cli.terminal import BAD_INPUT, OK, table
from services.client import Client
from services.schemas import CheckResult, StreamView
from services.settings import ServiceSettings

PROCESSES = {
    "capture": {"state": "live", "restarts": 1, "rate_hz": 29.96, "figures": {"frames": 9}},
    "engine": {
        "state": "running", "restarts": 2, "rate_hz": 14.2,
        "figures": {"picture": {"age_ms": 61.25, "psnr_db": 33.1, "previous_frame_psnr_db": 38.02}},
    },
}  # fmt: skip


@pytest.fixture
def service(tmp_path, monkeypatch) -> Iterator[Client]:
    """A listening control plane with in-memory parts, and the environment that `ctl` needs to reach it."""
    for name in [name for name in os.environ if name.startswith("INTRASPLAT_")]:
        monkeypatch.delenv(name)
    parts = fake_parts(checks={"camera": lambda: answered(CheckResult(False, "theatre-1: its source is lost", False))})
    parts.streams.kept["theatre-1"] = stream_view("theatre-1", state="live", processes=PROCESSES)
    app = new_app(ServiceSettings(paths={"data": tmp_path / "data"}), parts)
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None, ws="none"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.005)
    port = server.servers[0].sockets[0].getsockname()[1]
    monkeypatch.setenv("INTRASPLAT_URL", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("INTRASPLAT_KEY_FILE", str(tmp_path / "data" / "admin.key"))
    with Client(f"http://127.0.0.1:{port}", (tmp_path / "data" / "admin.key").read_text()) as client:
        yield client
    server.should_exit = True
    thread.join()


async def answered(result: CheckResult) -> CheckResult:
    return result


@pytest.fixture
def ctl(service, capsys):
    """Return a function that runs a command and returns exit code, standard output and standard error."""

    def call(*arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run(["ctl", *arguments])
        return code, *capsys.readouterr()

    return call


def test_ctl_tables_have_headings_and_aligned_columns(ctl):
    code, out, _ = ctl("streams")
    headings, line = out.splitlines()
    assert code == OK
    for heading, text in (("STREAM", "theatre-1"), ("CAMERA/S", "30.0"), ("SHOWN/S", "14.2"), ("AGE MS", "61.2"), ("RESTARTS", "3")):  # fmt: skip
        assert line[headings.index(heading) :].startswith(text), out
    code, out, _ = ctl("streams", "--json")
    assert json.loads(out)[0]["processes"]["engine"]["restarts"] == 2
    assert ctl("models") == (OK, "MODEL  ACTIVE VERSION\n", ""), "an empty table says what it would hold"
    assert ctl("whoami")[1].splitlines()[1].split()[0] == "admin"


def test_ctl_reads_key_from_flag_then_key_file_then_variable(ctl, service, tmp_path, monkeypatch):
    made = service.make_key("other", "viewer")
    (tmp_path / "other.key").write_text(f"{made.key}\n")
    assert "other" in ctl("whoami", "--key-file", str(tmp_path / "other.key"))[1]
    monkeypatch.setenv("INTRASPLAT_KEY", made.key)
    assert "admin" in ctl("whoami")[1], "the file goes before the variable"
    monkeypatch.delenv("INTRASPLAT_KEY_FILE")
    assert "other" in ctl("whoami")[1]
    monkeypatch.delenv("INTRASPLAT_KEY")
    code, _, err = ctl("whoami")
    assert code == BAD_INPUT and "INTRASPLAT_KEY_FILE" in err
    monkeypatch.setenv("INTRASPLAT_KEY_FILE", str(tmp_path / "none"))
    assert ctl("whoami")[0] == BAD_INPUT


def test_ctl_options_changes_named_options_only_and_prints_those_that_are_set(ctl, service):
    assert json.loads(ctl("options", "theatre-1")[1]) == {}
    assert ctl("options", "theatre-1", "--option", "seed=7", "--option", "tool-mask=none")[0] == OK
    code, out, _ = ctl("options", "theatre-1", "--option", "engine_scale=0.5")
    assert code == OK and json.loads(out) == {"seed": 7, "tool_mask": "none", "engine_scale": 0.5}
    assert service.stream("theatre-1").options == json.loads(out)
    assert json.loads(ctl("options", "theatre-1", "--option", "seed=null")[1]) == {
        "tool_mask": "none",
        "engine_scale": 0.5,
    }
    code, _, err = ctl("options", "theatre-1", "--option", "unknown=1")
    assert code == BAD_INPUT and "nearest" in err


def uploaded(service: Client, tmp_path) -> None:
    (tmp_path / "file").write_bytes(b"GOOD")
    service.checked("liver", service.upload("liver", tmp_path / "file").version)
    service.upload_recording("case-7", tmp_path / "file")


DELETIONS = [
    (("stream", "theatre-1"), "the stream theatre-1", lambda client: [each.name for each in client.streams()]),
    (("version", "liver", "1"), "version 1 of the model liver", lambda client: client.versions("liver")),
    (("recording", "case-7"), "the recording case-7", lambda client: client.recordings()),
]


@pytest.mark.parametrize(("what", "named", "left"), DELETIONS, ids=[what[0] for what, _, _ in DELETIONS])
def test_ctl_delete_asks_for_confirmation(ctl, service, tmp_path, monkeypatch, what, named, left):
    uploaded(service, tmp_path)
    code, out, err = ctl("delete", *what)  # no terminal to ask on
    assert code == BAD_INPUT and "--yes" in err and named in err and left(service)
    monkeypatch.setattr("sys.stdin", Terminal("n\n"))
    code, out, err = ctl("delete", *what)
    assert code == BAD_INPUT and f"Delete {named}?" in err and "nothing was deleted" in err and left(service)
    monkeypatch.setattr("sys.stdin", Terminal("y\n"))
    code, out, err = ctl("delete", *what)
    assert code == OK and out.strip() == f"deleted {named}" and not left(service)
    code, _, err = ctl("delete", *what, "--yes")
    assert code == BAD_INPUT and "404" in err


class Terminal(io.StringIO):
    """Standard input that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.slow
def test_ctl_delete_with_yes_does_not_ask(ctl, service):
    assert ctl("delete", "stream", "theatre-1", "--yes")[0] == OK
    assert service.streams() == []
    for missing in (("replay", 16 * "0"), ("snapshot", "theatre-1", 16 * "0"), ("version", "liver", "7")):
        assert ctl("delete", *missing, "--yes")[0] == BAD_INPUT


@pytest.mark.slow
def test_ctl_keys_add_list_and_revoke(ctl, service):
    code, token, _ = ctl("keys", "add", "wall", "--expires-days", "3", "--stream", "theatre-1")
    assert code == OK
    with Client(service.url, token) as wall:
        assert wall.myself().streams == ["theatre-1"]
    key = next(each for each in service.keys() if each.name == "wall")  # noqa: SIM118
    code, out, _ = ctl("keys", "list")
    assert out.splitlines()[0].split()[:2] == ["ID", "ROLE"] and token.strip() not in out
    assert key.id in out and "theatre-1" in out
    assert ctl("keys", "revoke", key.id)[0] == BAD_INPUT, "it asks, and nobody is there"
    assert ctl("keys", "revoke", key.id, "--yes")[0] == OK
    assert key.id not in ctl("keys", "list")[1]
    assert ctl("keys", "revoke", key.id, "--yes")[0] == BAD_INPUT
    assert ctl("keys", "add", "wall", "--role", "king")[0] == BAD_INPUT
    assert ctl("keys", "add", "wall", "--expires-days", "nan")[0] == BAD_INPUT


def test_ctl_audit_filters_and_formats_entries(ctl, service):
    for number in range(3):
        service.revoke_key(service.make_key(f"key-{number}", "viewer").id)
    code, out, _ = ctl("audit", "--event", "key.create", "--count", "2")
    headings, *lines = out.splitlines()
    assert code == OK and headings.split()[:3] == ["NUMBER", "WHEN", "ACTION"]
    assert ["key-1" in lines[0], "key-2" in lines[1], len(lines)] == [True, True, 2], (
        "the newest two, the older one first"
    )
    assert datetime.now().astimezone().strftime("%z") in lines[0]
    code, out, _ = ctl("audit", "--format", "csv", "--subject", "key-1")
    (row,) = csv.DictReader(io.StringIO(out))
    assert row["event"] == "key.create"
    code, out, _ = ctl("audit", "--format", "jsonl", "--since", "1h")
    assert [json.loads(line)["event"] for line in out.splitlines()].count("key.revoke") == 3
    assert ctl("audit", "--until", "1h", "--format", "jsonl")[1] == ""
    assert ctl("audit", "--outcome", "well")[0] == BAD_INPUT
    assert ctl("audit", "--format", "xml")[0] == BAD_INPUT
    assert ctl("audit", "--since", "soon")[0] == BAD_INPUT


def test_ctl_audit_follow_prints_new_entries_once(ctl, service, monkeypatch, capsys):
    class Enough(Exception):
        """Raised to end following the audit log."""

    looks = 0

    def sleep(_: float) -> None:
        nonlocal looks
        looks += 1
        if looks == 4:
            raise Enough
        service.make_key(f"new-{looks}", "viewer")

    monkeypatch.setattr(ctl_module.time, "sleep", sleep)
    service.make_key("old", "viewer")
    with pytest.raises(Enough):
        ctl_module._show_audit(service, {"event": "key.create"}, 1, True)
    lines = [line for line in capsys.readouterr().out.splitlines() if "key.create" in line]
    assert [next(name for name in ("old", "new-1", "new-2", "new-3") if name in line) for line in lines] == ["old", "new-1", "new-2", "new-3"]  # fmt: skip


def test_ctl_watch_and_health_show_failing_check_and_streams(ctl):
    code, out, _ = ctl("watch", "--looks", "2", "--every", "0.2")
    assert code == OK and out.count("theatre-1") == 4, (
        "a line for the check that is not well, and one for the stream, twice"
    )
    assert "degraded" in out and "camera: theatre-1: its source is lost" in out
    assert "38.0" in out and "TRAINING PSNR DB" in out and "\x1b" not in out
    assert ctl("watch", "nowhere", "--looks", "1")[0] == BAD_INPUT
    code, out, _ = ctl("health")
    assert code == OK and out.startswith("the service is degraded")
    assert json.loads(ctl("health", "--json")[1])["checks"]["camera"]["ok"] is False


def test_ctl_watch_continues_after_failed_poll(service, monkeypatch, capsys):
    real, looks = ctl_module._status, 0

    def sometimes(client, stream):
        nonlocal looks
        looks += 1
        if looks == 2:
            return real(Client("http://127.0.0.1:1", "x"), stream)
        return real(client, stream)

    monkeypatch.setattr(ctl_module, "_status", sometimes)
    assert run(["ctl", "watch", "--looks", "3", "--every", "0.2"]) == OK
    out = capsys.readouterr().out
    assert out.count("STREAM ") == 2 and out.count("no answer since the last query") == 1


def test_client_ready_returns_degraded_status(service, monkeypatch):
    assert service.ready().status == "degraded"


@pytest.mark.parametrize(("text", "ago"), [("90s", 90), ("30m", 1800), ("2h", 7200), ("7d", 604800)])
def test_moment_parses_span_as_time_ago(text, ago):
    assert abs((datetime.now(UTC) - timedelta(seconds=ago)) - moment(text)) < timedelta(seconds=5)


def test_moment_reads_time_without_zone_as_local():
    assert moment("2026-11-23T20:30:00+01:00") == datetime(2026, 11, 23, 19, 30, tzinfo=UTC)
    assert moment("2026-11-23T20:30:00") == datetime(2026, 11, 23, 20, 30).astimezone(UTC)
    assert moment(None) is None
    for bad in ("", "soon", "-2h", "2 h", "999999d", "2026-13-01"):
        with pytest.raises(InvalidSetting):
            moment(bad)


@pytest.mark.parametrize(
    "processes",
    [{}, {"engine": {}}, {"engine": {"figures": None}}, {"engine": {"figures": {"picture": 3}, "restarts": "many"}}, {"capture": {"rate_hz": "fast"}}],
)  # fmt: skip
def test_stream_row_handles_missing_or_malformed_figures(processes):
    view = StreamView(name="a", source="b", show="live", device="cpu", options={}, state="stopped", processes=processes)
    row = stream_row(view)
    assert row["name"] == "a" and row["age_ms"] is None and row["capture_hz"] is None


def test_table_cells_are_single_line_without_control_characters():
    lines = table(
        {"a": "A", "b.c": "B", "d": "D"}, [{"a": "x\x1b[2J\ny", "b": {"c": 70 * "z"}, "d": None}, {"a": 1, "b": 2}]
    )
    assert len(lines) == 3 and "\x1b" not in "".join(lines)
    assert "D" not in lines[0], "a column without a value is left out"
    assert table({"a": "A", "b": "B"}, []) == ["A  B"]
    assert table({"size_bytes": "SIZE"}, [{"size_bytes": 2048}, {"size_bytes": 3}]) == ["SIZE", "2.0 KiB", "3 B"]
