"""`intrasplat schema`, `keys` and `audit verify`."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime, timedelta
from functools import partial

import pytest

from services.audit import AuditLog, Wanted, search
from services.auth.keys import KeyStore
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch):
    for name in [name for name in os.environ if name.startswith("INTRASPLAT_")]:
        monkeypatch.delenv(name)


def test_schema_command_prints_json(capsys):
    assert run(["schema"]) == OK
    assert "streams" in json.loads(capsys.readouterr().out)["properties"]


def test_keys_command_adds_lists_and_revokes_keys(tmp_path, capsys):
    data = ["--data", str(tmp_path)]
    assert run(["keys", "add", "console", "--role", "admin", *data]) == OK
    token = capsys.readouterr().out.strip()
    assert KeyStore(tmp_path / "keys.json").find(token) is not None
    assert run(["keys", "add", "wall", *data]) == OK
    capsys.readouterr()
    assert run(["keys", "list", "--json", *data]) == OK
    out = capsys.readouterr().out
    assert token not in out and "sha256" not in out
    listed = {key["name"]: key for key in json.loads(out)}
    assert {name: key["role"] for name, key in listed.items()} == {"console": "admin", "wall": "viewer"}
    assert run(["keys", "list", *data]) == OK
    assert "wall" in capsys.readouterr().out
    assert run(["keys", "revoke", listed["wall"]["id"], *data]) == OK
    assert run(["keys", "revoke", listed["wall"]["id"], *data]) == BAD_INPUT
    assert run(["keys", "revoke", listed["console"]["id"], *data]) == BAD_INPUT
    assert "only administrator" in capsys.readouterr().err
    log = AuditLog(tmp_path / "audit.jsonl")
    said = [
        (entry.event, entry.actor, entry.subject, entry.detail["role"])
        for entry in reversed(search(log.path, Wanted(), 9).entries)
    ]
    log.close()
    assert said == [
        ("key.create", "shell", "console", "admin"),
        ("key.create", "shell", "wall", "viewer"),
        ("key.revoke", "shell", listed["wall"]["id"], "viewer"),
    ]


def test_running_server_audits_key_added_by_shell(tmp_path, capsys):
    from services.auth.keys import changed_outside

    server = AuditLog(tmp_path / "audit.jsonl")
    keys = KeyStore(tmp_path / "keys.json")
    keys.watch(partial(changed_outside, server))
    assert run(["keys", "add", "console", "--data", str(tmp_path)]) == OK
    assert search(server.path, Wanted(), 9).entries == []
    keys.all()
    (entry,) = search(server.path, Wanted(), 9).entries
    server.close()
    assert (entry.event, entry.actor, entry.subject) == ("key.create", "shell", "console")
    assert entry.detail["key_id"] in capsys.readouterr().out


def test_keys_add_with_expiry_and_streams(tmp_path, capsys):
    data = ["--data", str(tmp_path)]
    assert run(["keys", "add", "boss", "--role", "admin", *data]) == OK
    assert run(["keys", "add", "wall", "--expires-days", "1.5", "--stream", "b", "--stream", "a", *data]) == OK
    capsys.readouterr()
    assert run(["keys", "list", "--json", *data]) == OK
    boss, wall = json.loads(capsys.readouterr().out)
    assert wall["streams"] == ["a", "b"] and boss["streams"] is None and boss["expires_at"] is None
    left_s = datetime.fromisoformat(wall["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=1.4) < left_s < timedelta(days=1.6)
    assert (wall["expired"], wall["last_used_at"]) == (False, None)
    KeyStore(tmp_path / "keys.json").note_use(wall["id"])
    assert run(["keys", "list", *data]) == OK
    headings, *lines = capsys.readouterr().out.splitlines()
    assert headings.split() == ["ID", "ROLE", "CREATED", "EXPIRES", "EXPIRED", "LAST", "USED", "STREAMS", "NAME"]
    assert [line.index(name) for line, name in zip(lines, ("boss", "wall"), strict=True)] == 2 * [
        headings.index("NAME")
    ]
    assert "a, b" in lines[1] and "never" in lines[0]


@pytest.mark.parametrize("days", ["0", "-1", "nan", "inf", "1e300", "1e-9"])
def test_keys_add_refuses_invalid_expiry(tmp_path, capsys, days):
    assert run(["keys", "add", "wall", "--expires-days", days, "--data", str(tmp_path)]) == BAD_INPUT
    assert "cannot expire" in capsys.readouterr().err
    assert KeyStore(tmp_path / "keys.json").all() == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["Console"], "is no name of a key"), (["wall", "--stream", "a/b"], "is no name of a stream"), (["a/b"], "is no name of a key"), (["console", "--role", "public"], "choose viewer")],
)  # fmt: skip
def test_keys_add_refuses_invalid_names_and_role(tmp_path, capsys, arguments, said):
    assert run(["keys", "add", *arguments, "--data", str(tmp_path)]) == BAD_INPUT
    assert said in capsys.readouterr().err


def test_audit_verify_detects_missing_entries_and_wrong_head(tmp_path, capsys):
    log = AuditLog(tmp_path / "audit.jsonl")
    for number in range(3):
        log.append("model.activate", actor="console", subject=str(number))
    log.close()
    path = str(log.path)
    assert run(["audit", "verify", path]) == OK
    said = capsys.readouterr().out
    assert "3 entries, intact" in said
    digest = said.split()[-1]
    assert run(["audit", "verify", path, "--head", digest]) == OK
    assert run(["audit", "verify", path, "--head", 64 * "0"]) == BAD_INPUT
    capsys.readouterr()
    lines = log.path.read_bytes().splitlines(keepends=True)
    log.path.write_bytes(lines[0] + lines[2])
    assert run(["audit", "verify", path]) == BAD_INPUT
    assert "line 2: 1 entries are missing" in capsys.readouterr().out
    assert run(["audit", "verify", path, "--json"]) == BAD_INPUT
    assert json.loads(capsys.readouterr().out)["intact"] is False
    assert run(["audit", "verify", str(tmp_path / "none")]) == BAD_INPUT
    assert "No such file" in capsys.readouterr().err
