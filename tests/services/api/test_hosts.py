"""Accepted host names of a server: addresses, localhost and those listed in the settings."""

from __future__ import annotations

import asyncio

import pytest
from pydantic import ValidationError
from starlette.testclient import WebSocketDenialResponse

from services.api.guard import KnownHosts
from services.api.observability import Measures
from services.api.problems import PROBLEM_JSON
from services.settings import ServerSettings


def is_known_host(host: str, /, **server: object) -> bool:
    return KnownHosts(lambda *_: None, ServerSettings(**server), Measures()).knows(host)  # type: ignore[arg-type,return-value]


@pytest.mark.parametrize("host", ["localhost", "localhost:8000", "127.0.0.1:8000", "[::1]:8000", "[::1]", "10.0.0.4"])
def test_known_hosts_accepts_ip_addresses_and_localhost(host):
    assert is_known_host(host) and is_known_host(host, allowed_hosts=["room-1.example"])


@pytest.mark.parametrize(
    "host",
    ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "room-1.example.evil", "", "a b", "evil.example:",
     "evil.example:80:80", "user@localhost", "localhost/x", "[evil]", "*", "127.0.0.1, evil.example", "lоcalhost"],
)  # fmt: skip
def test_known_hosts_rejects_unlisted_names(host):
    assert not is_known_host(host) and not is_known_host(host, allowed_hosts=["room-1.example", "*.hospital.example"])


def test_allowed_hosts_match_exact_names_and_subdomain_wildcards():
    listed = ["Room-1.example", "*.hospital.example"]
    for host in (
        "room-1.example",
        "room-1.example:8443",
        "room-1.example.",
        "a.hospital.example",
        "a.b.hospital.example",
    ):
        assert is_known_host(host, allowed_hosts=listed), host
    assert not is_known_host("hospital.example", allowed_hosts=listed)
    assert is_known_host("theatre-pc", host="theatre-pc")


def test_tls_without_allowed_hosts_accepts_any_valid_host():
    tls = {"certfile": "/x", "keyfile": "/x"}
    assert is_known_host("room-1.example", **tls) and not is_known_host("a b", **tls)
    assert not is_known_host("evil.example", **tls, allowed_hosts=["room-1.example"])


@pytest.mark.parametrize("name", ["http://x", "x:80", "*", "a*b", "", ".x", "x/y", "[::1]", "*.*.x"])
def test_allowed_hosts_setting_rejects_invalid_names(name):
    with pytest.raises(ValidationError, match="is no name of a host"):
        ServerSettings(allowed_hosts=[name])


def test_unknown_host_header_returns_421_on_all_routes(new_plane):
    plane = new_plane(server={"allowed_hosts": []})
    answer = plane.ask("GET", "/v1/streams", headers={"Host": "evil.example"})
    assert answer.status_code == 421 and "server.allowed_hosts" in answer.json()["detail"]
    assert plane.ask("GET", "/livez", headers={"Host": "evil.example"}).status_code == 421, "public routes, too"
    assert plane.ask("GET", "/livez", headers={"Host": "localhost, localhost"}).status_code == 421
    assert plane.ask("GET", "/livez", headers={"Host": "localhost:8000"}).status_code == 200
    with pytest.raises(WebSocketDenialResponse) as refused, plane.client.websocket_connect("/v1/streams/a/display"):
        pass
    assert refused.value.status_code == 421 and refused.value.headers["content-type"] == PROBLEM_JSON
    assert 'refused_total{reason="host"}' in plane.ask("GET", "/metrics", headers={"Host": "localhost"}).text


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("hosts", "taken"),
    [
        ([b"localhost"], True),
        ([], True),
        ([b"localhost", b"localhost"], False),
        ([b"localhost", b"evil.example"], False),
        ([b"evil.example", b"localhost"], False),
        ([b"127.0.0.1", b"127.0.0.1"], False),
        ([b"LOCALHOST", b"localhost", b"localhost"], False),
    ],
)
def test_known_hosts_refuses_multiple_host_headers(plane, kind, hosts, taken):
    """A proxy in front of the server may have checked the other header."""
    reached, sent = [], []

    async def app(scope, receive, send):
        reached.append(scope)

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    scope = {"type": kind, "headers": [(b"host", host) for host in hosts], "app": plane.app, "state": {}}
    asyncio.run(KnownHosts(app, ServerSettings(), Measures())(scope, receive, send))
    assert bool(reached) == taken
    if not taken:
        assert sent[0]["status"] == 421


def test_websocket_handshake_for_unknown_path_returns_404(plane):
    for path in ("/v1/streams", "/zork"):
        with pytest.raises(WebSocketDenialResponse) as refused, plane.client.websocket_connect(path):
            pass
        assert refused.value.status_code == 404 and refused.value.headers["content-type"] == PROBLEM_JSON
