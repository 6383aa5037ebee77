"""Input files that are pipes, devices, sockets or damaged: one error sentence, no hang, no traceback."""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path

import pytest

from gsplat_core.endoscope.onnx import read_model
from gsplat_core.errors import UserError
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.camera_path import read_camera_path
from gsplat_core.io.files import open_regular, read_regular
from gsplat_core.io.ply import load_ply
from gsplat_core.io.surface_files import read_surface
from operators.frame_log import read_frames
from services.audit import verify
from services.auth.keys import KeyStore, KeysUnreadable
from services.settings import load_settings

READERS = {
    "mesh.stl": read_surface,
    "mesh.ply": read_surface,
    "mesh.obj": read_surface,
    "path.json": read_camera_path,
    "settings.yaml": load_settings,
    "net.onnx": lambda path: read_model(path, "network"),
    "scene.ply": load_ply,
    "model.safetensors": lambda path: load_bundle(path.parent),
    "keys.json": lambda path: KeyStore(path).all(),
    "audit.jsonl": verify,
    "frames.jsonl": lambda path: list(read_frames(path)),
}
"""Readers of named files. Each reads the file at its path."""


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # a socket's name is at most 107 bytes
    try:
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(path.name)
        listener.close()
    finally:
        os.chdir(here)


KINDS = {
    "pipe": _fifo,
    "socket": _socket,
    "endless device": lambda path: path.symlink_to("/dev/zero"),
    "empty device": lambda path: path.symlink_to("/dev/null"),
    "folder": lambda path: path.mkdir(),
    "link to itself": lambda path: path.symlink_to(path.name),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", READERS)
def test_readers_refuse_non_regular_files(tmp_path, name, kind):
    KINDS[kind](tmp_path / name)
    with pytest.raises((UserError, OSError)) as refused:
        READERS[name](tmp_path / name)
    if not isinstance(refused.value, UserError):
        assert refused.value.filename == str(tmp_path / name), "the command names the file in its sentence"


@pytest.mark.parametrize("kind", KINDS)
def test_open_regular_error_names_kind_of_file(tmp_path, kind):
    KINDS[kind](tmp_path / "x")
    with pytest.raises(OSError) as refused:
        open_regular(tmp_path / "x")
    assert kind == "link to itself" or kind.split()[-1] in str(refused.value.strerror)


def test_read_regular_refuses_file_over_size_limit(tmp_path):
    (tmp_path / "x").write_bytes(bytes(11))
    assert read_regular(tmp_path / "x", 11) == bytes(11)
    with pytest.raises(OSError, match="larger than 10 bytes"):
        read_regular(tmp_path / "x", 10)


def test_open_regular_raises_oserror_for_name_with_zero_byte():
    with pytest.raises(OSError, match="cannot be used"):
        open_regular("a\0b")


KEY = {"id": "a" * 8, "name": "n", "role": "viewer", "sha256": "0" * 64, "created_at": "2026-01-01T00:00:00+00:00"}


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"null", b"[]", b"{}", b'{"keys": null}', b'{"keys": 1}', b'{"keys": [1]}', b'{"keys": [{}]}',
        b'{"keys": [null]}', b'{"keys": {"a": 1}}', b"\xff\xfe", b"[" * 100_000, bytes(100),
        json.dumps({"keys": [{**KEY, "extra": 1}]}).encode(),
        *(json.dumps({"keys": [{**KEY, name: value}]}).encode() for name in KEY for value in (1, [], {"a": 1}, True)),
        *(json.dumps({"keys": [{k: v for k, v in KEY.items() if k != name}]}).encode() for name in KEY),
    ],
)  # fmt: skip
def test_key_store_raises_keys_unreadable_for_damaged_file(tmp_path, content):
    (tmp_path / "keys.json").write_bytes(content)
    with pytest.raises(KeysUnreadable, match=r"keys\.json .*(damaged|cannot be read)"):
        KeyStore(tmp_path / "keys.json").all()


ENTRY = {
    "seq": 0, "at": "2026-01-01T00:00:00+00:00", "event": "a.b", "actor": "system", "role": "", "subject": "x", "outcome": "done",
    "request_id": "", "detail": {}, "previous": "0" * 64, "digest": "0" * 64,
}  # fmt: skip


@pytest.mark.parametrize(
    "line",
    [
        b"[" * 5000, b'{"a":' * 1300, b"null", b"1", b"\xff", b"\0" * 50, b"9" * 5000, b'"\\ud800"',
        *(json.dumps({**ENTRY, name: value}).encode() for name in ENTRY for value in (None, 1.5, True, [], [[]], {"a": [1]}, 10**30)),
        *(json.dumps({k: v for k, v in ENTRY.items() if k != name}).encode() for name in ENTRY),
        json.dumps({**ENTRY, "more": 1}).encode(),
    ],
)  # fmt: skip
@pytest.mark.parametrize("where", ["audit.jsonl", "audit.head", "audit.anchor"])
def test_verify_reports_damaged_audit_files_as_not_intact(tmp_path, line, where):
    (tmp_path / "audit.jsonl").write_bytes(b"")
    (tmp_path / where).write_bytes(line + b"\n")
    verdict = verify(tmp_path / "audit.jsonl")
    assert not verdict.intact
