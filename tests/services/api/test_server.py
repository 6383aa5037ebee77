"""The server as a process: start, real sockets, slow clients, TLS, drain."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fastapi import FastAPI
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from services.api.server import bind, serve
from services.cli.serve import serve_command
from services.client import Client, Unreachable
from services.errors import CannotServe, SettingsInvalid
from services.settings import ServiceSettings

ROOT = Path(__file__).resolve().parents[3]
SERVE = [sys.executable, "-m", "services.cli", "serve", "--port", "0", "--set", "streams={}"]


@contextmanager
def serving(folder: Path, *options: str) -> Iterator[tuple[subprocess.Popen, int, str]]:
    """Start a server process. Yield the process, its port and the administrator's key."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("INTRASPLAT_")}
    process = subprocess.Popen(
        [*SERVE, "--data", str(folder), "--set", f"paths.runtime={folder / 'r'}", *options],
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    )
    assert process.stderr is not None
    try:
        lines = []
        for line in process.stderr:
            lines.append(line)
            found = re.search(r"IntraSplat is on https?://\S+?:(\d+)/", line)
            if found:
                break
        else:
            raise AssertionError("".join(lines))
        process.lines = lines  # type: ignore[attr-defined]
        reader = threading.Thread(target=lambda: lines.extend(process.stderr))
        reader.start()
        yield process, int(found[1]), (folder / "admin.key").read_text().strip()
        process.terminate()  # not killed: it ends what it has started
        process.wait(300)
        reader.join()
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    options = ["--set", "limits.head_s=3", "--set", "limits.stall_s=3"]
    with serving(tmp_path_factory.mktemp("server"), *options) as server:
        yield server


def ask(port: int, path: str, key: str | None = None, method: str = "GET", **headers: str):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300)
    if key is not None:
        headers["Authorization"] = f"Bearer {key}"
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def raw(port: int, data: bytes, timeout_s: float = 300.0) -> bytes:
    """Return the whole response until the server closes the connection."""
    with socket.create_connection(("127.0.0.1", port), timeout=timeout_s) as client:
        client.sendall(data)
        answer = b""
        while part := client.recv(65536):
            answer += part
        return answer


def test_server_omits_server_header(served):
    _, port, key = served
    answer, body = ask(port, "/v1/version", key)
    assert answer.status == 200 and json.loads(body)["api"] == "v1"
    assert answer.headers["server"] is None
    assert ask(port, "/v1/version")[0].status == 401


def test_bind_sets_tcp_nodelay_on_accepted_connections():
    with bind(ServiceSettings(server={"port": 0})) as listener:
        client = socket.create_connection(listener.getsockname())
        connection, _ = listener.accept()
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
        client.close()
        connection.close()


def test_serve_does_not_print_admin_key(served):
    process, _, key = served
    said = "".join(process.lines)
    assert key not in said and key.split("_", 2)[2] not in said
    assert "admin.key" in said


def test_server_closes_connection_with_incomplete_head(served):
    _, port, _ = served
    assert raw(port, b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX-Slow: ") == b""
    assert raw(port, b"") == b""


def test_stalled_request_body_returns_408(served):
    _, port, key = served
    head = (
        f"POST /v1/tickets HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {key}\r\nContent-Type: application/json\r\n"
        'Content-Length: 100\r\n\r\n{"path'
    )
    answer = raw(port, head.encode())
    assert answer.startswith(b"HTTP/1.1 408 ") and b"connection: close" in answer.lower()


def test_refused_request_is_answered_before_body_arrives(served):
    _, port, key = served
    for authorization, status in ((f"Authorization: Bearer {key}\r\n", b"413"), ("", b"401")):
        head = f"PUT /v1/models/a/versions HTTP/1.1\r\nHost: localhost\r\n{authorization}Content-Length: 999999999999\r\n\r\n"
        answer = raw(port, head.encode())
        assert answer.startswith(b"HTTP/1.1 " + status) and b"connection: close" in answer.lower()


@pytest.mark.parametrize(
    "head",
    [
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost : localhost\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\n folded: y\r\nTransfer-Encoding: x\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
        "GET /livez HTTP/1.1\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked, identity\r\n\r\n0\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: xchunked\r\n\r\n0\r\n\r\n",
        "GET /livez HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\nContent-Length\x00: 5\r\n\r\n",
        "GET /livez HTTP/1.1\nHost: localhost\rX: y\n\n",
        "\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    ],
)
def test_ambiguous_request_framing_returns_400(served, head):
    """Request smuggling: framing that a proxy could read differently is refused."""
    _, port, _ = served
    answer = raw(port, head.encode("latin1")).lower()
    assert answer.startswith(b"http/1.1 400") and b"connection: close" in answer and answer.count(b"http/1.1") == 1


def test_endless_request_head_returns_431(served):
    _, port, _ = served
    try:
        answer = raw(port, b"GET /livez HTTP/1.1\r\nHost: localhost\r\nA: " + 1_000_000 * b"a")
    except ConnectionResetError:
        return  # closed while there was more to read
    assert answer.startswith(b"HTTP/1.1 431")


def test_request_logs_are_json_without_query(served):
    process, port, key = served
    answer, _ = ask(port, "/v1/streams/a/mjpeg?ticket=s3cret", key)
    number = answer.headers["x-request-id"]
    for _ in range(15_000):
        lines = [json.loads(line) for line in process.lines if line.startswith("{") and number in line]
        if lines:
            break
        time.sleep(0.02)
    assert lines[0]["route"] == "/v1/streams/{name}/mjpeg" and lines[0]["status"] == answer.status
    assert "s3cret" not in "".join(process.lines)


@pytest.mark.parametrize("form", ["json", "text"])
@pytest.mark.slow
def test_logs_omit_websocket_ticket(tmp_path, form):
    with serving(tmp_path, "--set", f"log.format={form}") as (process, port, _):
        with pytest.raises(InvalidStatus):
            connect(f"ws://127.0.0.1:{port}/v1/streams/a/display?ticket=s3cret")
        for _ in range(15_000):
            said = [line for line in process.lines if "ticket=" in line]
            if said:
                break
            time.sleep(0.02)
        assert said and "s3cret" not in "".join(process.lines)
        assert "handshake" not in "".join(process.lines)  # to refuse is no error


def test_serve_exits_0_on_sigterm_and_writes_audit_entry(tmp_path):
    with serving(tmp_path) as (process, port, key):
        assert ask(port, "/v1/version", key)[0].status == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(300) == 0
    last = (tmp_path / "audit.jsonl").read_text().splitlines()[-1]
    assert json.loads(last)["event"] == "service.stop"


@pytest.mark.slow
def test_second_server_of_same_data_folder_exits_2(served, tmp_path):
    folder = next(argument for argument in served[0].args if "server" in str(argument) and os.path.isdir(argument))
    done = subprocess.run([*SERVE, "--data", folder], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2 and "another process" in done.stderr and "Traceback" not in done.stderr


def test_bind_and_serve_command_raise_for_invalid_settings(served, tmp_path):
    """The exit code without a traceback is covered by `test_second_server_of_same_data_folder_exits_2`."""
    _, port, _ = served
    for server, said in (
        ({"port": port}, "cannot listen on 127.0.0.1"),
        ({"host": "0.0.0.0", "port": 0}, "without TLS"),
    ):
        with pytest.raises(CannotServe, match=said):
            bind(ServiceSettings(server=server))
    for setting, said in (("server.prt=1", "the nearest is 'port'"), ("server", "--set 'server' has no value")):
        with pytest.raises(SettingsInvalid, match=re.escape(said)):
            serve_command(None, None, None, tmp_path, [setting])


@pytest.fixture(scope="module")
def certificate(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("tls")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")],
        check=True, capture_output=True,
    )  # fmt: skip
    return folder


@pytest.mark.parametrize("files", [("cert.pem", "other.pem"), ("cert.pem", "nope"), ("key.pem", "key.pem")])
def test_serve_raises_for_unusable_certificate(certificate, files):
    other = ["openssl", "genpkey", "-algorithm", "ed25519", "-out", str(certificate / "other.pem")]
    subprocess.run(other, check=True, capture_output=True)
    certfile, keyfile = (certificate / name for name in files)
    settings = ServiceSettings(server={"port": 0, "certfile": certfile, "keyfile": keyfile})
    with bind(settings) as listener, pytest.raises(CannotServe, match=r"check server\.certfile"):
        serve(FastAPI(), settings, listener, print)


@pytest.mark.slow
def test_server_over_tls_refuses_plain_http_and_old_tls_versions(certificate, tmp_path):
    options = [
        "--set",
        f"server.certfile={certificate / 'cert.pem'}",
        "--set",
        f"server.keyfile={certificate / 'key.pem'}",
    ]
    with serving(tmp_path, *options) as (_, port, key):
        context = ssl.create_default_context(cafile=str(certificate / "cert.pem"))
        connection = http.client.HTTPSConnection("127.0.0.1", port, context=context, timeout=300)
        connection.request("GET", "/livez")
        answer = connection.getresponse()
        assert answer.status == 200 and answer.headers["strict-transport-security"]
        connection.close()
        url = f"https://127.0.0.1:{port}"
        with Client(url, key, verify=str(certificate / "cert.pem")) as client:
            assert "streams" in client.about()["parts"]
        with Client(url, key) as stranger, pytest.raises(Unreachable, match="certificate"):
            stranger.about()
        try:
            in_the_clear = raw(port, b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n")
        except ConnectionResetError:
            in_the_clear = b""
        assert in_the_clear == b""
        old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
        with pytest.warns(DeprecationWarning):
            old.maximum_version = ssl.TLSVersion.TLSv1_1
        with pytest.raises((ssl.SSLError, OSError)), socket.create_connection(("127.0.0.1", port)) as client:
            old.wrap_socket(client)


@pytest.mark.slow
def test_renewed_certificate_is_served_without_restart(tmp_path):
    def renew(days: int) -> None:
        files = ["-keyout", str(tmp_path / "key.pem"), "-out", str(tmp_path / "cert.pem")]
        curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
        command = ["openssl", "req", "-x509", *curve, "-nodes", "-days", str(days), "-subj", "/CN=localhost", *files]
        subprocess.run(command, check=True, capture_output=True)

    renew(2)
    options = [f"--set=server.certfile={tmp_path / 'cert.pem'}", f"--set=server.keyfile={tmp_path / 'key.pem'}"]
    with serving(tmp_path, *options) as (_, port, key):
        url = f"https://127.0.0.1:{port}"
        with Client(url, key, verify=False) as client:
            before = re.search(r"expiry_timestamp_seconds ([0-9.e+]+)", client.metrics())[1]
            renew(40)
            end_s = time.monotonic() + 300
            while (now := re.search(r"expiry_timestamp_seconds ([0-9.e+]+)", client.metrics())[1]) == before:
                assert time.monotonic() < end_s
                time.sleep(0.02)
            assert float(now) - float(before) == pytest.approx(38 * 86400, abs=3600)
        pem = ssl.get_server_certificate(("127.0.0.1", port))
        assert pem.strip() == (tmp_path / "cert.pem").read_text().strip()
