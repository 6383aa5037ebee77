"""Hostile archives uploaded as recordings are refused with a sentence, and nothing is written outside their folder."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
import zlib
from pathlib import Path

import pytest

from services.recordings import check
from services.recordings.check import MOST_LIST_BYTES, ArchiveInvalid, unpack

SMALL = 3 << 20


@pytest.fixture(autouse=True)
def five_entries(monkeypatch):
    monkeypatch.setattr(check, "MOST_ENTRIES", 5)


def archive(*entries: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return a zip archive of the given files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as opened:
        for name, content in entries:
            opened.writestr(name, content)
    return buffer.getvalue()


def marked(name: str, **attributes: int) -> zipfile.ZipInfo:
    """Return a zip entry with changed attributes."""
    info = zipfile.ZipInfo(name)
    for attribute, value in attributes.items():
        setattr(info, attribute, value)
    return info


@pytest.fixture
def refused(tmp_path):
    """Return a function that unpacks an archive and returns the sentence of the refusal."""

    def refuse(content: bytes, most_bytes: int = SMALL) -> str:
        (tmp_path / "inside").mkdir(exist_ok=True)
        (tmp_path / "inside" / "upload").write_bytes(content)
        with pytest.raises(ArchiveInvalid) as error:
            unpack(tmp_path / "inside" / "upload", tmp_path / "inside" / "recording", most_bytes)
        assert {path.name for path in tmp_path.iterdir()} == {"inside"}
        assert {path.name for path in (tmp_path / "inside").iterdir()} <= {"upload", "recording"}
        return str(error.value)

    return refuse


@pytest.mark.parametrize(
    "name",
    [
        "../evil", "images/../../evil", "/etc/evil", "a//b", "./a", "a/./b", "..", "images/..", "C:/evil", "c:evil",
        "..\\evil", "images\\..\\evil", "\\\\host\\share", "../.hidden", "__MACOSX/../../evil",
    ],
)  # fmt: skip
def test_archive_with_path_traversal_is_refused(refused, name):
    assert "leads out of the recording" in refused(archive((name, b"x")))


@pytest.mark.parametrize(
    "name", ["imag\u00e9s/1.png", "a\nb", "a\x1b[31m", "-rf", "a" * 101, "a;b", "\u202egnp.exe", "$(id)"]
)
def test_archive_with_odd_names_is_refused_without_repeating_name(refused, name):
    said = refused(archive((name, b"x")))
    assert "other signs than letters" in said and name not in said


def test_archive_with_zero_byte_in_name_is_refused(refused):
    content = archive(("aaaa/evil.png", b"x")).replace(b"aaaa/evil", b"aaaa\0evil")
    assert "leads out" in refused(content) or "damaged" in refused(content)


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFCHR, stat.S_IFIFO, stat.S_IFSOCK, stat.S_IFBLK])
@pytest.mark.parametrize("system", [0, 3])
def test_archive_with_link_or_device_is_refused(refused, kind, system):
    entry = marked("images", external_attr=(kind | 0o777) << 16, create_system=system)
    assert "link or a device" in refused(archive((entry, b"/etc")))


def test_archive_writing_through_link_is_refused(refused):
    link = marked("images", external_attr=(stat.S_IFLNK | 0o777) << 16)
    assert "link or a device" in refused(archive((link, b"/tmp"), ("images/evil", b"x")))


def test_archive_over_compression_ratio_is_refused_before_unpacking(refused, tmp_path):
    said = refused(archive(("depth.npy", bytes(2 << 20)), method=zipfile.ZIP_DEFLATED))
    assert "over 100 times as many" in said and not (tmp_path / "inside" / "recording").exists()


def test_archive_over_total_size_is_refused(refused):
    files = [(f"{n}.npy", bytes(1 << 20)) for n in range(4)]
    assert "holds 4194304 bytes; at most 3145728" in refused(archive(*files, method=zipfile.ZIP_DEFLATED))


def test_archive_over_entry_limit_is_refused(refused, tmp_path):
    assert "has 6 files; at most 5" in refused(archive(*[(f"{n}.png", b"x") for n in range(6)]))
    (tmp_path / "five").write_bytes(archive(*[(f"{n}.png", b"x") for n in range(5)]))
    unpack(tmp_path / "five", tmp_path / "recording", SMALL)
    assert len(list((tmp_path / "recording").iterdir())) == 5


def test_archive_file_longer_than_listed_is_refused(refused):
    packed = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = packed.compress(bytes(1 << 20)) + packed.flush()
    content = bytearray(archive(("a.npy", bytes(1 << 20)), method=zipfile.ZIP_DEFLATED))
    assert data in bytes(content)
    for signature, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        struct.pack_into("<I", content, content.index(signature) + offset, 10)
    assert "damaged" in refused(bytes(content))


def test_archive_with_overlapping_files_is_refused(refused):
    content = bytearray(archive(("a.png", b"x" * 100), ("b.png", b"y" * 100)))
    second = content.rindex(b"PK\x01\x02")
    struct.pack_into("<I", content, second + 42, 0)  # b's list entry points at a
    assert "in the same place" in refused(bytes(content))


def test_archive_file_reaching_into_directory_is_refused(refused):
    content = bytearray(archive(("a.png", b"x" * 100)))
    for signature, offset in ((b"PK\x03\x04", 18), (b"PK\x01\x02", 20)):
        struct.pack_into("<II", content, content.index(signature) + offset, 120, 120)
    assert "into the list" in refused(bytes(content))


def test_archive_with_giant_directory_is_refused(refused):
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, MOST_LIST_BYTES + 1, 4, 0)
    assert "list of files has" in refused(b"PK\x03\x04" + bytes(MOST_LIST_BYTES + 1) + end)


@pytest.mark.parametrize("stated", [0, 1, 3, 60000])
def test_archive_with_wrong_entry_count_is_refused(refused, stated):
    content = bytearray(archive(("a.png", b"x"), ("b.png", b"y")))
    struct.pack_into("<HH", content, len(content) - 14, stated, stated)
    assert "says that there are" in refused(bytes(content))


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content[:-1],
        lambda content: content[: len(content) // 2],
        lambda content: content + b"tail",
        lambda content: b"#!/bin/sh\n" + content,
        lambda content: content[:-2] + b"\x04\x00evil",
        lambda content: b"PK\x05\x06",
        lambda content: content.replace(b"PK\x01\x02", b"PK\x01\x03"),
    ],
)
def test_truncated_or_extended_archive_is_refused(refused, change):
    assert refused(change(archive(("a.png", b"x" * 50))))


def test_zip64_archive_is_refused(refused):
    content = archive(("a.png", b"x"))
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, 0, 1)
    assert "zip64" in refused(content[:-22] + locator + content[-22:])
    saturated = bytearray(content)
    struct.pack_into("<HH", saturated, len(saturated) - 14, 0xFFFF, 0xFFFF)
    assert "zip64" in refused(bytes(saturated))


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_archive_with_other_compression_method_is_refused(refused, method):
    assert f"by method {method}" in refused(archive(("a.png", b"x" * 100), method=method))


def test_encrypted_archive_is_refused(refused):
    content = bytearray(archive(("a.png", b"x" * 100)))
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        struct.pack_into("<H", content, content.index(signature) + offset, 1)
    assert "encrypted" in refused(bytes(content))


def test_archive_with_wrong_checksum_is_refused(refused):
    content = archive(("a.png", b"x" * 100))
    assert "damaged" in refused(content.replace(b"x" * 100, b"x" * 99 + b"y"))


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("names", [("a.png", "a.png"), ("a.png", "A.PNG"), ("images", "images/a.png")])
def test_archive_with_colliding_names_is_refused(refused, names):
    assert "same name" in refused(archive(*[(name, b"x") for name in names])) or "name of a folder" in refused(
        archive(*[(name, b"x") for name in names])
    )


def test_archive_with_differing_local_name_is_refused(refused):
    content = archive(("aa/bb/evil", b"x"))
    assert "damaged" in refused(content.replace(b"aa/bb/evil", b"../../evil", 1))


@pytest.mark.parametrize("entries", [(), (("folder/", b""),), ((".hidden", b"x"),), (("__MACOSX/._a", b"x"),)])
def test_archive_without_files_is_refused(refused, entries):
    assert "holds no files" in refused(archive(*entries))


def test_unpack_omits_files_of_file_managers(tmp_path: Path):
    entries = [("case/images/0.png", b"x"), ("__MACOSX/case/images/._0.png", b"y"), ("case/.DS_Store", b"z")]
    (tmp_path / "upload").write_bytes(archive(*entries))
    unpack(tmp_path / "upload", tmp_path / "recording", SMALL)
    assert [path.relative_to(tmp_path / "recording").as_posix() for path in (tmp_path / "recording").rglob("*.*")] == [
        "images/0.png"
    ]
    assert stat.S_IMODE((tmp_path / "recording" / "images" / "0.png").stat().st_mode) == 0o600
