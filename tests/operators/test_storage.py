"""A full disk is said in words, and files are whole or not there."""

from __future__ import annotations

import errno
import os
import shutil
from types import SimpleNamespace

import pytest

from operators.errors import OutputError, StorageFull
from operators.storage import StorageReserve, mebibytes, shown, storage_errors, write_whole


def test_the_reserve_is_asked_for_anew_each_time(tmp_path):
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
def test_what_the_system_says_becomes_a_sentence(tmp_path, number, kind, match):
    with pytest.raises(kind, match=match) as caught, storage_errors(tmp_path):
        raise OSError(number, os.strerror(number))
    assert type(caught.value) is kind and str(tmp_path) in str(caught.value)


def test_a_folder_that_is_gone_is_named(tmp_path):
    with pytest.raises(OutputError, match="gone is not there; it must exist, and stay"):
        write_whole(tmp_path / "gone" / "report.json", b"x")
    with pytest.raises(OutputError, match="gone is not there"):
        StorageReserve(tmp_path / "gone", lambda: 0).require()


def test_the_user_reads_the_name_of_their_own_folder(tmp_path):
    with pytest.raises(StorageFull) as caught, storage_errors(tmp_path / ".run-0123"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert ".run-" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_a_write_that_fails_leaves_the_earlier_file(tmp_path, monkeypatch):
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
def test_bytes_are_told_in_mebibytes_and_from_one_gibibyte_on_in_gibibytes(count, text):
    assert mebibytes(count) == text


def test_a_folder_of_a_run_under_way_has_the_name_of_the_output_folder(tmp_path):
    assert shown(tmp_path / ".run-1234") == tmp_path
    assert shown(tmp_path / "run-1234") == tmp_path / "run-1234"


def test_a_reserve_is_kept_to_the_byte(tmp_path, monkeypatch):
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
def test_errors_of_the_system_become_sentences(tmp_path, number, kind, said):
    with pytest.raises(kind, match=said) as raised, storage_errors(tmp_path):
        raise OSError(number, os.strerror(number))
    assert type(raised.value) is kind and str(tmp_path) in str(raised.value)


@pytest.mark.parametrize(("number", "gone"), [(errno.ENOENT, True), (errno.ENOTDIR, True), (errno.EACCES, False)])
def test_a_folder_that_is_gone_is_told_from_one_that_is_closed(tmp_path, number, gone):
    said = "is not there" if gone else "check the path"
    with pytest.raises(OutputError, match=said) as raised, storage_errors(tmp_path / "gone"):
        raise OSError(number, "said by the system")
    assert isinstance(raised.value.__cause__, OSError)


def test_an_error_without_a_number_is_told_in_its_own_words(tmp_path):
    with pytest.raises(OutputError, match="something odd"), storage_errors(tmp_path):
        raise OSError("something odd")
