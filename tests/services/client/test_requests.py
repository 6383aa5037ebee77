"""Requests of the client: addresses, keys, polling, complete files, malformed responses."""

from __future__ import annotations

import base64
import hashlib
import io
import ssl
import struct
from pathlib import Path

import httpx2
import pytest

from services.client import requests
from services.client.requests import (
    MOST_KEY_CHARACTERS,
    MOST_PROBLEM_BYTES,
    Requests,
    checked_key,
    checked_path,
    checked_url,
    picture_of,
    tls_context,
)
from services.errors import ClientError, Refused, Unreachable

URL = "http://room-1.example:8000"


class Client(Requests):
    """Client whose requests are answered by a function and kept in `asked`."""

    def __init__(self, answer: httpx2.Response | Exception, timeout_s: float = 5.0) -> None:
        super().__init__(URL + "/", " key ", timeout_s, True)
        self.asked: list[httpx2.Request] = []

        def respond(request: httpx2.Request) -> httpx2.Response:
            self.asked.append(request)
            request.read()
            if isinstance(answer, Exception):
                raise answer
            answer.headers["X-Request-ID"] = "0"
            return answer

        self._http = httpx2.Client(
            base_url=self.url, headers=self._http.headers, transport=httpx2.MockTransport(respond)
        )


def digest_of(content: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(content).digest()).decode()}:"


@pytest.mark.parametrize(
    "url", ["http://a", "https://a:8000", "http://[::1]:80", "https://a.example/base", "http://127.0.0.1:65535"]
)
def test_checked_url_accepts_server_urls(url: str) -> None:
    assert checked_url(url) == checked_url(url + "/") == checked_url(url + "//") == url


@pytest.mark.parametrize(
    "url",
    ["", "a:8000", "ftp://a", "http://", "http://a:0", "http://a:65536", "http://a?b=c", "http://a#b", "http://a b",
     "http://[::1", "http://a\n", "http://a:x", "http:///path"],
)  # fmt: skip
def test_checked_url_rejects_other_texts(url: str) -> None:
    with pytest.raises(ClientError, match="is no address of a server"):
        checked_url(url)


def test_checked_key_accepts_one_line_of_limited_length() -> None:
    longest = "k" * MOST_KEY_CHARACTERS
    assert checked_key(f"  {longest}\n") == longest
    for wrong in (longest + "k", "a b", "ä", "a\nb", "a\x00"):
        with pytest.raises(ClientError, match="characters that no key has"):
            checked_key(wrong)
    for empty in ("", " \n"):
        with pytest.raises(ClientError, match="is empty"):
            checked_key(empty)


def test_request_sends_key_and_returns_json_or_none() -> None:
    client = Client(httpx2.Response(200, json={"a": 1}))
    assert client._ask("GET", "/v1/x") == {"a": 1}
    assert client.asked[0].headers["authorization"] == "Bearer key"
    assert str(client.asked[0].url) == f"{URL}/v1/x"
    assert Client(httpx2.Response(204))._ask("DELETE", "/v1/x") is None
    with pytest.raises(ClientError, match="is no JSON; is it an IntraSplat server"):
        Client(httpx2.Response(200, content=b"<html>"))._ask("GET", "/")


def test_client_limits_length_and_time_of_response(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "MOST_ANSWER_BYTES", 10)
    assert Client(httpx2.Response(200, content=b"1" * 10))._ask("GET", "/") == 1111111111
    with pytest.raises(ClientError, match="has more than"):
        Client(httpx2.Response(200, content=b"1" * 11))._ask("GET", "/")
    for passed_s, ends in ((50.0, True), (50.1, False)):
        moments = iter((0.0, passed_s, passed_s))
        monkeypatch.setattr(requests.time, "monotonic", lambda moments=moments: next(moments))
        client = Client(httpx2.Response(200, content=b"1"))
        if ends:
            assert client._ask("GET", "/") == 1
        else:
            with pytest.raises(ClientError, match="does not end"):
                client._ask("GET", "/")


@pytest.mark.parametrize(
    ("answer", "status", "sentence"),
    [
        (httpx2.Response(404, json={"detail": "none of them", "title": "Not found"}), 404, "none of them"),
        (httpx2.Response(409, json={"title": "Conflict"}), 409, "Conflict"),
        (httpx2.Response(502, content=b"bad gateway"), 502, "is no problem document"),
        (httpx2.Response(500, json=[1]), 500, "is no problem document"),
        (httpx2.Response(301, headers={"location": "/x"}), 301, "is no problem document"),
    ],
)
def test_refused_has_status_and_detail_of_response(
    answer: httpx2.Response, status: int, sentence: str, tmp_path: Path
) -> None:
    content, headers = answer.read(), answer.headers
    for ask in (
        lambda client: client._ask("GET", "/"),
        lambda client: client._get_file("/", tmp_path / "file"),
    ):
        with pytest.raises(Refused, match=sentence) as refused:
            ask(Client(httpx2.Response(status, content=content, headers=headers)))
        assert refused.value.status == status
    assert list(tmp_path.iterdir()) == []


def test_connection_error_raises_unreachable(tmp_path: Path) -> None:
    for ask in (
        lambda client: client._ask("GET", "/"),
        lambda client: client._get_file("/", tmp_path / "file"),
    ):
        with pytest.raises(Unreachable, match="does not answer: refused by the machine; check the address"):
            ask(Client(httpx2.ConnectError("refused by the machine")))


def test_put_file_sends_digest_and_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "CHUNK_BYTES", 4)
    (tmp_path / "file").write_bytes(b"0123456789")
    client = Client(httpx2.Response(201, json={}))
    client._put_file("/v1/file", tmp_path / "file")
    (request,) = client.asked
    assert request.content == b"0123456789" and request.method == "PUT"
    assert request.headers["content-digest"] == digest_of(b"0123456789")
    assert request.headers["content-length"] == "10"
    assert request.headers["content-type"] == "application/octet-stream"
    with pytest.raises(ClientError, match="none cannot be read: No such file"):
        client._put_file("/v1/file", tmp_path / "none")


@pytest.mark.parametrize(("size", "changed"), [(9, True), (10, False), (11, True)])
def test_upload_raises_if_file_changes_size(size: int, changed: bool) -> None:
    pieces = requests._pieces(io.BytesIO(b"0123456789"), size, Path("file"))
    if changed:
        with pytest.raises(ClientError, match="changed while it was sent"):
            list(pieces)
    else:
        assert b"".join(pieces) == b"0123456789"


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"content-digest": digest_of(b"whole")}, None),
        ({"content-length": "5"}, None),
        ({"content-length": "5", "content-digest": digest_of(b"whole")}, None),
        ({"content-length": "9", "content-encoding": "br"}, None),
        ({"content-digest": digest_of(b"other")}, "not what the server's digest says"),
        ({"content-length": "6"}, "has 5 bytes, and the server announced 6"),
        ({"content-length": "4", "content-digest": digest_of(b"whole")}, "has 5 bytes"),
        ({}, "neither the length nor the digest"),
    ],
)
def test_download_is_checked_by_announced_length_and_digest(headers: dict[str, str], why: str | None) -> None:
    answer = httpx2.Response(200, headers=headers)
    if why is None:
        requests._check_whole(answer, hashlib.sha256(b"whole").digest(), 5, "file")
    else:
        with pytest.raises(ClientError, match=why):
            requests._check_whole(answer, hashlib.sha256(b"whole").digest(), 5, "file")


def test_download_overwrites_file_only_on_request(tmp_path: Path) -> None:
    file = tmp_path / "file"

    def get(content: bytes, **options: bool) -> int:
        return Client(httpx2.Response(200, content=content))._get_file("/", file, **options)

    assert get(b"whole") == 5 and file.read_bytes() == b"whole"
    with pytest.raises(ClientError, match="already exists"):
        get(b"other!")
    assert file.read_bytes() == b"whole"
    assert get(b"other!", overwrite=True) == 6 and file.read_bytes() == b"other!"
    with pytest.raises(ClientError, match="cannot be written"):
        Client(httpx2.Response(200, content=b"x"))._get_file("/", tmp_path / "none" / "file")


def test_error_body_is_read_up_to_limit() -> None:
    exact = httpx2.Response(400, content=b"x" * MOST_PROBLEM_BYTES)
    assert len(requests._read_some(exact)) == MOST_PROBLEM_BYTES
    assert len(requests._read_some(httpx2.Response(400, content=b"x" * (3 * MOST_PROBLEM_BYTES)))) == MOST_PROBLEM_BYTES


def test_waited_for_polls_with_growing_interval_until_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, waits = [0.0], []

    def sleep(seconds: float) -> None:
        waits.append(round(seconds, 6))
        now_s[0] += seconds

    monkeypatch.setattr(requests.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(requests.time, "sleep", sleep)
    answers = iter([0, 1, 2])
    assert requests.waited_for(lambda: next(answers), lambda found: found == 2, 10.0, "it") == 2
    assert waits == [0.1, 0.2]
    now_s[0], waits[:] = 0.0, []
    with pytest.raises(ClientError, match="the job is not finished after 7 s; ask again later"):
        requests.waited_for(lambda: 0, lambda found: found == 2, 7.0, "the job")
    assert waits == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]
    now_s[0], waits[:] = 0.0, []
    with pytest.raises(ClientError):
        requests.waited_for(lambda: 0, bool, 0.0, "a border")
    assert waits == [0.1], "the moment itself is still in time"


def test_picture_of_splits_header_and_jpeg() -> None:
    header = b'{"sequence": 7}'
    picture = picture_of(struct.pack(">I", len(header)) + header + b"\xff\xd8jpeg")
    assert picture.header == {"sequence": 7} and picture.jpeg == b"\xff\xd8jpeg"


def test_tls_context_verifies_certificate_unless_disabled(tmp_path: Path) -> None:
    checked, unchecked = tls_context(True), tls_context(False)
    assert checked.verify_mode == ssl.CERT_REQUIRED and checked.check_hostname
    assert unchecked.verify_mode == ssl.CERT_NONE and not unchecked.check_hostname
    junk = tmp_path / "junk.pem"
    with pytest.raises(ClientError, match="cannot be read: No such file"):
        tls_context(str(junk))
    for content, why in ((b"\xff\xfe", "it must be PEM"), (b"junk", "is no certificate")):
        junk.write_bytes(content)
        with pytest.raises(ClientError, match=why):
            tls_context(str(junk))


@pytest.mark.parametrize(
    "path",
    [
        "/v1/replays/1/results/../../keys",
        "/v1/streams/./x",
        "/v1/streams/a?b",
        "/v1/streams/a#b",
        "/v1/models/a%2F",
    ],
)
def test_checked_path_refuses_names_that_address_something_else(path):
    with pytest.raises(ClientError, match="has a name that the service cannot have"):
        checked_path(path)
    assert checked_path("/v1/replays/1/results/report.html") == "/v1/replays/1/results/report.html"
