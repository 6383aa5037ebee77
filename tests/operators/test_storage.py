"""A full disk is said in words, and files are whole or not there."""

from __future__ import annotations

import errno

import pytest

from operators.errors import StorageFull
from operators.storage import StorageReserve, storage_errors, write_whole


def test_the_reserve_is_asked_for_anew_each_time(tmp_path):
    needed = 0
    reserve = StorageReserve(tmp_path, lambda: needed)
    reserve.require(100)
    needed = 1 << 60
    with pytest.raises(StorageFull, match=r"MiB are free and 1099511627776\.0 MiB are needed"):
        reserve.require(0)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_no_space_becomes_a_sentence(tmp_path, number):
    with pytest.raises(StorageFull, match="choose another --out"), storage_errors(tmp_path):
        raise OSError(number, "No space left on device")


def test_other_errors_stay_what_they_are(tmp_path):
    with pytest.raises(PermissionError), storage_errors(tmp_path):
        raise PermissionError(errno.EACCES, "no")


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
