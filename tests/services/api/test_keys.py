"""API keys and tickets."""

from __future__ import annotations

import json
import re
import stat
from datetime import UTC, datetime, timedelta

import pytest
from control_fakes import FakeDisplay, fake_parts
from fastapi.routing import iter_route_contexts
from starlette.testclient import WebSocketDenialResponse

from services.api.guard import rule_of, still_valid
from services.audit import Wanted, search
from services.auth import keys as keys_module
from services.auth.keys import Caller, KeyConflict, KeyStore, Role, Tickets, first_admin_key


def test_key_store_keeps_only_digest_of_key(tmp_path):
    store = KeyStore(tmp_path / "keys.json")
    key, token = store.create("console", Role.VIEWER)
    text = (tmp_path / "keys.json").read_text()
    assert token not in text and token.split("_", 2)[2] not in text
    assert stat.S_IMODE((tmp_path / "keys.json").stat().st_mode) == 0o600
    assert store.find(token) == key == KeyStore(tmp_path / "keys.json").find(token)


@pytest.mark.parametrize("change", [str.upper, lambda t: t[:-1], lambda t: t + "x", lambda t: "x" + t, lambda t: ""])
def test_find_returns_none_for_altered_token(tmp_path, change):
    store = KeyStore(tmp_path / "keys.json")
    _, token = store.create("console", Role.VIEWER)
    assert store.find(change(token)) is None


def test_key_store_allows_two_keys_per_name_with_same_role(tmp_path):
    store = KeyStore(tmp_path / "keys.json")
    first, old = store.create("console", Role.VIEWER)
    _, new = store.create("console", Role.VIEWER)
    assert store.find(old) and store.find(new)
    with pytest.raises(KeyConflict, match="console has 2 keys"):
        store.create("console", Role.VIEWER)
    store.revoke(first.id)
    assert store.find(old) is None and store.find(new)
    with pytest.raises(KeyConflict, match="role viewer"):
        store.create("console", Role.OPERATOR)


def test_key_store_sees_changes_by_another_process(tmp_path):
    here, there = KeyStore(tmp_path / "keys.json"), KeyStore(tmp_path / "keys.json")
    key, token = there.create("console", Role.VIEWER)
    assert here.find(token) == key
    there.create("other", Role.VIEWER)
    there.revoke(key.id)
    assert here.find(token) is None


def test_key_store_watch_reports_only_changes_by_other_processes(tmp_path):
    here, there = KeyStore(tmp_path / "keys.json"), KeyStore(tmp_path / "keys.json")
    there.create("earlier", Role.VIEWER)
    changes = []
    here.watch(lambda event, key: changes.append((event, key.name)))
    mine, _ = here.create("mine", Role.OPERATOR)
    theirs, _ = there.create("theirs", Role.VIEWER)
    there.revoke(mine.id)
    assert changes == []
    assert len(here.all()) == 2 and here.all()
    assert changes == [("key.create", "theirs"), ("key.revoke", "mine")]
    there.create("again", Role.VIEWER)
    here.revoke(theirs.id)  # sees the other one before it changes anything
    assert changes[2:] == [("key.create", "again")] and len(there.all()) == 2


def test_last_admin_key_cannot_be_revoked(tmp_path):
    store = KeyStore(tmp_path / "keys.json")
    key, _ = store.create("admin", Role.ADMIN)
    with pytest.raises(KeyConflict, match="only administrator"):
        store.revoke(key.id)


def test_first_admin_key_is_created_once_or_read_from_file(tmp_path):
    store, file = KeyStore(tmp_path / "keys.json"), tmp_path / "admin.key"
    assert first_admin_key(store, file) and not first_admin_key(store, file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    found = store.find(file.read_text().strip())
    assert found is not None and found.role is Role.ADMIN

    given = KeyStore(tmp_path / "given.json")
    assert not first_admin_key(given, file)  # as a mounted secret would be
    assert given.find(file.read_text().strip()) is not None
    (tmp_path / "weak").write_text("intrasplat_12345678_short")
    with pytest.raises(KeyConflict, match="32 characters"):
        first_admin_key(KeyStore(tmp_path / "weak.json"), tmp_path / "weak")


def test_tickets_are_valid_once_for_one_path_until_expiry():
    now_s = [0.0]
    tickets = Tickets(30.0, clock=lambda: now_s[0])
    caller = Caller("console", "1", Role.VIEWER)
    ticket = tickets.give(caller, "/v1/a")
    assert tickets.use(ticket, "/v1/a") == caller
    assert tickets.use(ticket, "/v1/a") is None
    assert tickets.use(tickets.give(caller, "/v1/a"), "/v1/b") is None
    late = tickets.give(caller, "/v1/a")
    now_s[0] = 31.0
    assert tickets.use(late, "/v1/a") is None


def test_expired_unused_tickets_are_removed():
    now_s = [0.0]
    tickets = Tickets(30.0, clock=lambda: now_s[0])
    for _ in range(100):
        tickets.give(Caller("console", "1", Role.VIEWER), "/v1/a")
    now_s[0] = 31.0
    tickets.give(Caller("console", "1", Role.VIEWER), "/v1/a")
    assert len(tickets._waiting) == 1


def test_keys_api_creates_lists_and_revokes_keys_with_audit_entries(plane):
    made = plane.ask("POST", "/v1/keys", json={"name": "theatre-1", "role": "operator"})
    assert made.status_code == 201
    token = made.json()["key"]
    assert plane.client.get("/v1/version", headers={"Authorization": f"Bearer {token}"}).status_code == 200
    listed = plane.ask("GET", "/v1/keys")
    assert token not in listed.text and "sha256" not in listed.text
    assert {"test-viewer", "theatre-1", "admin"} <= {key["name"] for key in listed.json()}
    assert plane.ask("DELETE", f"/v1/keys/{made.json()['id']}").status_code == 204
    assert plane.client.get("/v1/version", headers={"Authorization": f"Bearer {token}"}).status_code == 401
    assert plane.ask("DELETE", f"/v1/keys/{made.json()['id']}").status_code == 404
    admin = next(key["id"] for key in listed.json() if key["name"] == "admin")
    assert plane.ask("DELETE", f"/v1/keys/{admin}").status_code == 409
    assert plane.ask("POST", "/v1/keys", json={"name": "x", "role": "public"}).status_code == 422
    assert [event for event in plane.events() if event[0].startswith("key.")] == [
        ("key.create", "admin", "done"),
        ("key.create", "theatre-1", "done"),
        ("key.revoke", made.json()["id"], "done"),
        ("key.revoke", admin, "refused"),
    ]
    assert token not in plane.control.audit.path.read_text()


def test_ticket_is_invalid_after_its_key_is_revoked(plane):
    path = "/v1/streams/endoscope/mjpeg"
    ticket = plane.ask("POST", "/v1/tickets", "viewer", json={"path": path}).json()["ticket"]
    viewer = next(key["id"] for key in plane.ask("GET", "/v1/keys").json() if key["name"] == "test-viewer")
    assert plane.ask("DELETE", f"/v1/keys/{viewer}").status_code == 204
    answer = plane.client.get(path, params={"ticket": ticket})
    assert answer.status_code == 401 and "ticket" in answer.json()["detail"]


def test_find_compares_every_token_by_compare_digest(tmp_path, monkeypatch):
    """Known and unknown keys are compared in constant time."""
    from services.auth import keys

    compared = []
    real = keys.hmac.compare_digest
    monkeypatch.setattr(keys.hmac, "compare_digest", lambda a, b: compared.append((len(a), len(b))) or real(a, b))
    store = KeyStore(tmp_path / "keys.json")
    _, token = store.create("console", Role.VIEWER)
    for guess in (token[:-1] + "!", "intrasplat_00000000_" + 43 * "a", "nonsense", ""):
        assert store.find(guess) is None
    assert compared == 4 * [(64, 64)]


@pytest.fixture
def clock(monkeypatch):
    """Return a function that sets the wall clock of the keys forward, such as `clock(days=3)`."""

    class Clock(datetime):
        ahead = timedelta()

        @classmethod
        def now(cls, tz=None):
            return datetime.now(tz) + cls.ahead

    monkeypatch.setattr(keys_module, "datetime", Clock)
    return lambda **ahead: setattr(Clock, "ahead", timedelta(**ahead))


def in_days(days: float) -> datetime:
    return datetime.now(UTC) + timedelta(days=days)


def test_find_returns_none_after_key_expiry(tmp_path, clock):
    store = KeyStore(tmp_path / "keys.json")
    key, token = store.create("wall", Role.VIEWER, expires_at=in_days(2))
    assert store.find(token) == key and store.expired(token) is None and store.get(key.id) == key
    clock(days=1.9)
    assert store.find(token) == key == KeyStore(tmp_path / "keys.json").find(token)
    clock(days=2.1)
    assert store.find(token) is None and KeyStore(tmp_path / "keys.json").find(token) is None
    assert store.expired(token) == key and store.get(key.id) is None
    assert store.all() == [key], "an expired key stays listed until it is revoked"
    assert store.expired(token[:-1] + ("a" if token[-1] != "a" else "b")) is None, "only its owner learns of it"


def test_expired_keys_do_not_count_as_name_or_admin_keys(tmp_path, clock):
    store = KeyStore(tmp_path / "keys.json")
    admin, _ = store.create("admin", Role.ADMIN)
    for _ in range(2):
        store.create("wall", Role.VIEWER, expires_at=in_days(1))
    store.create("short", Role.ADMIN, expires_at=in_days(1))
    with pytest.raises(KeyConflict, match="wall has 2 keys"):
        store.create("wall", Role.VIEWER)
    clock(days=2)
    store.create("wall", Role.OPERATOR)
    with pytest.raises(KeyConflict, match="only administrator"):
        store.revoke(admin.id)


@pytest.mark.parametrize(
    ("wish", "said"),
    [
        ({"expires_at": in_days(-1)}, "a time to come"),
        ({"expires_at": datetime(2999, 1, 1)}, "with its zone"),
        ({"streams": []}, "1 to 100"),
        ({"streams": [f"s{n}" for n in range(101)]}, "1 to 100"),
    ],
)
def test_create_raises_for_invalid_expiry_or_streams(tmp_path, wish, said):
    with pytest.raises(KeyConflict, match=said):
        KeyStore(tmp_path / "keys.json").create("wall", Role.VIEWER, **wish)


def test_create_raises_for_admin_key_limited_to_streams(tmp_path):
    with pytest.raises(KeyConflict, match="not limited to streams"):
        KeyStore(tmp_path / "keys.json").create("admin", Role.ADMIN, streams=["theatre-1"])


def test_key_file_omits_unset_expiry_and_streams(tmp_path):
    file = tmp_path / "keys.json"
    _, token = KeyStore(file).create("console", Role.VIEWER)
    (kept,) = json.loads(file.read_text())["keys"]
    assert set(kept) == {"id", "name", "role", "sha256", "created_at"}
    found = KeyStore(file).find(token)
    assert found is not None and (found.expires_at, found.streams) == (None, None)


@pytest.mark.parametrize(
    "change", [{"only_on_mondays": True}, {"expires_at": "soon"}, {"expires_at": "2099-01-01T00:00:00"}]
)
def test_find_raises_for_key_entry_with_unknown_limit(tmp_path, change):
    file = tmp_path / "keys.json"
    _, token = KeyStore(file).create("console", Role.VIEWER)
    kept = json.loads(file.read_text())
    kept["keys"][0].update(change)
    file.write_text(json.dumps(kept))
    with pytest.raises((TypeError, ValueError)):
        KeyStore(file).find(token)


def test_last_use_of_keys_is_written_once_per_minute(tmp_path, monkeypatch):
    passed_s = [1000.0]
    monkeypatch.setattr(keys_module.time, "monotonic", lambda: passed_s[0])
    file, used = tmp_path / "keys.json", tmp_path / "keys.used.json"
    store = KeyStore(file)
    (one, _), (two, _) = store.create("one", Role.VIEWER), store.create("two", Role.VIEWER)
    before = file.stat()
    assert store.last_used() == {}
    store.save_used()
    assert not used.exists()
    store.note_use(one.id)
    store.save_used()
    assert set(json.loads(used.read_text())) == {one.id} == set(KeyStore(file).last_used())
    assert stat.S_IMODE(used.stat().st_mode) == 0o600
    store.note_use(two.id)
    passed_s[0] += 59
    store.save_used()
    assert set(json.loads(used.read_text())) == {one.id}
    passed_s[0] += 2
    store.save_used()
    assert set(json.loads(used.read_text())) == {one.id, two.id}
    store.revoke(two.id)
    store.save_used(now=True)
    assert set(json.loads(used.read_text())) == {one.id}
    assert (file.stat().st_ino, len(store.all())) != (before.st_ino, 2), "revoking has written the keys"


@pytest.mark.parametrize("damage", ["", "{", "[]", "null"])
def test_damaged_last_use_file_does_not_invalidate_keys(tmp_path, damage):
    file = tmp_path / "keys.json"
    key, token = KeyStore(file).create("console", Role.VIEWER)
    (tmp_path / "keys.used.json").write_text(damage)
    store = KeyStore(file)
    assert store.find(token) == key and store.last_used() == {}
    store.note_use(key.id)
    store.save_used(now=True)
    assert set(store.last_used()) == {key.id}


@pytest.mark.parametrize("damage", ["", "{", "[]", "null", "[" * 5000, None])
def test_damaged_key_file_returns_503_and_service_is_not_ready(plane, damage):
    file = plane.control.settings.data_dir / "keys.json"
    whole = file.read_text()
    file.unlink()
    if damage is None:
        file.mkdir()
    else:
        file.write_text(damage)
    answer = plane.ask("GET", "/v1/me")
    assert answer.status_code == 503 and "the file of the API keys cannot be read" in answer.json()["detail"]
    assert str(file) not in answer.text, "this caller is not authenticated"
    ready = plane.client.get("/readyz?verbose")
    assert (ready.status_code, ready.json()["checks"]["keys"]["ok"]) == (503, False)
    if damage is None:
        file.rmdir()
    file.write_text(whole)
    assert plane.ask("GET", "/v1/me").status_code == 200
    assert plane.client.get("/readyz").status_code == 200


def test_save_used_logs_full_disk_and_keeps_keys_valid(tmp_path, monkeypatch, caplog):
    store = KeyStore(tmp_path / "keys.json")
    key, token = store.create("console", Role.VIEWER)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(keys_module, "_write_json", full)
    store.note_use(key.id)
    store.save_used(now=True)
    assert store.find(token) == key and set(store.last_used()) == {key.id}
    assert "No space left" in caplog.text


def test_keys_api_reports_expiry_and_last_use(plane, clock):
    made = plane.ask("POST", "/v1/keys", json={"name": "wall", "role": "viewer", "expires_at": in_days(3).isoformat()})
    assert made.status_code == 201
    assert made.json()["expires_at"].endswith("+00:00") and not made.json()["expired"]

    def listed():
        return next(key for key in plane.ask("GET", "/v1/keys").json() if key["name"] == "wall")

    assert listed()["last_used_at"] is None
    headers = {"Authorization": f"Bearer {made.json()['key']}"}
    said = plane.client.get("/v1/me", headers=headers).json()
    assert (said["name"], said["role"], said["streams"]) == ("wall", "viewer", None)
    assert said["expires_at"] == made.json()["expires_at"]
    assert datetime.fromisoformat(listed()["last_used_at"]).tzinfo is not None
    clock(days=4)
    answer = plane.client.get("/v1/me", headers=headers)
    assert answer.status_code == 401 and "has expired at" in answer.json()["detail"]
    assert listed()["expired"] is True
    (entry,) = [each for each in search(plane.control.audit.path, Wanted(), 20).entries if each.subject == "wall"]
    assert entry.detail["expires_at"] == made.json()["expires_at"]


@pytest.mark.parametrize(
    "wish",
    [
        {"expires_at": "2020-01-01T00:00:00Z"},
        {"expires_at": "2999-01-01T00:00:00"},
        {"expires_at": "never"},
        {"expires_at": 9_999_999_999},
        {"expires_at": "9999999999"},
        {"streams": []},
        {"streams": ["A/B"]},
        {"streams": "theatre-1"},
        {"last_used_at": "2999-01-01T00:00:00Z"},
    ],
)
def test_post_keys_returns_422_for_invalid_expiry_or_streams(plane, wish):
    assert plane.ask("POST", "/v1/keys", json={"name": "wall", "role": "viewer", **wish}).status_code == 422


def test_ticket_is_invalid_after_its_key_expires(plane, clock):
    made = plane.ask("POST", "/v1/keys", json={"name": "wall", "role": "viewer", "expires_at": in_days(1).isoformat()})
    path = "/v1/streams/endoscope/mjpeg"
    headers = {"Authorization": f"Bearer {made.json()['key']}"}
    ticket = plane.client.post("/v1/tickets", json={"path": path}, headers=headers).json()["ticket"]
    clock(days=2)
    assert plane.client.get(path, params={"ticket": ticket}).status_code == 401


def test_still_valid_is_false_after_key_expiry_or_revocation(plane, clock):
    made = plane.ask("POST", "/v1/keys", json={"name": "wall", "role": "viewer", "expires_at": in_days(1).isoformat()})
    caller = Caller("wall", made.json()["id"], Role.VIEWER)
    person = Caller("someone", "oidc-1", Role.VIEWER, federated=True)
    assert still_valid(plane.control, caller) and still_valid(plane.control, person)
    clock(days=2)
    assert not still_valid(plane.control, caller) and still_valid(plane.control, person)
    clock(days=0)
    assert still_valid(plane.control, caller)
    plane.control.keys.revoke(caller.key_id)
    assert not still_valid(plane.control, caller)


@pytest.fixture
def limited(new_plane):
    """A server with two streams, and headers of an operator's and a viewer's key limited to the first."""
    plane = new_plane(fake_parts(display=FakeDisplay(most=2)))
    for name in ("theatre-1", "theatre-2"):
        assert plane.ask("POST", "/v1/streams", json={"name": name, "source": "synthetic:"}).status_code == 201
    headers = {}
    for role in ("viewer", "operator"):
        made = plane.ask(
            "POST", "/v1/keys", json={"name": f"room-{role}", "role": role, "streams": ["theatre-1", "new"]}
        )
        assert made.json()["streams"] == ["new", "theatre-1"]
        headers[role] = {"Authorization": f"Bearer {made.json()['key']}"}
    return plane, headers


OPEN_TO_LIMITED_KEYS = {("GET", "/v1/streams"), ("POST", "/v1/streams"), ("POST", "/v1/tickets"), ("GET", "/v1/version"), ("GET", "/v1/me")}  # fmt: skip


def test_limited_key_gets_403_on_routes_beyond_its_streams(limited):
    """Checks every route; new routes refuse limited keys by default."""
    plane, headers = limited
    looked_at = 0
    for route in iter_route_contexts(plane.app.routes):
        if getattr(route, "endpoint", None) is None or rule_of(route.endpoint).role is Role.PUBLIC:
            continue
        of_a_stream = route.path.startswith("/v1/streams/{name}")
        assert (rule_of(route.endpoint).scope == "stream") == of_a_stream, route.path
        path = re.sub(r"\{\w+\}", "1", route.path.replace("{name}", "theatre-2"))
        for method in getattr(route, "methods", None) or ():
            answer = plane.client.request(method, path, headers=headers["operator"])
            looked_at += 1
            if (method, route.path) in OPEN_TO_LIMITED_KEYS:
                assert answer.status_code != 403, (method, path)
            else:
                assert answer.status_code == 403, (method, path)
    assert looked_at > 35


def test_limited_key_lists_starts_and_creates_only_its_streams(limited):
    plane, headers = limited

    def ask(method, path, role="operator", **options):
        return plane.client.request(method, path, headers=headers[role], **options)

    assert [each["name"] for each in ask("GET", "/v1/streams").json()] == ["theatre-1"]
    assert ask("GET", "/v1/streams/theatre-1").status_code == 200
    assert ask("POST", "/v1/streams/theatre-1/start").json()["state"] == "live"
    refused = ask("GET", "/v1/streams/theatre-2")
    assert refused.status_code == 403 and "limited to the streams new, theatre-1" in refused.json()["detail"]
    assert ask("GET", "/v1/streams/nowhere").status_code == 403, "it does not tell which streams there are"
    assert ask("GET", "/v1/me").json()["streams"] == ["new", "theatre-1"]
    wanted = {"source": "synthetic:", "start": False}
    refused = ask("POST", "/v1/streams", json={"name": "new", "show": "model liver", **wanted})
    assert refused.status_code == 403 and "sees no models" in refused.json()["detail"]
    assert ask("POST", "/v1/streams", json={"name": "new", **wanted}).status_code == 201
    assert ask("POST", "/v1/streams", json={"name": "other", **wanted}).status_code == 403
    assert ask("POST", "/v1/streams", "viewer", json={"name": "new", **wanted}).status_code == 403
    refused = ask("POST", "/v1/streams/theatre-1/snapshots", json={"model": "liver"})
    assert refused.status_code == 403 and "as a file" in refused.json()["detail"]


@pytest.mark.parametrize("by_ticket", [True, False])
def test_limited_key_gets_403_for_pictures_of_other_streams(limited, by_ticket):
    plane, headers = limited

    def access(path):
        if not by_ticket:
            return {"headers": headers["viewer"]}
        asked = plane.client.post("/v1/tickets", json={"path": path}, headers=headers["viewer"])
        return {"params": {"ticket": asked.json()["ticket"]}}

    def socket(path):
        given = access(path)
        query = f"?ticket={given['params']['ticket']}" if by_ticket else ""
        return plane.client.websocket_connect(path + query, headers=given.get("headers", {}))

    mine, other = "/v1/streams/theatre-1", "/v1/streams/theatre-2"
    assert plane.client.get(f"{mine}/mjpeg", **access(f"{mine}/mjpeg")).status_code == 200
    assert plane.client.get(f"{other}/mjpeg", **access(f"{other}/mjpeg")).status_code == 403
    with socket(f"{mine}/display") as opened:
        assert opened.receive_bytes()
    with pytest.raises(WebSocketDenialResponse) as refused, socket(f"{other}/display"):
        pass
    assert refused.value.status_code == 403
    with pytest.raises(WebSocketDenialResponse) as refused, socket("/v1/replays/1f0c9a3b5d7e8f20/progress"):
        pass
    assert refused.value.status_code == 403
    assert {stream for stream, _, _ in plane.parts.display.asked} == {"theatre-1"}
