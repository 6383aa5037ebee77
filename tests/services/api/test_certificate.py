"""The server's certificate: reload while serving, unusable files, expiry."""

from __future__ import annotations

import asyncio
import os
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from services.api.server import ServerCertificate, expiry_of
from services.audit.log import SystemEvents

x509 = pytest.importorskip("cryptography.x509", reason="cryptography comes with the extra oidc")
from cryptography.hazmat.primitives import hashes, serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import ec, rsa  # noqa: E402

SOON = datetime(2030, 5, 17, 12, 30, 15, tzinfo=UTC)


def self_signed(until: datetime = SOON, name: str = "room-1.example", kind: str = "ec"):
    """Return a self-signed certificate and its key."""
    key = ec.generate_private_key(ec.SECP256R1()) if kind == "ec" else rsa.generate_private_key(65537, 2048)
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    certificate = (
        x509.CertificateBuilder().subject_name(subject).issuer_name(subject).public_key(key.public_key())
        .serial_number(x509.random_serial_number()).not_valid_before(datetime(2020, 1, 1)).not_valid_after(until)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False).sign(key, hashes.SHA256())
    )  # fmt: skip
    return certificate, key


def pem(certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_pem(key, passphrase: bytes | None = None) -> bytes:
    guard = serialization.BestAvailableEncryption(passphrase) if passphrase else serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, guard)


def write_pair(folder: Path, certificate: bytes, key: bytes) -> tuple[Path, Path]:
    """Replace certificate and key files atomically, as a renewal does."""
    for name, content in (("cert.pem", certificate), ("key.pem", key)):
        (folder / "new").write_bytes(content)
        os.replace(folder / "new", folder / name)
    return folder / "cert.pem", folder / "key.pem"


@contextmanager
def listening(certificate: ServerCertificate, pair: tuple[Path, Path]) -> Iterator[int]:
    """Run a TLS server with one context for its lifetime, as `serve` does, and yield its port."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*pair)
    certificate.attach(context)
    with socket.create_server(("127.0.0.1", 0)) as listener, context.wrap_socket(listener, server_side=True) as server:

        def accept() -> None:
            while True:
                try:
                    server.accept()[0].close()
                except ssl.SSLError:
                    continue
                except OSError:
                    return

        thread = threading.Thread(target=accept)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def served_certificate(port: int, name: str | None) -> bytes:
    """Return the certificate that a new connection receives."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        socket.create_connection(("127.0.0.1", port), timeout=300) as plain,
        context.wrap_socket(plain, server_hostname=name) as client,
    ):
        return client.getpeercert(binary_form=True) or b""


def der(certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.DER)


@pytest.mark.parametrize("kind", ["ec", "rsa"])
@pytest.mark.parametrize(
    "until",
    [SOON, datetime(2049, 12, 31, 23, 59, 59, tzinfo=UTC), datetime(2050, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)],
)  # fmt: skip
def test_expiry_of_returns_not_after_of_certificate(until, kind):
    certificate, _ = self_signed(until, kind=kind)
    assert datetime.fromtimestamp(expiry_of(der(certificate)), UTC) == certificate.not_valid_after_utc == until


def test_expiry_of_raises_for_malformed_certificate():
    good = der(self_signed()[0])
    for bad in (b"", b"\x30", b"hello", good[:40], good[1:], bytes(len(good)), b"\x30\x84\xff\xff\xff\xff" + good):
        with pytest.raises((ValueError, IndexError)):
            expiry_of(bad)


def test_expires_at_is_earliest_expiry_in_chain(tmp_path):
    leaf, key = self_signed(SOON)
    authority, _ = self_signed(SOON - timedelta(days=400), "authority.example")
    certificate = ServerCertificate(*write_pair(tmp_path, b"a comment\n" + pem(leaf) + pem(authority), key_pem(key)))
    assert certificate.expires_at == authority.not_valid_after_utc


@pytest.mark.parametrize("name", ["room-1.example", None])
def test_new_connections_get_renewed_certificate_after_reload(tmp_path, name):
    old, old_key = self_signed()
    new, new_key = self_signed(SOON + timedelta(days=90), kind="rsa")
    pair = write_pair(tmp_path, pem(old), key_pem(old_key))
    certificate = ServerCertificate(*pair)
    with listening(certificate, pair) as port:
        assert not certificate.reload_if_changed()
        assert served_certificate(port, name) == der(old)
        write_pair(tmp_path, pem(new), key_pem(new_key))
        assert served_certificate(port, name) == der(old)
        assert certificate.reload_if_changed() and not certificate.reload_if_changed()
        assert served_certificate(port, name) == der(new)
        assert certificate.expires_at == new.not_valid_after_utc


def of_another_key(folder, new, key):
    write_pair(folder, pem(new), key_pem(self_signed()[1]))


def cut_off(folder, new, key):
    write_pair(folder, pem(new)[:300], key_pem(key))


def empty(folder, new, key):
    write_pair(folder, b"", b"")


def with_a_passphrase(folder, new, key):
    write_pair(folder, pem(new), key_pem(key, b"secret"))


def gone(folder, new, key):
    (folder / "cert.pem").unlink()


def a_folder(folder, new, key):
    (folder / "key.pem").unlink()
    (folder / "key.pem").mkdir()


def a_pipe(folder, new, key):
    (folder / "cert.pem").unlink()
    os.mkfifo(folder / "cert.pem")


def only_half_renewed(folder, new, key):
    (folder / "cert.pem").write_bytes(pem(new))


@pytest.mark.parametrize(
    "spoil", [of_another_key, cut_off, empty, with_a_passphrase, gone, a_folder, a_pipe, only_half_renewed]
)
def test_reload_keeps_old_certificate_if_new_files_are_unusable(tmp_path, caplog, spoil):
    old, old_key = self_signed()
    new, new_key = self_signed(SOON + timedelta(days=90))
    pair = write_pair(tmp_path, pem(old), key_pem(old_key))
    certificate = ServerCertificate(*pair)
    with listening(certificate, pair) as port:
        assert asyncio.run(certificate.check()).ok
        spoil(tmp_path, new, new_key)
        assert not certificate.reload_if_changed()
        assert served_certificate(port, "room-1.example") == der(old)
        assert certificate.expires_at == old.not_valid_after_utc
        checked = asyncio.run(certificate.check())
        assert not checked.ok and not checked.needed and "cannot be used" in checked.detail
        assert "2030-05-17 12:30 UTC" in checked.detail
        assert [record.levelname for record in caplog.records] == ["ERROR"]
        assert not certificate.reload_if_changed() and len(caplog.records) == 1, "said once for each change"
        if spoil is a_folder:
            (tmp_path / "key.pem").rmdir()
        write_pair(tmp_path, pem(new), key_pem(new_key))
        assert certificate.reload_if_changed()
        assert served_certificate(port, "room-1.example") == der(new)
        assert asyncio.run(certificate.check()).ok


@pytest.mark.parametrize("spoil", [of_another_key, cut_off, empty, with_a_passphrase, gone, a_folder, a_pipe])
def test_server_certificate_raises_for_unusable_files(tmp_path, spoil):
    new, key = self_signed()
    pair = write_pair(tmp_path, pem(new), key_pem(key))
    spoil(tmp_path, new, key)
    with pytest.raises(OSError):
        ServerCertificate(*pair)


def test_certificate_check_is_degraded_after_expiry(tmp_path):
    old, key = self_signed(datetime(2021, 1, 1, tzinfo=UTC))
    checked = asyncio.run(ServerCertificate(*write_pair(tmp_path, pem(old), key_pem(key))).check())
    assert (checked.ok, checked.needed) == (False, False)
    assert "has expired at 2021-01-01 00:00 UTC; renew it" in checked.detail


def test_certificate_metrics_report_expiry_and_failed_reload(tmp_path):
    old, key = self_signed()
    certificate = ServerCertificate(*write_pair(tmp_path, pem(old), key_pem(key)))

    def values():
        return {family.name: family.samples[0].value for family in certificate.collect()}

    names = "intrasplat_certificate_expiry_timestamp_seconds", "intrasplat_certificate_reload_failed"
    assert values() == dict(zip(names, (SOON.timestamp(), 0.0), strict=True))
    gone(tmp_path, None, None)
    certificate.reload_if_changed()
    assert values() == dict(zip(names, (SOON.timestamp(), 1.0), strict=True))


def test_watched_certificate_reloads_and_writes_audit_entries(tmp_path, monkeypatch):
    from services.api import server as module
    from services.audit import AuditLog, Wanted, search

    monkeypatch.setattr(module, "POLL_S", 0.01)
    audit, events = AuditLog(tmp_path / "audit.jsonl"), SystemEvents()
    old, key = self_signed()
    certificate = ServerCertificate(*write_pair(tmp_path, pem(old), key_pem(key)), events)

    async def until(count: int) -> None:
        end_s = time.monotonic() + 300
        while audit.head.seq + 1 < count:
            assert time.monotonic() < end_s
            await asyncio.sleep(0.01)

    async def renew() -> None:
        async with events.written_to(audit), certificate.watched():
            new, new_key = self_signed(SOON + timedelta(days=1))
            (tmp_path / "cert.pem").write_bytes(b"")
            await until(1)
            write_pair(tmp_path, pem(new), key_pem(new_key))
            end_s = time.monotonic() + 300
            while certificate.expires_at != new.not_valid_after_utc:
                assert time.monotonic() < end_s
                await asyncio.sleep(0.01)
            await until(2)

    asyncio.run(renew())
    entries = list(reversed(search(audit.path, Wanted(), 10).entries))
    audit.close()
    assert {entry.event for entry in entries} == {"certificate.reload"}
    assert (entries[0].outcome, entries[-1].outcome) == ("failed", "done")
    assert entries[-1].detail == {"expires_at": (SOON + timedelta(days=1)).isoformat()}
