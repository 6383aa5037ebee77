"""Rules for the directory of a zip archive, with each limit tested on both sides."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
from pathlib import PurePosixPath

import pytest

from services.recordings import check
from services.recordings.check import ArchiveInvalid, check_end, entries_of

MOST_BYTES = 100


@pytest.fixture(autouse=True)
def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "MOST_ENTRIES", 3)
    monkeypatch.setattr(check, "MOST_RATIO", 10)


def packed(*files: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_STORED) -> io.BytesIO:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in files:
            archive.writestr(name, content)
    return out


def listed(file: io.BytesIO, most_bytes: int = MOST_BYTES, stated: int | None = None) -> list[str]:
    entries = check_end(file)
    with zipfile.ZipFile(file) as archive:
        return [str(each.path) for each in entries_of(archive, file, entries if stated is None else stated, most_bytes)]


def with_end(**changed: int) -> io.BytesIO:
    """Return an archive of one file with changed values in its end record."""
    content = bytearray(packed(("a.png", b"x")).getvalue())
    names = ("disk", "list_disk", "entries", "every", "list_bytes", "list_at", "comment_bytes")
    values = dict(zip(names, struct.unpack_from("<4H2LH", content, len(content) - 18), strict=True)) | changed
    struct.pack_into("<4H2LH", content, len(content) - 18, *values.values())
    return io.BytesIO(bytes(content))


def test_check_end_returns_number_of_entries() -> None:
    assert check_end(packed(("a.png", b"x"), ("b.png", b"y"))) == 2
    assert check_end(packed()) == 0, "the shortest archive is nothing but its end"


@pytest.mark.parametrize(
    ("file", "why"),
    [
        (io.BytesIO(packed().getvalue()[:-1]), "cut off: it has 21 bytes"),
        (io.BytesIO(packed(("a.png", b"x")).getvalue() + b"behind"), "something follows"),
        (with_end(comment_bytes=1), "something follows"),
        (with_end(entries=0xFFFF), "zip64"),
        (with_end(every=0xFFFF), "zip64"),
        (with_end(list_bytes=0xFFFFFFFF), "zip64"),
        (with_end(list_at=0xFFFFFFFF), "zip64"),
        (with_end(disk=1), "several parts"),
        (with_end(list_disk=1), "several parts"),
        (with_end(every=2), "several parts"),
        (with_end(list_bytes=(16 << 20) + 1), "at most 16777216 are read"),
        (with_end(list_bytes=16 << 20), "not where its end says"),
        (with_end(list_at=1), "not where its end says"),
    ],
)  # fmt: skip
def test_check_end_refuses_damaged_multipart_or_zip64_archive(file: io.BytesIO, why: str) -> None:
    with pytest.raises(ArchiveInvalid, match=why):
        check_end(file)


def test_check_end_refuses_zip64_locator() -> None:
    content = packed().getvalue()
    with pytest.raises(ArchiveInvalid, match="zip64"):
        check_end(io.BytesIO(b"PK\x06\x07" + bytes(16) + content))


@pytest.mark.parametrize(
    ("names", "paths"),
    [
        (["images/0.png"], ["images/0.png"]),
        (["masks/0.png", "masks/1.png"], ["masks/0.png", "masks/1.png"]),
        (["rec/images/0.png", "rec/a.yaml"], ["images/0.png", "a.yaml"]),
        (["one/0.png", "two/0.png"], ["one/0.png", "two/0.png"]),
        (["rec", "b/c.png"], ["rec", "b/c.png"]),
        (["a/b/c/d/e.png"], ["b/c/d/e.png"]),
        (["__MACOSX/._0.png", ".DS_Store", "0.png"], ["0.png"]),
        (["rec/", "rec/0.png"], ["0.png"]),
        ([("n" * 100) + "/0.png"], ["0.png"]),
    ],
)
def test_entries_omit_common_folder_and_hidden_files(names: list[str], paths: list[str]) -> None:
    assert listed(packed(*((name, b"" if name.endswith("/") else b"x") for name in names))) == paths


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["../0.png"], "file 1 of the archive leads out"),
        (["a.png", "b/../0.png"], "file 2 of the archive leads out"),
        (["/0.png"], "leads out"),
        (["a//0.png"], "leads out"),
        (["./0.png"], "leads out"),
        (["c:0.png"], "leads out"),
        (["a\\0.png"], "leads out"),
        (["a/b/c/d/e/f.png"], "6 folders deep; at most 5"),
        (["ü.png"], "other signs"),
        (["-a.png"], "other signs"),
        (["n" * 101], "other signs"),
        (["a.png", "A.png"], "same name, but for capital"),
        (["a", "a/b.png"], "name of a folder"),
        ([".hidden"], "holds no files"),
        ([], "holds no files"),
    ],
)
def test_entries_of_refuses_unsafe_names(names: list[str], why: str) -> None:
    with pytest.raises(ArchiveInvalid, match=why):
        listed(packed(*((name, b"x") for name in names)))


def test_entries_of_enforces_limits_exactly() -> None:
    assert len(listed(packed(*((f"{each}.png", b"x") for each in range(3))))) == 3
    with pytest.raises(ArchiveInvalid, match="has 4 files; at most 3"):
        listed(packed(*((f"{each}.png", b"x") for each in range(4))))
    assert listed(packed(("a", bytes(60)), ("b", bytes(40)))) == ["a", "b"]
    with pytest.raises(ArchiveInvalid, match="holds 101 bytes; at most 100"):
        listed(packed(("a", bytes(60)), ("b", bytes(41))))
    with pytest.raises(ArchiveInvalid, match="lists 1 files and says that there are 2"):
        listed(packed(("a", b"x")), stated=2)


@pytest.mark.parametrize(("mib", "refused"), [(1, False), (2, True)])
def test_compression_ratio_is_limited_for_files_over_1_mib(
    mib: int, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    wide = 4 << 20
    file = packed(("a", bytes(mib << 20)), method=zipfile.ZIP_DEFLATED)
    if refused:
        with pytest.raises(ArchiveInvalid, match="over 10 times as many"):
            listed(file, wide)
        monkeypatch.setattr(check, "MOST_RATIO", 2000)
        assert listed(file, wide) == ["a"]
    else:
        assert listed(file, wide) == ["a"]


@pytest.mark.parametrize(
    ("mode", "refused"),
    [
        (0, False),
        (stat.S_IFREG | 0o644, False),
        (stat.S_IFLNK | 0o777, True),
        (stat.S_IFCHR, True),
        (stat.S_IFIFO, True),
    ],
)
def test_entries_of_refuses_links_and_devices(mode: int, refused: bool) -> None:
    info = zipfile.ZipInfo("a.png")
    info.external_attr = mode << 16
    if refused:
        with pytest.raises(ArchiveInvalid, match="a link or a device"):
            listed(packed((info, b"x")))
    else:
        assert listed(packed((info, b"x"))) == ["a.png"]


@pytest.mark.parametrize(("bits", "refused"), [(0x1, True), (0x40, True), (0x2000, True), (0x800, False), (0, False)])
def test_check_entry_refuses_encrypted_files(bits: int, refused: bool) -> None:
    info = zipfile.ZipInfo("a.png")
    info.flag_bits = bits
    if refused:
        with pytest.raises(ArchiveInvalid, match="encrypted"):
            check._check_entry(info, 0)
    else:
        check._check_entry(info, 0)


def test_entries_of_refuses_other_compression_methods() -> None:
    with pytest.raises(ArchiveInvalid, match="packed by method 12"):
        listed(packed(("a.png", b"x"), method=zipfile.ZIP_BZIP2))


@pytest.mark.parametrize(
    ("offset", "size", "why"),
    [(0, 1, None), (0, 5, "goes on into the list"), (1, 1, "not where its list says"), (30, 1, "not where its list")],
)
def test_check_places_refuses_wrong_header_offset_or_size(offset: int, size: int, why: str | None) -> None:
    file = packed(("a.png", b"x"))
    with zipfile.ZipFile(file) as archive:
        info, start = archive.infolist()[0], archive.start_dir
    info.header_offset, info.compress_size = offset, size
    if why is None:
        check._check_places([info], file, start)
    else:
        with pytest.raises(ArchiveInvalid, match=why):
            check._check_places([info], file, start)


def test_check_places_refuses_overlapping_files() -> None:
    file = packed(("a.png", b"x"), ("b.png", b"y"))
    with zipfile.ZipFile(file) as archive:
        infos, start = archive.infolist(), archive.start_dir
    check._check_places(infos[::-1], file, start)
    infos[1].header_offset = infos[0].header_offset
    with pytest.raises(ArchiveInvalid, match="in the same place"):
        check._check_places(infos, file, start)


def test_common_folder_is_removed_from_path_but_not_from_info() -> None:
    file = packed(("rec/images/0.png", b"x"))
    with zipfile.ZipFile(file) as archive:
        (entry,) = entries_of(archive, file, 1, MOST_BYTES)
    assert entry.path == PurePosixPath("images/0.png") and entry.info.filename == "rec/images/0.png"
