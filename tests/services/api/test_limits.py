"""Rate limits, body limits and body timeouts."""

from __future__ import annotations

import asyncio
import gzip

import pytest

from services.api.guard import BoundedBody, network_of
from services.api.problems import PROBLEM_JSON, TooLarge, TooSlow
from services.api.state import MOST_BUCKETS, TokenBuckets
from services.settings import LimitSettings


def test_token_bucket_refills_at_rate_up_to_its_size():
    now_s = [0.0]
    buckets = TokenBuckets(2.0, 4.0, clock=lambda: now_s[0])
    assert [buckets.wait_s("a") for _ in range(5)] == [0, 0, 0, 0, 0.5]
    assert buckets.wait_s("b") == 0, "each has its own"
    now_s[0] = 0.5
    assert buckets.wait_s("a") == 0
    assert buckets.wait_s("a") == 0.5
    now_s[0] = 1000.0
    assert [buckets.wait_s("a") for _ in range(5)] == [0, 0, 0, 0, 0.5], "it never holds more than its size"


def test_token_buckets_keep_20000_most_recent_callers():
    buckets = TokenBuckets(1.0, 1.0, clock=lambda: 0.0)
    for number in range(20_010):
        assert buckets.wait_s(str(number)) == 0
    assert buckets.wait_s("10") > 0
    assert buckets.wait_s("9") == 0


def test_token_buckets_evict_least_recently_used_caller():
    buckets = TokenBuckets(1.0, 1.0, clock=lambda: 0.0)
    for number in range(MOST_BUCKETS):
        assert buckets.wait_s(f"{number}") == 0
    assert buckets.wait_s("0") > 0, "heard again: now 1 is the oldest"
    assert buckets.wait_s("new") == 0
    for known in ("new", "0", "2", f"{MOST_BUCKETS - 1}"):
        assert buckets.wait_s(known) > 0, f"{known} keeps its bucket, which is empty"
    assert buckets.wait_s("1") == 0, "it was forgotten"


@pytest.mark.parametrize(
    ("client", "network"),
    [
        (("10.0.0.5", 1), "10.0.0.5"),
        (("2001:db8::1", 1), "2001:db8::/64"),
        (("2001:db8::ffff", 2), "2001:db8::/64"),
        (None, "unknown"),
        (("testclient", 1), "testclient"),
    ],
)
def test_network_of_groups_ipv6_clients_by_64_prefix(client, network):
    assert network_of({"client": client}) == network


def test_key_over_request_rate_gets_429(new_plane):
    plane = new_plane(limits={"requests_per_s": 0.05, "burst_s": 60})
    assert [plane.ask("GET", "/v1/version", "viewer").status_code for _ in range(4)] == [200, 200, 200, 429]
    refused = plane.ask("GET", "/v1/version", "viewer")
    assert refused.headers["content-type"] == PROBLEM_JSON and int(refused.headers["retry-after"]) >= 1
    assert plane.ask("GET", "/v1/version", "operator").status_code == 200, "another key has its own rate"
    assert 'intrasplat_http_refused_total{reason="key rate"} 2.0' in plane.ask("GET", "/metrics").text


def test_address_over_request_rate_gets_429(new_plane):
    plane = new_plane(limits={"address_requests_per_s": 0.05, "burst_s": 40})
    answers = [plane.client.get("/livez") for _ in range(3)]
    assert [answer.status_code for answer in answers] == [200, 200, 429]
    assert answers[2].headers["content-type"] == PROBLEM_JSON
    assert "content-security-policy" in answers[2].headers


def test_body_over_size_limit_returns_413(plane):
    read = []

    def body():
        read.append(True)
        yield b"{}"

    answer = plane.ask(
        "POST",
        "/v1/tickets",
        content=body(),
        headers={"Content-Length": "99999999", "Content-Type": "application/json"},
    )
    assert (answer.status_code, answer.headers["connection"]) == (413, "close")
    assert plane.ask("POST", "/v1/tickets", content=b" " * 2**21).status_code == 413


@pytest.mark.parametrize("content_type", ["text/plain", "application/xml", "", "multipart/form-data; boundary=x"])
def test_wrong_content_type_returns_415(plane, content_type):
    answer = plane.ask("POST", "/v1/tickets", content=b'{"path": "/v1/x"}', headers={"Content-Type": content_type})
    assert (answer.status_code, answer.headers["content-type"]) == (415, PROBLEM_JSON)


def test_compressed_body_returns_415(plane):
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    answer = plane.ask("POST", "/v1/tickets", content=gzip.compress(b'{"path": "/v1/x"}'), headers=headers)
    assert answer.status_code == 415 and "Content-Encoding is 'gzip'" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("body", "detail"),
    [
        (b'{"path":\n "/v1/x",}', "not JSON at line 2, column 10: "),
        (b'{"path": "/v1/x"} x', "not JSON at line 1, column 19: Extra data"),
        (b'{"path": "\xff"}', "not UTF-8 text at byte 10"),
        ('{"path": "/v1/x"}'.encode("utf-16"), "not UTF-8 text at byte 0"),
        (b'{"path": "/v1/x", "path": "/v1/y"}', "gives the key 'path' twice"),
        (b'{"path": {"a": 1, "a": 1}}', "gives the key 'a' twice"),
        (b'{"path": ' + 5000 * b"1" + b"}", "a whole number with thousands of digits"),
        (b"[" * 100_000, "too many lists and objects inside each other"),
    ],
)
def test_unparseable_json_body_returns_400_with_position_and_cause(plane, body, detail):
    answer = plane.ask("POST", "/v1/tickets", content=body, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.headers["content-type"]) == (400, PROBLEM_JSON)
    assert detail in answer.json()["detail"]


@pytest.mark.parametrize("body", [b"{", b"[]", b"null", b'{"path": "\xff"}', b'{"path": 1e999}', b"[" * 100_000])
def test_invalid_json_body_returns_400_or_422(plane, body):
    answer = plane.ask("POST", "/v1/tickets", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422) and answer.headers["content-type"] == PROBLEM_JSON


def bounded(messages, most_bytes=100, **limits):
    """Return the bytes that pass a bounded body. A number among the messages is a pause in seconds."""

    async def receive():
        message = messages.pop(0)
        if isinstance(message, float):
            await asyncio.sleep(message)
            return await receive()
        return {"type": "http.request", "body": message, "more_body": bool(messages)}

    async def read():
        scope = {"type": "http", "state": {}}
        body = BoundedBody(scope, receive, most_bytes, LimitSettings(**limits))
        got = b""
        while not scope["state"].get("body_read"):
            got += (await body())["body"]
        return got

    return asyncio.run(read())


def test_bounded_body_raises_if_too_large_stalled_or_too_slow(monkeypatch):
    assert bounded([b"a" * 50, b"b" * 50]) == b"a" * 50 + b"b" * 50
    with pytest.raises(TooLarge):
        bounded([b"a" * 50, b"b" * 51])
    with pytest.raises(TooSlow, match=r"for 0\.05 s"):
        bounded([b"a", 5.0, b"b"], stall_s=0.05)
    monkeypatch.setattr("services.api.guard.GRACE_S", 0.05)
    with pytest.raises(TooSlow, match="send it faster"):
        bounded([b"a", 0.1, b"b", b"c"], slowest_bytes_per_s=1000)
    assert bounded([b"a" * 60, 0.1, b"b", b"c"], slowest_bytes_per_s=1) == b"a" * 60 + b"bc"
