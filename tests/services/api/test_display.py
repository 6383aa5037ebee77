"""Pictures by WebSocket and MJPEG: tickets, disconnected, stalled and excess viewers."""

from __future__ import annotations

import json
import struct
import threading
import time

import anyio
import pytest
from control_fakes import FakeDisplay, fake_parts
from starlette.testclient import WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from services.api import display as display_module
from services.api.guard import still_valid
from services.auth.keys import KEYS_FILE, Caller, KeyStore, Role

SOCKET = "/v1/streams/endoscope/display"
MJPEG = "/v1/streams/endoscope/mjpeg"


@pytest.fixture
def display():
    return FakeDisplay(most=5)


@pytest.fixture
def watched(new_plane, display):
    plane = new_plane(fake_parts(display=display))
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    return plane


def ticket(plane, path, role="viewer"):
    return plane.ask("POST", "/v1/tickets", role, json={"path": path}).json()["ticket"]


def wait_until(condition):
    for _ in range(30_000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("condition not met in time")


def test_display_websocket_sends_header_and_jpeg_per_picture(watched, display):
    with watched.client.websocket_connect(f"{SOCKET}?kind=raw&quality=60&ticket={ticket(watched, SOCKET)}") as socket:
        message = socket.receive_bytes()
        length = struct.unpack(">I", message[:4])[0]
        assert json.loads(message[4 : 4 + length]) == {"seq": 0, "state": "live"}
        assert message[4 + length :] == display.jpeg
        for _ in range(4):
            socket.receive_bytes()
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_bytes()
    assert ended.value.code == 1001
    assert display.asked == [("endoscope", "raw", 60)]
    wait_until(lambda: display.open == 0)


def test_display_websocket_accepts_key_in_header(watched):
    with watched.client.websocket_connect(SOCKET, headers=watched.headers("viewer")) as socket:
        assert socket.receive_bytes()


@pytest.mark.parametrize("query", ["", "?ticket=", "?ticket=x", "?ticket=a&ticket=b"])
def test_display_and_mjpeg_return_401_without_valid_ticket(watched, display, query):
    with pytest.raises(WebSocketDenialResponse) as refused, watched.client.websocket_connect(SOCKET + query):
        pass
    assert refused.value.status_code == 401
    assert refused.value.json()["title"] == "Not authenticated"
    assert watched.client.get(MJPEG + query).status_code == 401
    assert display.asked == []


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("?x=1", "no parameter 'x'"),
        ("?Kind=raw", "no parameter 'Kind'"),
        ("?kind=raw&kind=depth", "kind is given 2 times"),
        ("?quality=50&quality=50", "quality is given 2 times"),
        ("?quality=nan", "quality"),
        ("?quality=96", "quality"),
        ("?quality=-1", "quality"),
        ("?kind=", "kind"),
        ("?kind=everything", "kind"),
    ],
)
def test_display_and_mjpeg_return_422_for_bad_parameters(watched, display, query, said):
    over_http = watched.ask("GET", MJPEG + query)
    refused_socket = pytest.raises(WebSocketDenialResponse)
    with refused_socket as refused, watched.client.websocket_connect(SOCKET + query, headers=watched.headers()):
        pass
    for answer in (over_http, refused.value):
        assert answer.status_code == 422 and said in answer.json()["detail"]
    assert display.asked == []


def test_ticket_is_valid_for_one_use_and_one_path(watched):
    used = ticket(watched, MJPEG)
    assert watched.client.get(f"{MJPEG}?ticket={used}").status_code == 200
    assert watched.client.get(f"{MJPEG}?ticket={used}").status_code == 401
    assert watched.client.get(f"{MJPEG}?ticket={ticket(watched, SOCKET)}").status_code == 401
    other = ticket(watched, MJPEG)
    assert watched.client.get(f"/v1/streams?ticket={other}").status_code == 401, "only displays take tickets"


def test_mjpeg_sends_one_part_per_picture(watched, display):
    answer = watched.ask("GET", MJPEG, "viewer")
    assert answer.headers["content-type"] == "multipart/x-mixed-replace; boundary=picture"
    parts = answer.content.split(b"--picture\r\n")[1:]
    assert len(parts) == 5
    assert parts[0] == b"Content-Type: image/jpeg\r\nContent-Length: 8\r\n\r\n" + display.jpeg + b"\r\n"
    assert display.open == 0


def test_display_and_mjpeg_return_404_for_unknown_stream(watched):
    assert watched.ask("GET", "/v1/streams/other/mjpeg").status_code == 404
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        watched.client.websocket_connect("/v1/streams/other/display", headers=watched.headers()),
    ):
        pass
    assert refused.value.status_code == 404
    assert watched.ask("GET", f"{MJPEG}?kind=thermal").status_code == 422
    assert watched.ask("GET", f"{MJPEG}?quality=100").status_code == 422


def test_display_subscription_ends_when_viewer_disconnects(new_plane):
    display = FakeDisplay()
    plane = new_plane(fake_parts(display=display))
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    with plane.client.websocket_connect(SOCKET, headers=plane.headers()) as socket:
        socket.receive_bytes()
        assert display.open == 1
    wait_until(lambda: display.open == 0)
    wait_until(lambda: 'intrasplat_viewers{transport="websocket"} 0.0' in plane.ask("GET", "/metrics").text)


def test_mjpeg_returns_503_over_viewer_limit(new_plane):
    plane = new_plane(fake_parts(display=FakeDisplay()), limits={"viewers": 1})
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    with plane.client.websocket_connect(SOCKET, headers=plane.headers()) as socket:
        socket.receive_bytes()
        assert plane.ask("GET", MJPEG).status_code == 503


def test_display_websocket_closes_when_server_drains(new_plane):
    plane = new_plane(fake_parts(display=FakeDisplay()))
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    with plane.client.websocket_connect(SOCKET, headers=plane.headers()) as socket:
        socket.receive_bytes()
        plane.client.portal.call(plane.control.draining.set)
        with pytest.raises(WebSocketDisconnect):
            for _ in range(100):
                socket.receive_bytes()


def test_stalled_mjpeg_viewer_is_dropped_and_counted(new_plane):
    display = FakeDisplay()
    plane = new_plane(fake_parts(display=display), limits={"viewer_stall_s": 0.05})
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    sent = []

    async def stuck(message):
        sent.append(message["type"])
        if message.get("more_body"):
            await anyio.sleep_forever()

    async def silent():
        await anyio.sleep_forever()

    async def ask():
        headers = [(b"authorization", plane.headers()["Authorization"].encode())]
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET", "scheme": "http", "path": MJPEG,
            "raw_path": MJPEG.encode(), "query_string": b"", "headers": headers, "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2),
        }  # fmt: skip
        await plane.app(scope, silent, stuck)

    plane.client.portal.call(ask)
    assert sent == ["http.response.start", "http.response.body"]
    assert display.open == 0
    assert 'intrasplat_viewers_dropped_total{reason="stalled"} 1.0' in plane.ask("GET", "/metrics").text


def revoke(plane, how: str) -> None:
    """Revoke the viewer's key by the API or by the command in another process."""
    keys = plane.control.keys
    (key,) = [each for each in keys.all() if each.name == "test-viewer"]
    if how == "by the API":
        assert plane.ask("DELETE", f"/v1/keys/{key.id}").status_code == 204
    else:  # by the command, in another process
        KeyStore(plane.control.settings.data_dir / KEYS_FILE).revoke(key.id)


@pytest.fixture
def endless(new_plane, monkeypatch):
    """A server with an endless display that checks the keys of viewers every 20 ms."""
    monkeypatch.setattr(display_module, "POLL_S", 0.02)
    plane = new_plane(fake_parts(display=FakeDisplay()))
    plane.ask("POST", "/v1/streams", json={"name": "endoscope", "source": "synthetic:"})
    return plane


def end_of(socket) -> int:
    """Receive pictures until the WebSocket is closed. Return the close code."""
    for _ in range(5000):
        try:
            socket.receive_bytes()
        except WebSocketDisconnect as ended:
            return ended.code
    raise AssertionError("the WebSocket is still open after 5000 pictures")


@pytest.mark.parametrize("how", ["by the API", "by the command"])
@pytest.mark.parametrize("by_ticket", [True, False])
def test_revoking_key_closes_its_open_display_websocket(endless, how, by_ticket):
    headers = {} if by_ticket else endless.headers("viewer")
    query = f"?ticket={ticket(endless, SOCKET)}" if by_ticket else ""
    with (
        endless.client.websocket_connect(SOCKET, headers=endless.headers("operator")) as other,
        endless.client.websocket_connect(SOCKET + query, headers=headers) as socket,
    ):
        assert socket.receive_bytes()
        revoke(endless, how)
        assert end_of(socket) == 1008
        for _ in range(50):
            other.receive_bytes()
    assert 'intrasplat_viewers_dropped_total{reason="not admitted"} 1.0' in endless.ask("GET", "/metrics").text


def test_revoking_key_ends_open_mjpeg(endless):
    by = threading.Timer(0.2, revoke, (endless, "by the command"))
    by.start()
    assert endless.ask("GET", MJPEG, "viewer").content.startswith(b"--picture")
    by.join()
    assert endless.parts.display.open == 0


def test_expired_oidc_token_closes_open_display_websocket(endless):
    person = Caller("somebody", "oidc-1", Role.VIEWER, federated=True, expires_at=time.time() + 0.5)
    open_end = Caller("somebody", "oidc-2", Role.VIEWER, federated=True)
    tickets = [endless.control.tickets.give(each, SOCKET) for each in (person, open_end)]
    late = endless.control.tickets.give(person, SOCKET)
    with (
        endless.client.websocket_connect(f"{SOCKET}?ticket={tickets[1]}") as other,
        endless.client.websocket_connect(f"{SOCKET}?ticket={tickets[0]}") as socket,
    ):
        assert end_of(socket) == 1008
        assert other.receive_bytes()
    with pytest.raises(WebSocketDenialResponse), endless.client.websocket_connect(f"{SOCKET}?ticket={late}"):
        pass


def test_damaged_key_file_does_not_close_open_display_websocket(endless):
    path = endless.control.settings.data_dir / KEYS_FILE
    kept = path.read_bytes()
    with endless.client.websocket_connect(SOCKET, headers=endless.headers("viewer")) as socket:
        path.write_bytes(b"{")
        for _ in range(60):
            assert socket.receive_bytes()
        path.write_bytes(kept)


@pytest.mark.parametrize(
    "change", [{"streams": ["another"]}, {"streams": ["endoscope", "another"]}, {"role": "viewer"}, {"expires_at": "2020-01-01T00:00:00+00:00"}]
)  # fmt: skip
def test_still_valid_is_false_after_key_entry_changed(plane, change):
    """A key whose role, streams or expiry changed in the key file must be presented again."""
    keys = plane.control.keys
    key = next(key for key in keys.all() if key.role is Role.OPERATOR)
    caller = Caller(key.name, key.id, key.role)
    assert still_valid(plane.control, caller)
    file = plane.control.settings.data_dir / KEYS_FILE
    text = json.loads(file.read_text())
    entries = text["keys"] if isinstance(text, dict) and "keys" in text else text
    entry = entries[key.id] if isinstance(entries, dict) else next(each for each in entries if each["id"] == key.id)
    entry.update(change)
    file.write_text(json.dumps(text))
    assert not still_valid(plane.control, caller)
