"""Attacks over HTTP: proxy headers, forged log lines, misplaced keys, malformed paths and methods."""

from __future__ import annotations

import json
import logging

import pytest
from starlette.testclient import TestClient

from services.api import new_app
from services.api.observability import FACTS, JsonFormatter
from services.api.problems import PROBLEM_JSON
from services.settings import ServiceSettings


@pytest.fixture
def served(tmp_path):
    def make(client=("10.0.0.9", 1234), **settings):
        folder = tmp_path / "data"
        app = new_app(ServiceSettings(paths={"data": folder}, **settings))
        app.state.key = (folder / "admin.key").read_text().strip()
        return TestClient(app, "http://localhost", client=client, raise_server_exceptions=False)

    made = []

    def remembered(**options):
        made.append(make(**options))
        return made[-1]

    yield remembered
    for each in made:
        each.app.state.control.audit.close()


def asked_from(client: TestClient, headers, caplog) -> str:
    """Return the client address that is logged for a request."""
    caplog.clear()
    with caplog.at_level(logging.INFO, "intrasplat.requests"):
        client.get("/v1/version", headers=headers)
    return caplog.records[-1].facts["address"]


def test_forwarded_headers_of_untrusted_client_are_ignored(served, caplog):
    client = served()
    for headers in ({"X-Forwarded-For": "1.2.3.4"}, {"Forwarded": "for=1.2.3.4"}, {"X-Real-IP": "1.2.3.4"}):
        assert asked_from(client, headers, caplog) == "10.0.0.9"
    assert "strict-transport-security" not in client.get("/livez", headers={"X-Forwarded-Proto": "https"}).headers


def test_last_untrusted_address_behind_trusted_proxies_is_logged(served, caplog):
    client = served(server={"trusted_proxies": ["10.0.0.9", "10.1.0.0/16"]})
    for value, address in (
        ("1.2.3.4", "1.2.3.4"),
        ("6.6.6.6, 1.2.3.4", "1.2.3.4"),  # the client sent the first one
        ("6.6.6.6, 1.2.3.4, 10.1.2.3", "1.2.3.4"),  # a chain of two proxies
    ):
        assert asked_from(client, {"X-Forwarded-For": value}, caplog) == address
    two = [("X-Forwarded-For", "6.6.6.6"), ("X-Forwarded-For", "1.2.3.4")]
    assert asked_from(client, two, caplog) == "1.2.3.4"
    assert client.get("/livez", headers={"X-Forwarded-Proto": "https"}).headers["strict-transport-security"]


def test_proxy_headers_do_not_change_host_or_scheme(served, caplog):
    client = served(server={"trusted_proxies": ["10.0.0.9"], "allowed_hosts": ["room-1.example"]})
    for forged in ({"X-Forwarded-Host": "localhost"}, {"Forwarded": "host=localhost"}, {"X-Host": "localhost"}):
        assert client.get("/livez", headers={"Host": "evil.example", **forged}).status_code == 421
    answer = client.get("/v1/version", headers={"Host": "room-1.example", "X-Forwarded-Host": "evil.example"})
    assert answer.status_code == 401 and "evil" not in answer.text + str(answer.headers)
    odd = client.get("/livez", headers={"X-Forwarded-Proto": "javascript", "X-Forwarded-Prefix": "//evil.example"})
    assert odd.status_code == 200 and "strict-transport-security" not in odd.headers
    assert asked_from(client, {"X_Forwarded_For": "1.2.3.4"}, caplog) == "10.0.0.9", "another name than with dashes"
    for value in ("", ",", "1.2.3.4,", " , 6.6.6.6,,10.0.0.9", "evil\tname", "[::1", "1.2.3.4:99999"):
        assert client.get("/livez", headers={"X-Forwarded-For": value}).status_code == 200, value


def test_forged_forwarded_addresses_do_not_evade_rate_limit(served):
    client = served(limits={"address_requests_per_s": 0.05, "burst_s": 40})
    answers = [client.get("/livez", headers={"X-Forwarded-For": f"1.2.3.{n}"}).status_code for n in range(5)]
    assert answers[-1] == 429


@pytest.mark.parametrize(
    "headers",
    [
        {"Authorization": "Bearer"}, {"Authorization": "Bearer "}, {"Authorization": "Basic KEY"}, {"Authorization": "KEY"},
        {"X-API-Key": "KEY"}, {"Cookie": "key=KEY"}, {"Authorization": "Bearer KEY KEY"}, {"Authorization": "Bearer " + 5000 * "a"},
        {"Authorization": "Bearer intrasplat__"}, {"Authorization": "Bearer KEYx"}, {"X-Remote-User": "admin"},
        {"X-Original-URL": "/livez"}, {"X-HTTP-Method-Override": "GET"}, {"Authorization": "Bearer \xff"},
    ],
)  # fmt: skip
def test_malformed_or_misplaced_keys_return_401(served, headers):
    client = served()
    given = {name: value.replace("KEY", client.app.state.key).encode("latin1") for name, value in headers.items()}
    answer = client.get("/v1/version", headers=given)
    assert (answer.status_code, answer.headers["content-type"]) == (401, PROBLEM_JSON)
    assert client.get(f"/v1/version?ticket={client.app.state.key}&key={client.app.state.key}").status_code == 401


def test_two_authorization_headers_return_401(served):
    client = served()
    right = f"Bearer {client.app.state.key}"
    assert client.get("/v1/version", headers={"Authorization": right}).status_code == 200
    for both in ([right, right], [right, "Bearer x"], ["Bearer x", right]):
        assert client.get("/v1/version", headers=[("Authorization", each) for each in both]).status_code == 401


@pytest.mark.parametrize(
    "path",
    [
        "/v1/version/", "//v1/version", "/v1//version", "/V1/version", "/v1/version%00", "/v1/%2e%2e/livez",
        "/v1/models/..%2f..%2fetc/versions", "/v1/streams/%2e%2e", "/docs/%2e%2e%2fapp.py", "/.git/config",
        "/v1/version;x", "/metrics/", "/readyz/x", "/v1/models/liver/versions/1e3", "/v1/models/liver/versions/-1",
    ],
)  # fmt: skip
def test_odd_paths_return_problem_document(served, path):
    client = served()
    answer = client.get(path, headers={"Authorization": f"Bearer {client.app.state.key}"})
    assert answer.status_code in (404, 422, 503), answer.text
    assert answer.headers["content-type"] == PROBLEM_JSON


@pytest.mark.parametrize("method", ["TRACE", "CONNECT", "OPTIONS", "PROPFIND", "X" * 1000])
def test_odd_methods_return_405_and_are_not_metric_labels(served, method):
    client = served()
    answer = client.request(method, "/v1/version", headers={"Origin": "https://evil.example"})
    assert answer.status_code == 405 and answer.headers["content-type"] == PROBLEM_JSON
    assert not any(name.startswith("access-control") for name in answer.headers)
    metrics = client.get("/metrics", headers={"Authorization": f"Bearer {client.app.state.key}"}).text
    assert 1000 * "X" not in metrics and "PROPFIND" not in metrics


@pytest.mark.parametrize(
    "body",
    [
        b'{"name": "a", "role": NaN}', b'{"name": "\\ud800", "role": "viewer"}', 50_000 * b"[", 50_000 * b'{"a":', b"1" + 9000 * b"0",
        b'{"name": 1e999, "role": "viewer"}', b'\xff\xfe{\x00', b"\xef\xbb\xbf{}", b'"\xff"', b"\x00", b"", b"null", b"[]",
        b'{"name": "a", "role": "viewer", "role": "admin", "x": 1}', b'{"__proto__": {}}',
    ],
    ids=lambda body: repr(body[:20]),
)  # fmt: skip
def test_malformed_json_bodies_return_400_or_422(served, body):
    client = served()
    headers = {"Authorization": f"Bearer {client.app.state.key}", "Content-Type": "application/json"}
    for path in ("/v1/keys", "/v1/tickets", "/v1/streams", "/v1/models/a/activate"):
        answer = client.post(path, content=body, headers=headers)
        assert answer.status_code in (400, 422) and answer.headers["content-type"] == PROBLEM_JSON, answer.text


def test_request_paths_are_not_metric_labels(served):
    client = served()
    for number in range(20):
        client.get(f"/v1/models/patient-{number}/versions")
        client.get(f"/patient-{number}")
    metrics = client.get("/metrics", headers={"Authorization": f"Bearer {client.app.state.key}"}).text
    assert "patient" not in metrics and 'route="unmatched"' in metrics


def test_json_formatter_escapes_newlines_and_hides_passwords():
    message = 'x\n{"level": "info", "message": "forged"}\r\n\x1b[31m rtsp://u:pa55@h/'
    record = logging.LogRecord("x", logging.INFO, "", 0, "%s", (message,), None)
    record.__dict__[FACTS] = {"address": "a\nb"}
    line = JsonFormatter().format(record)
    assert "\n" not in line and "\x1b" not in line and "pa55" not in line
    assert json.loads(line)["address"] == "a\nb"
