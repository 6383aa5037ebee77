"""A full disk is said in words, and files are whole or not there."""

from __future__ import annotations

import errno
import os

import pytest

from operators.errors import OutputError, StorageFull
from operators.storage import StorageReserve, storage_errors, write_whole


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
