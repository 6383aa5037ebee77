"""A full disk is reported in a sentence, and files are complete or absent."""

from __future__ import annotations

import errno
import os
import shutil
from types import SimpleNamespace

import pytest

from operators.errors import OutputError, StorageFull
from operators.storage import StorageReserve, mebibytes, shown, storage_errors, write_whole


def test_storage_reserve_evaluates_size_at_each_check(tmp_path):
    needed = 0
    reserve = StorageReserve(tmp_path, lambda: needed)
    reserve.require(100)
    needed = 1 << 60
    with pytest.raises(StorageFull, match=r"are free and 1073741824\.0 GiB are needed"):
        reserve.require(0)


@pytest.mark.parametrize(
    ("number", "kind", "match"),
    [
        (errno.ENOSPC, StorageFull, "is full .*choose another --out"),
        (errno.EDQUOT, StorageFull, "is full .*choose another --out"),
        (errno.EFBIG, StorageFull, "raise `ulimit -f`"),
        (errno.EACCES, OutputError, "check the path, its permissions"),
        (errno.EROFS, OutputError, "check the path, its permissions"),
        (errno.EIO, OutputError, "check the path, its permissions and its disk"),
    ],
)
def test_storage_errors_map_errno_to_error_and_advice(tmp_path, number, kind, match):
    with pytest.raises(kind, match=match) as caught, storage_errors(tmp_path):
        raise OSError(number, os.strerror(number))
    assert type(caught.value) is kind and str(tmp_path) in str(caught.value)


def test_missing_folder_error_names_folder(tmp_path):
    with pytest.raises(OutputError, match="gone is not there; it must exist, and stay"):
        write_whole(tmp_path / "gone" / "report.json", b"x")
    with pytest.raises(OutputError, match="gone is not there"):
        StorageReserve(tmp_path / "gone", lambda: 0).require()


def test_storage_error_names_output_folder_not_run_folder(tmp_path):
    with pytest.raises(StorageFull) as caught, storage_errors(tmp_path / ".run-0123"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert ".run-" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_write_whole_failure_keeps_earlier_file(tmp_path, monkeypatch):
    path = tmp_path / "report.json"
    write_whole(path, b"earlier")

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(StorageFull):
        write_whole(path, b"later")
    assert path.read_bytes() == b"earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0.0 MiB"), (3 * 2**19, "1.5 MiB"), (2**30 - 1, "1024.0 MiB"), (2**30, "1.0 GiB"), (5 * 2**29, "2.5 GiB")],
)
def test_mebibytes_text_uses_gib_from_one_gibibyte(count, text):
    assert mebibytes(count) == text


def test_shown_replaces_run_folder_by_output_folder(tmp_path):
    assert shown(tmp_path / ".run-1234") == tmp_path
    assert shown(tmp_path / "run-1234") == tmp_path / "run-1234"


def test_storage_reserve_limit_is_exact_to_the_byte(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=30 * 2**20))
    reserve = StorageReserve(tmp_path, lambda: 20 * 2**20)
    reserve.require()
    reserve.require(10 * 2**20)
    with pytest.raises(StorageFull, match=r"30.0 MiB are free and 30.0 MiB are needed"):
        reserve.require(10 * 2**20 + 1)
    with pytest.raises(StorageFull, match=r"31\.0 MiB are needed"):
        write_whole(tmp_path / "file", bytes(11 * 2**20), reserve)
    assert not list(tmp_path.iterdir())
    write_whole(tmp_path / "file", b"whole", reserve)
    assert (tmp_path / "file").read_bytes() == b"whole"


@pytest.mark.parametrize(
    ("number", "kind", "said"),
    [
        (errno.ENOSPC, StorageFull, "the disk of .* is full"),
        (errno.EDQUOT, StorageFull, "the disk of .* is full"),
        (errno.EFBIG, StorageFull, "raise `ulimit -f`"),
        (errno.ENOENT, OutputError, "cannot write to .*No such file"),
        (errno.EACCES, OutputError, r"cannot write to .*\(Permission denied\)"),
    ],
)
def test_storage_errors_message_by_errno(tmp_path, number, kind, said):
    with pytest.raises(kind, match=said) as raised, storage_errors(tmp_path):
        raise OSError(number, os.strerror(number))
    assert type(raised.value) is kind and str(tmp_path) in str(raised.value)


@pytest.mark.parametrize(("number", "gone"), [(errno.ENOENT, True), (errno.ENOTDIR, True), (errno.EACCES, False)])
def test_storage_errors_distinguish_missing_and_inaccessible_folder(tmp_path, number, gone):
    said = "is not there" if gone else "check the path"
    with pytest.raises(OutputError, match=said) as raised, storage_errors(tmp_path / "gone"):
        raise OSError(number, "said by the system")
    assert isinstance(raised.value.__cause__, OSError)


def test_storage_error_without_errno_keeps_message(tmp_path):
    with pytest.raises(OutputError, match="something odd"), storage_errors(tmp_path):
        raise OSError("something odd")
