"""Connection limits per address, request head limits, and the separate probe listener."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import logging
import shutil
import socket
import tempfile
import threading
import time
from pathlib import Path

import pytest

from services.api import Parts, new_app
from services.api.guard import network_of_address
from services.api.server import AddressBound, BoundedListener, DrainingServer, bind, config_of
from services.api.service import MOST_CONNECTIONS, MOST_HEAD_BYTES, ProbeListener, bind_probe, probe_socket_is_there
from services.errors import CannotServe
from services.settings import ServiceSettings
from tests.services.api.conftest import fakes


@pytest.mark.parametrize(
    ("address", "counted_as"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::2", "2001:db8::/64"),
        ("2001:db8:0:1::2", "2001:db8:0:1::/64"),
        ("unknown", "unknown"),
    ],
)
def test_network_of_address_groups_ipv6_by_64_prefix(address, counted_as):
    assert network_of_address(address) == counted_as


def test_address_bound_limits_each_address_separately():
    refused = []
    bound = AddressBound(2, on_refused=lambda: refused.append(1))
    keys = [bound.enter("10.0.0.1"), bound.enter("10.0.0.1")]
    assert None not in keys and bound.enter("10.0.0.1") is None and len(refused) == 1
    assert bound.enter("10.0.0.2") is not None
    bound.leave(keys[0])
    assert bound.open("10.0.0.1") == 1 and bound.enter("10.0.0.1") is not None


@pytest.mark.parametrize(("most", "exempt"), [(0, ()), (1, ("10.0.0.0/8",)), (1, ("10.0.0.1/32", "192.168.0.0/16"))])
def test_address_bound_admits_all_if_zero_or_address_exempt(most, exempt):
    bound = AddressBound(most, exempt)
    assert all(bound.enter("10.0.0.1") is not None for _ in range(50))
    assert all(bound.enter("::ffff:10.0.0.1") is not None for _ in range(50))


def test_address_bound_logs_refusals_once_per_minute(caplog):
    now_s = 100.0
    bound = AddressBound(1, clock=lambda: now_s)
    bound.enter("10.0.0.1")
    for _ in range(20):
        bound.enter("10.0.0.1")
    assert caplog.text.count("10.0.0.1 has 1 connections") == 1
    now_s += 60
    bound.enter("10.0.0.1")
    assert caplog.text.count("10.0.0.1 has 1 connections") == 2


@pytest.fixture
def served():
    """Return a function that starts a server in a thread and returns its settings, bound and ports."""
    started = []

    with tempfile.TemporaryDirectory(prefix="isp-") as folder, contextlib.ExitStack() as stack:

        def start(parts=None, **limits):
            settings = ServiceSettings(
                paths={"data": Path(folder) / "data", "runtime": Path(folder) / "r"},
                server={"port": 0, "probe_port": 0},
                limits=limits,
            )
            settings.runtime_dir.mkdir()
            app = new_app(settings, parts or fakes.fake_parts())
            ready = threading.Event()
            bound = AddressBound(settings.limits.connections_per_address, settings.server.trusted_proxies)
            listener = stack.enter_context(BoundedListener.of(bind(settings), bound))
            probes = bind_probe(settings)
            ports = listener.getsockname()[1], probes[1].getsockname()[1]
            server = DrainingServer(
                config_of(app, settings), app.state.control, ready.set, ProbeListener(app.state.control, probes)
            )
            server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]
            thread = threading.Thread(target=lambda: server.run(sockets=[listener]))
            thread.start()
            started.append((server, thread))
            assert ready.wait(300)
            return settings, bound, *ports

        yield start
        for server, thread in started:
            server.should_exit = True
            thread.join(300)
            assert not thread.is_alive()
        assert not (Path(folder) / "r" / "probe.sock").exists()


def answer(family_and_address, data: bytes) -> bytes:
    """Return the whole response to some bytes; empty if the connection is reset."""
    family, address = family_and_address
    with socket.socket(family) as client:
        client.settimeout(300)
        found = b""
        try:
            client.connect(address)
            client.sendall(data)
            while part := client.recv(65536):
                found += part
        except (ConnectionResetError, BrokenPipeError):
            pass
        return found


def tcp(port: int):
    return socket.AF_INET, ("127.0.0.1", port)


LIVE = b"GET /livez HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"


def test_half_sent_heads_of_one_address_do_not_block_other_addresses(served):
    settings, bound, port, probe = served(connections_per_address=8, head_s=60)
    with contextlib.ExitStack() as open_:
        for _ in range(40):
            each = open_.enter_context(socket.create_connection(("127.0.0.1", port)))
            with contextlib.suppress(ConnectionResetError, BrokenPipeError):
                each.sendall(b"GET /livez HTTP/1.1\r\nHost: ")
        assert answer(tcp(port), LIVE) == b"", "this address has its share"
        assert bound.open("127.0.0.1") == 8
        for where in (tcp(probe), (socket.AF_UNIX, str(settings.runtime_dir / "probe.sock"))):
            assert answer(where, LIVE).startswith(b"HTTP/1.1 200 OK")
        # Another address of this machine.
        with socket.socket() as other:
            other.bind(("127.0.0.2", 0))
            other.connect(("127.0.0.1", port))
            other.settimeout(300)
            other.sendall(LIVE)
            assert other.recv(100).startswith(b"HTTP/1.1 200")
    while bound.open("127.0.0.1"):  # they have left: the server closes its side soon
        pass
    assert answer(tcp(port), LIVE).startswith(b"HTTP/1.1 200")


def test_server_closes_trickled_request_head_after_head_s(served):
    _, _, port, _ = served(head_s=0.3)
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.settimeout(300)
        ended = threading.Event()

        def trickle() -> None:
            with contextlib.suppress(OSError):
                while not ended.wait(0.02):
                    slow.sendall(b"a")

        thread = threading.Thread(target=trickle)
        thread.start()
        with contextlib.suppress(ConnectionResetError):
            assert slow.recv(100) == b""
        ended.set()
        thread.join()


def test_probe_listener_serves_livez_and_readyz_only(served):
    from services.schemas import CheckResult

    async def broken():
        return CheckResult(False, "no database")

    settings, _, _, probe = served(fakes.fake_parts(checks={"models": broken}))
    for path, status, said in (
        ("/livez", 200, {"status": "alive"}),
        ("/readyz", 503, {"status": "not ready"}),
        ("/metrics", 404, {"status": "only /livez and /readyz are here"}),
        ("/v1/streams", 404, {"status": "only /livez and /readyz are here"}),
    ):
        found = answer(tcp(probe), f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        head, _, body = found.partition(b"\r\n\r\n")
        assert head.startswith(f"HTTP/1.1 {status} ".encode()) and json.loads(body) == said
    verbose = answer(tcp(probe), b"GET /readyz?verbose HTTP/1.1\r\n\r\n").partition(b"\r\n\r\n")[2]
    assert json.loads(verbose)["checks"]["models"] == {"ok": False, "detail": "no database", "needed": True}
    assert (settings.runtime_dir / "probe.sock").is_socket()


@pytest.mark.parametrize(
    ("data", "begins"),
    [
        (b"POST /livez HTTP/1.1\r\n\r\n", b"HTTP/1.1 405 "),
        (b"HEAD /livez HTTP/1.1\r\n\r\n", b"HTTP/1.1 200 "),
        (b"\r\n\r\n", b"HTTP/1.1 405 "),
        (b"GET http://[::1 HTTP/1.1\r\n\r\n", b"HTTP/1.1 404 "),
        (b"GET /livez" + MOST_HEAD_BYTES * b"a" + b"\r\n\r\n", b""),
        (bytes(range(256)) + b"\r\n\r\n", b"HTTP/1.1 405 "),
    ],
    ids=["post", "head", "empty", "no url", "long", "bytes"],
)
def test_probe_listener_survives_malformed_requests(served, data, begins):
    _, _, _, probe = served()
    found = answer(tcp(probe), data)
    assert found.startswith(begins) and (begins or found == b"")
    assert data[:4] != b"HEAD" or found.endswith(b"\r\n\r\n")
    assert answer(tcp(probe), LIVE).startswith(b"HTTP/1.1 200")


def test_probe_listener_answers_while_idle_connections_are_open(served):
    _, _, _, probe = served()
    with contextlib.ExitStack() as open_:
        for _ in range(3 * MOST_CONNECTIONS):
            open_.enter_context(socket.create_connection(("127.0.0.1", probe)))
        assert answer(tcp(probe), LIVE).startswith(b"HTTP/1.1 200")


def test_readiness_states_removed_runtime_folder():
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        runtime = Path(folder) / "runtime"
        runtime.mkdir()
        settings = ServiceSettings(paths={"runtime": runtime})
        [listener] = bind_probe(settings)
        with listener:
            found = asyncio.run(probe_socket_is_there(settings))
            assert (found.ok, found.detail) == (True, "probe.sock is there")
            shutil.rmtree(runtime)
            found = asyncio.run(probe_socket_is_there(settings))
            assert (found.ok, found.needed) == (False, False) and "restart the service" in found.detail


def test_bind_probe_raises_if_port_or_socket_is_taken_or_folder_missing(tmp_path):
    with tempfile.TemporaryDirectory(prefix="isp-") as folder, socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        settings = ServiceSettings(paths={"runtime": folder}, server={"probe_port": port})
        with pytest.raises(CannotServe, match=r"another server\.probe_port"):
            bind_probe(settings)
        assert not (Path(folder) / "probe.sock").exists()
        settings = ServiceSettings(paths={"runtime": folder})
        first = bind_probe(settings)
        with pytest.raises(CannotServe, match="another service"):
            bind_probe(settings)
        first[0].close()  # as a service that was killed leaves it
        for each in bind_probe(settings):
            each.close()
    with pytest.raises(CannotServe, match=r"another paths\.runtime"):
        bind_probe(ServiceSettings(paths={"runtime": tmp_path / "nope"}))


def test_request_head_over_size_limit_returns_431(served):
    _, _, port, _ = served()
    for size, status in ((30_000, b"200"), (33_000, b"431"), (70_000, b"431"), (200_000, b"431")):
        fields = b"X-Long: " + size * b"a" + b"\r\n"
        found = answer(tcp(port), LIVE.replace(b"Host", fields + b"Host", 1))
        assert found.startswith(b"HTTP/1.1 " + status), size
    many = b"".join(b"X-%d: a\r\n" % number for number in range(5000))
    assert answer(tcp(port), LIVE.replace(b"Host", many + b"Host", 1)).startswith(b"HTTP/1.1 431")
    long = LIVE.replace(b"/livez", b"/livez?" + 40_000 * b"a")
    assert answer(tcp(port), long).startswith(b"HTTP/1.1 431")
    twice = LIVE.replace(b"Connection: close\r\n", b"") + LIVE.replace(
        b"Host", b"X-L: " + 60_000 * b"a" + b"\r\nHost", 1
    )
    assert b"HTTP/1.1 431" in answer(tcp(port), twice)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (b"Content-Length: -1\r\n", b"bad Content-Length"),
        (b"Content-Length: " + 30 * b"9" + b"\r\n", b"bad Content-Length"),
        (b"Transfer-Encoding: gzip\r\n", b"Only Transfer-Encoding: chunked is supported"),
        (b"no colon\r\n", b"illegal header line"),
    ],
)
def test_malformed_head_returns_400_despite_following_bytes(served, fields, text):
    _, _, port, _ = served()
    found = answer(tcp(port), LIVE.replace(b"Host", fields + b"Host", 1) + bytes(100_000))
    assert found.startswith(b"HTTP/1.1 400 ") and text in found, found


def test_malformed_chunk_after_response_closes_without_traceback(served, caplog):
    _, _, port, _ = served()
    head = b"PUT /v1/models/a/versions HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.settimeout(300)
        client.sendall(head)
        assert client.recv(65536).startswith(b"HTTP/1.1 401 ")
        client.sendall(b"no number\r\n")
        with contextlib.suppress(ConnectionResetError):
            while client.recv(65536):
                pass
    assert "Traceback" not in caplog.text


HANDSHAKE = (
    b"GET /v1/streams/x/display HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


def test_refused_websocket_handshake_gets_status_and_is_closed(served):
    """Refusals by HTTP parser, WebSocket parser and application all answer and close the connection."""
    _, bound, port, _ = served()
    line = b"X-Long: " + 20_000 * b"a" + b"\r\n"
    lines = b"".join(b"X-%d: a\r\n" % number for number in range(300))
    total = b"".join(b"X-%d: " % number + 7000 * b"a" + b"\r\n" for number in range(6))
    for extra, status in (
        (b"", b"401"),
        (line, b"431"),
        (lines, b"431"),
        (total, b"431"),
        (4 * line, b"431"),
        (10 * line, b"431"),
        (b"Content-Length: 5\r\n", b"400"),
        (b"Transfer-Encoding: chunked\r\n", b"400"),
        (b"Host: localhost\r\n", b"400"),
    ):
        found = answer(tcp(port), HANDSHAKE.replace(b"Host", extra + b"Host", 1))
        assert found.startswith(b"HTTP/1.1 " + status), (extra[:40], found[:80])
    long = HANDSHAKE.replace(b"/display", b"/display?" + 9000 * b"a")
    assert answer(tcp(port), long).startswith(b"HTTP/1.1 431")
    for _ in range(15_000):
        if not bound.open("127.0.0.1"):
            break
        time.sleep(0.02)
    assert bound.open("127.0.0.1") == 0


def test_refused_upload_gets_response_after_sending_whole_body(served):
    _, _, port, _ = served(model_bytes=2**20)
    size = 24 * 2**20
    head = f"PUT /v1/models/a/versions HTTP/1.1\r\nHost: localhost\r\nContent-Length: {size}\r\n\r\n".encode()
    found = answer(tcp(port), head + bytes(size))
    assert found.startswith(b"HTTP/1.1 401 ") and b"connection: close" in found.lower()
    chunked = b"PUT /v1/models/a/versions HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    chunks = 24 * (b"100000\r\n" + bytes(2**20) + b"\r\n") + b"0\r\n\r\n"
    assert answer(tcp(port), chunked + chunks).startswith(b"HTTP/1.1 401 ")


def test_refused_endless_upload_is_cut_off(served):
    _, _, port, _ = served(stall_s=0.3)
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.settimeout(300)
        client.sendall(b"PUT /v1/models/a/versions HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999999\r\n\r\n")
        assert client.recv(65536).startswith(b"HTTP/1.1 401 ")
        with pytest.raises(OSError, match=r"reset|Broken pipe"):
            while True:
                client.sendall(bytes(65536))


def test_probe_listener_close_ends_connections_and_removes_socket():
    async def run() -> None:
        with tempfile.TemporaryDirectory(prefix="isp-") as folder:
            settings = ServiceSettings(paths={"data": Path(folder) / "d", "runtime": folder}, server={"probe_port": 0})
            app = new_app(settings, Parts())
            probe = ProbeListener(app.state.control, bind_probe(settings))
            await probe.open()
            reader, writer = await asyncio.open_unix_connection(f"{folder}/probe.sock")
            while not probe._open:
                await asyncio.sleep(0.001)
            await probe.close()
            assert await reader.read() == b"" and not Path(folder, "probe.sock").exists()
            writer.close()
            app.state.control.audit.close()

    asyncio.run(run())


@pytest.mark.parametrize(
    ("method", "path", "more"),
    [
        ("PUT", "/v1/models/a/versions", f"Content-Digest: sha-256=:{base64.b64encode(bytes(32)).decode()}:\r\n"),
        ("PUT", "/v1/recordings/a", f"Content-Digest: sha-256=:{base64.b64encode(bytes(32)).decode()}:\r\n"),
        ("POST", "/v1/tickets", "Content-Type: application/json\r\n"),
        ("POST", "/v1/streams", "Content-Type: application/json\r\n"),
    ],
)
@pytest.mark.parametrize("sent", [b"", b'{"path', 2_000_000 * b"a"], ids=["nothing", "a part", "much"])
def test_client_disconnect_during_upload_is_not_logged_as_error(served, caplog, method, path, more, sent):
    caplog.set_level(logging.INFO)
    settings, bound, port, _ = served()
    key = settings.admin_key_file.read_text().strip()
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {key}\r\nContent-Length: 900000\r\n{more}\r\n"
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(head.encode() + sent[:800_000])
    while bound.open("127.0.0.1") or f"{method} {path.replace('/a', '/{name}')}" not in caplog.text:
        time.sleep(0.005)
    assert "bug" not in caplog.text and "Traceback" not in caplog.text
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert list((settings.data_dir / "uploads").iterdir()) == []
    outcomes = {
        entry["outcome"] for entry in map(json.loads, (settings.data_dir / "audit.jsonl").read_text().splitlines())
    }
    assert "failed" not in outcomes


def test_address_bound_forgets_address_after_last_connection():
    from services.api.server import AddressBound

    bound = AddressBound(3)
    keys = [bound.enter("192.0.2.1") for _ in range(2)]
    bound.leave(keys[0])
    assert bound.open("192.0.2.1") == 1
    bound.leave(keys[1])
    assert bound.open("192.0.2.1") == 0 and not bound._open
