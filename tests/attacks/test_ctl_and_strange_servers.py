"""`intrasplat ctl` with foreign servers and unusable addresses, keys and certificates: one error line, no traceback."""

from __future__ import annotations

import gzip
import os
import sys
import threading
import zlib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK
from services.client import requests

KEY = "intrasplat_00000000_" + 43 * "a"


class Strange(BaseHTTPRequestHandler):
    """Request handler that answers with the server's `answer`: status, headers, body."""

    def do_GET(self):
        length = int(self.headers.get("Content-Length", 0))
        self.rfile.read(length)
        status, headers, body = self.server.answer
        self.wfile.write(f"HTTP/1.1 {status} X\r\n".encode())
        for name, value in headers.items():
            self.wfile.write(f"{name}: {value}\r\n".encode("latin-1"))
        self.wfile.write(b"Connection: close\r\n\r\n" + body)
        self.close_connection = True

    do_POST = do_PUT = do_DELETE = do_GET

    def log_message(self, *_):
        pass


class StrangeServer(ThreadingHTTPServer):
    """Server that ignores connection errors, whose late tracebacks would appear in the output of the next test."""

    def handle_error(self, request, client_address):
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


@pytest.fixture(scope="module")
def server():
    with StrangeServer(("127.0.0.1", 0), Strange) as found:
        thread = threading.Thread(target=found.serve_forever, args=(0.01,))
        thread.start()
        yield found
        found.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("INTRASPLAT_KEY", KEY)


def ctl(server, *arguments):
    return run(["ctl", *arguments, "--url", f"http://127.0.0.1:{server.server_address[1]}"])


def sized(body: bytes, **headers: str):
    """Return headers of a response with a body, including the request id that IntraSplat servers send."""
    return {
        "Content-Length": str(len(body)),
        "X-Request-ID": "0",
        **{name.replace("_", "-"): value for name, value in headers.items()},
    }


BOMB = zlib.compress(bytes(80 << 20), 9)
BODIES = [
    b"", b"<html>hello</html>", b"{", b'{"a": ', b"null", b"[1]", b"[null]", b"{}", b"[[]]", b'"x"', b"1e999", b"\xff\xfe\x00", b"[" * 200_000,
    b'[{"name": 1}]', b'[{"name": []}]', b'{"detail": []}', b"9" * 5000, b'["\\ud800"]',
]  # fmt: skip
COMMANDS = [
    ["streams"], ["models"], ["models", "liver"], ["recordings"], ["replays"], ["start", "s"], ["create", "s", "synthetic:"],
    ["activate", "liver", "1"], ["rollback", "liver"], ["snapshot", "s"], ["snapshots", "s"], ["replay", "r"], ["cancel", "0" * 16],
    ["keep", "0" * 16, "liver"], ["options", "s", "--option", "seed=1"],
]  # fmt: skip


def _is_one_sentence(capsys) -> bool:
    said = capsys.readouterr().err
    return said.startswith("error: ") and "Traceback" not in said and len(said) < 1000


@pytest.mark.parametrize("body", BODIES, ids=lambda body: repr(body[:20]))
@pytest.mark.parametrize("status", [200, 302, 404])
@pytest.mark.parametrize("command", COMMANDS[:1], ids=" ".join)
def test_ctl_prints_one_error_for_malformed_response(server, capsys, command, status, body):
    server.answer = status, sized(body, Content_Type="application/json", Location="http://127.0.0.1:1/"), body
    code = ctl(server, *command)
    assert code == OK if (status < 300 and body == b"[]") else code == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize("body", [b"<html></html>", b"[1]", b"null", b"{}"], ids=repr)
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_ctl_command_prints_one_error_for_malformed_response(server, capsys, command, body):
    server.answer = 200, sized(body), body
    assert ctl(server, *command) == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize(
    ("headers", "body"),
    [
        ({"Content-Length": "100"}, b"[]"),
        ({"Content-Length": "-1"}, b"[]"),
        ({"Content-Length": "x"}, b"[]"),
        ({"Transfer-Encoding": "chunked"}, b"zz\r\n[]"),
        ({"Transfer-Encoding": "chunked"}, b"5\r\n[]"),
        ({"Content-Encoding": "gzip"}, b"no gzip"),
        ({"Content-Encoding": "gzip"}, gzip.compress(b"[")[:-3]),
        ({"Content-Encoding": "deflate"}, BOMB),
        ({"Content-Type": "application/json; charset=nowhere"}, b"[1"),
        ({"X": "y" * 200_000}, b"[]"),
        ({"Bad\x00Name": "y"}, b"[]"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_ctl_prints_one_error_for_broken_http(server, capsys, headers, body):
    server.answer = 200, headers, body
    assert ctl(server, "streams") == BAD_INPUT
    assert _is_one_sentence(capsys)


def test_ctl_stops_reading_oversized_response(server, capsys, monkeypatch):
    monkeypatch.setattr(requests, "MOST_ANSWER_BYTES", 1000)
    server.answer = 200, {}, bytes(100_000)
    assert ctl(server, "streams") == BAD_INPUT
    assert "is it an IntraSplat server" in capsys.readouterr().err


@pytest.mark.parametrize(
    "url",
    [
        "", "http://[::1", "http://", "http:///x", "ftp://a", "localhost:8000", "http://a:99999", "http://a:x", "http://a:0", "http://a b",
        "http://a\nb", "http://a\x00", "http://\ud800", "http://a?x=1", "http://a#b", "file:///etc/passwd", "//a", "http://[v1.x]", "http://a:-1",
        "http://" + "a" * 300, "http://xn--zzzzzzzzzzzz-.example",
    ],
)  # fmt: skip
def test_ctl_prints_one_error_for_invalid_url(capsys, url):
    assert run(["ctl", "streams", "--url", url]) == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize(
    "content",
    [b"", b"\n", b"a b", "ключ".encode(), b"\xff\xfe", b"a\x00b", b"a\nb", b"a\rb", b"a\x1bb", b"a" * 5000, "a\u2028b".encode()],
    ids=lambda value: repr(value)[:20],
)  # fmt: skip
@pytest.mark.parametrize("how", ["file", "variable"])
def test_ctl_prints_one_error_for_invalid_key(tmp_path, capsys, monkeypatch, content, how):
    more = []
    if how == "file":
        (tmp_path / "key").write_bytes(content)
        more = ["--key-file", str(tmp_path / "key")]
    elif b"\0" in content:
        return
    else:
        monkeypatch.setenv("INTRASPLAT_KEY", os.fsdecode(content))
    assert run(["ctl", "streams", "--url", "http://127.0.0.1:9", *more]) == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize("option", ["--ca", "--key-file"])
@pytest.mark.parametrize(
    "kind", ["missing", "junk", "empty", "pipe", "device", "folder", "half a certificate", "binary"]
)
def test_ctl_prints_one_error_for_unusable_ca_or_key_file(tmp_path, capsys, kind, option):
    path = tmp_path / "ca.pem"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind != "missing":
        half = b"-----BEGIN CERTIFICATE-----\nMIIB\n"
        path.write_bytes(
            {"junk": b"hello\n\n\x07", "empty": b"", "half a certificate": half, "binary": bytes(range(256))}[kind]
        )
    assert run(["ctl", "streams", "--url", "http://127.0.0.1:9", option, str(path)]) == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize("name", ["a\x00b", "a\nb", "\ud800", "a" * 100_000])
@pytest.mark.parametrize("command", [["start"], ["models"], ["cancel"], ["remove-recording"], ["snapshots"]])
def test_ctl_prints_one_error_for_unsendable_names(server, capsys, command, name):
    server.answer = 404, sized(b"{}"), b"{}"
    assert ctl(server, *command, name) == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize(
    "option",
    ["a=" + "[" * 50_000, "a=2001-01-01", "a=.nan", "a={b: 1}", "a=\x00", "a", "=1", "a=!!python/name:os.system"],
)
def test_ctl_prints_one_error_for_unsendable_options(server, capsys, option):
    server.answer = 404, sized(b"{}"), b"{}"
    assert ctl(server, "replay", "r", "--option", option) == BAD_INPUT
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/stdin", "/nowhere", "fifo", "folder with a link"])
def test_ctl_prints_one_error_for_upload_of_non_regular_file(server, capsys, tmp_path, path):
    server.answer = 404, sized(b"{}"), b"{}"
    if path == "fifo":
        os.mkfifo(tmp_path / "fifo")
        path = str(tmp_path / "fifo")
    elif path == "folder with a link":
        (tmp_path / "x").symlink_to("/etc/passwd")
        path = str(tmp_path)
    assert ctl(server, "add-recording", "r1", path) == BAD_INPUT
    assert _is_one_sentence(capsys)


DOWNLOADS = {
    "result": lambda file: ["result", "0" * 16, "report.html", "--out", file],
    "export": lambda file: ["export", "liver", "1", file, "--format", "ply"],
    "fetch": lambda file: ["fetch", "s", "1", file, "--format", "ply"],
}


@pytest.mark.parametrize("command", DOWNLOADS)
@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_ctl_download_does_not_overwrite_foreign_file(server, capsys, tmp_path, command, overwrite):
    server.answer = 200, sized(b"new"), b"new"
    (tmp_path / "mine.html").write_text("mine")
    assert ctl(server, *DOWNLOADS[command](str(tmp_path / "mine.html")), *overwrite) == BAD_INPUT
    assert (tmp_path / "mine.html").read_text() == "mine"
    assert _is_one_sentence(capsys)


def test_ctl_download_overwrites_own_file_only_on_request(server, tmp_path):
    page, file = b"<!doctype html><title>IntraSplat</title>", tmp_path / "report.html"
    server.answer = 200, sized(page), page
    assert ctl(server, *DOWNLOADS["result"](str(file))) == OK
    assert ctl(server, *DOWNLOADS["result"](str(file))) == BAD_INPUT
    assert ctl(server, *DOWNLOADS["result"](str(file)), "--overwrite") == OK


SILENT = {
    "render": lambda file: ["render", "liver", "1", file],
    "audit": lambda file: ["audit", "--format", "csv"],
    "camera": lambda file: ["camera", "s"],
    "delete": lambda file: ["delete", "stream", "s", "--yes"],
}


@pytest.mark.parametrize("status", [200, 204])
@pytest.mark.parametrize("command", SILENT)
def test_ctl_fails_for_response_without_request_id(server, capsys, tmp_path, command, status):
    """An example is the sign-in page of a proxy. These commands do not parse the body of the response."""
    body = b"<html>sign in</html>" if status == 200 else b""
    server.answer = status, {"Content-Length": str(len(body))}, body
    assert ctl(server, *SILENT[command](str(tmp_path / "x.png"))) == BAD_INPUT
    assert list(tmp_path.iterdir()) == []
    assert _is_one_sentence(capsys)


@pytest.mark.parametrize(
    "headers",
    [
        {"Content-Length": "100", "X-Request-ID": "0"},
        {"Content-Digest": "sha-256=:AAAA:", "Content-Length": "3", "X-Request-ID": "0"},
        {"X-Request-ID": "0"},
        {"Transfer-Encoding": "chunked", "X-Request-ID": "0"},
    ],
    ids=str,
)
@pytest.mark.parametrize("command", DOWNLOADS)
def test_ctl_incomplete_download_leaves_no_file(server, capsys, tmp_path, command, headers):
    server.answer = 200, headers, b"new"
    assert ctl(server, *DOWNLOADS[command](str(tmp_path / "x.html"))) == BAD_INPUT
    assert list(tmp_path.iterdir()) == []
    assert _is_one_sentence(capsys)
