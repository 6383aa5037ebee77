"""API keys and tickets."""

from __future__ import annotations

import stat

import pytest

from services.control.auth.keys import KeyConflict, KeyStore, first_admin_key
from services.control.auth.roles import Caller, Role
from services.control.auth.tickets import Tickets


def test_only_the_digest_of_a_key_is_kept(tmp_path):
    store = KeyStore(tmp_path / "keys.json")
    key, token = store.create("console", Role.VIEWER)
    text = (tmp_path / "keys.json").read_text()
    assert token not in text and token.split("_", 2)[2] not in text
    assert stat.S_IMODE((tmp_path / "keys.json").stat().st_mode) == 0o600
    assert store.find(token) == key == KeyStore(tmp_path / "keys.json").find(token)


@pytest.mark.parametrize("change", [str.upper, lambda t: t[:-1], lambda t: t + "x", lambda t: "x" + t, lambda t: ""])
def test_what_is_nearly_a_key_is_none(tmp_path, change):
    store = KeyStore(tmp_path / "keys.json")
    _, token = store.create("console", Role.VIEWER)
    assert store.find(change(token)) is None


def test_two_keys_of_a_name_for_rotation(tmp_path):
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


def test_another_process_changes_the_keys(tmp_path):
    here, there = KeyStore(tmp_path / "keys.json"), KeyStore(tmp_path / "keys.json")
    key, token = there.create("console", Role.VIEWER)
    assert here.find(token) == key
    there.create("other", Role.VIEWER)
    there.revoke(key.id)
    assert here.find(token) is None


def test_only_changes_by_another_process_are_told(tmp_path):
    here, there = KeyStore(tmp_path / "keys.json"), KeyStore(tmp_path / "keys.json")
    there.create("earlier", Role.VIEWER)
    told = []
    here.watch(lambda event, key: told.append((event, key.name)))
    mine, _ = here.create("mine", Role.OPERATOR)
    theirs, _ = there.create("theirs", Role.VIEWER)
    there.revoke(mine.id)
    assert told == []
    assert len(here.all()) == 2 and here.all()
    assert told == [("key.create", "theirs"), ("key.revoke", "mine")]
    there.create("again", Role.VIEWER)
    here.revoke(theirs.id)  # sees the other one before it changes anything
    assert told[2:] == [("key.create", "again")] and len(there.all()) == 2


def test_the_last_administrator_stays(tmp_path):
    store = KeyStore(tmp_path / "keys.json")
    key, _ = store.create("admin", Role.ADMIN)
    with pytest.raises(KeyConflict, match="only administrator"):
        store.revoke(key.id)


def test_the_first_key_is_made_once_or_taken_from_a_secret(tmp_path):
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


def test_a_ticket_is_good_once_for_one_path_and_for_a_while():
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


def test_tickets_that_nobody_uses_are_forgotten():
    now_s = [0.0]
    tickets = Tickets(30.0, clock=lambda: now_s[0])
    for _ in range(100):
        tickets.give(Caller("console", "1", Role.VIEWER), "/v1/a")
    now_s[0] = 31.0
    tickets.give(Caller("console", "1", Role.VIEWER), "/v1/a")
    assert len(tickets._waiting) == 1


def test_keys_over_the_api(plane):
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


def test_a_ticket_dies_with_the_key_that_asked_for_it(plane):
    path = "/v1/streams/endoscope/mjpeg"
    ticket = plane.ask("POST", "/v1/tickets", "viewer", json={"path": path}).json()["ticket"]
    viewer = next(key["id"] for key in plane.ask("GET", "/v1/keys").json() if key["name"] == "test-viewer")
    assert plane.ask("DELETE", f"/v1/keys/{viewer}").status_code == 204
    answer = plane.client.get(path, params={"ticket": ticket})
    assert answer.status_code == 401 and "ticket" in answer.json()["detail"]


def test_how_long_a_refusal_takes_does_not_depend_on_the_key(tmp_path, monkeypatch):
    """Both are compared, and by `compare_digest`."""
    from services.control.auth import keys

    compared = []
    real = keys.hmac.compare_digest
    monkeypatch.setattr(keys.hmac, "compare_digest", lambda a, b: compared.append((len(a), len(b))) or real(a, b))
    store = KeyStore(tmp_path / "keys.json")
    _, token = store.create("console", Role.VIEWER)
    for guess in (token[:-1] + "!", "intrasplat_00000000_" + 43 * "a", "nonsense", ""):
        assert store.find(guess) is None
    assert compared == 4 * [(64, 64)]
