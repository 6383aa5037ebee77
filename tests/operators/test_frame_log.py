"""The log of displayed frames: complete lines in any case, and a series of bounded length."""

from __future__ import annotations

import json
import os

import pytest

from gsplat_core.errors import InvalidInput
from operators.errors import StorageFull
from operators.frame_log import MAX_SERIES, FrameLog, frames_per_entry, read_frames, series
from operators.storage import StorageReserve


def entry(seq, db=30.0, trained=True, **more):
    return {
        "seq": seq,
        "time_s": seq / 25,
        "trained": trained,
        "model_version": seq + 1,
        "psnr_tissue_db": db,
        "psnr_frame_db": db,
        "ssim": 0.9,
        "previous_frame_db": db - 1 if db is not None else None,
        **more,
    }


def test_frame_log_entry_is_on_disk_after_write(tmp_path):
    log = FrameLog(tmp_path / "frames.jsonl")
    log.open()
    for seq in range(3):
        log.write(entry(seq))
        assert list(read_frames(log.path)) == [entry(k) for k in range(seq + 1)], "not closed, and yet there"
    log.close()
    log.close()
    assert [json.loads(line) for line in log.path.read_text().splitlines()] == [entry(k) for k in range(3)]


def test_read_frames_of_truncated_file_returns_complete_lines(tmp_path):
    log = FrameLog(tmp_path / "frames.jsonl")
    log.open()
    for seq in range(3):
        log.write(entry(seq))
    log.close()
    whole = log.path.read_bytes()
    ends = [k + 1 for k, byte in enumerate(whole) if byte == ord("\n")]
    for length in range(len(whole) + 1):
        log.path.write_bytes(whole[:length])
        assert len(list(read_frames(log.path))) == sum(end <= length for end in ends)


def test_frame_log_open_truncates_and_replaces_symlink(tmp_path):
    other = tmp_path / "precious.txt"
    other.write_text("mine")
    (tmp_path / "frames.jsonl").symlink_to(other)
    log = FrameLog(tmp_path / "frames.jsonl")
    log.open()
    log.write(entry(0))
    log.open()
    log.write(entry(1))
    log.close()
    assert other.read_text() == "mine" and not log.path.is_symlink()
    assert [each["seq"] for each in read_frames(log.path)] == [1]


def test_frame_log_missing_file_is_empty_and_write_requires_open(tmp_path):
    assert list(read_frames(tmp_path / "frames.jsonl")) == []
    with pytest.raises(InvalidInput, match="is not open"):
        FrameLog(tmp_path / "frames.jsonl").write(entry(0))


def test_frame_log_write_on_full_disk_raises_storage_full(tmp_path):
    log = FrameLog(tmp_path / "frames.jsonl", StorageReserve(tmp_path, lambda: 1 << 60))
    log.open()
    with pytest.raises(StorageFull, match="free some space"):
        log.write(entry(0))
    log.close()
    assert os.path.getsize(log.path) == 0


@pytest.mark.parametrize(
    ("frames", "most", "expected"), [(0, 10, 1), (1, 10, 1), (10, 10, 1), (11, 10, 2), (20, 10, 2), (21, 10, 3)]
)
def test_frames_per_entry_is_smallest_that_meets_limit(frames, most, expected):
    assert frames_per_entry(frames, most) == expected


def test_series_of_one_frame_per_entry_is_unchanged():
    entries = [entry(k) for k in range(5)]
    assert list(series(iter(entries), 1)) == entries


def test_series_entries_have_mean_and_worst_score():
    first, last = list(series([entry(3, 30.0), entry(7, 20.0), entry(8, None), entry(9, 36.0)], 3))
    assert first == entry(3, 25.0, frames=3, psnr_tissue_min_db=20.0), "a frame without tissue is left out of the means"
    assert last == entry(9, 36.0, frames=1, psnr_tissue_min_db=36.0)
    (nothing,) = series([entry(0, None), entry(1, None)], 2)
    assert nothing["psnr_tissue_db"] is None and nothing["psnr_tissue_min_db"] is None


def test_series_separates_heldout_and_trained_frames():
    mixed = [entry(0, 30.0), entry(1, 10.0, trained=False), entry(2, 40.0), entry(3, 20.0)]
    binned = list(series(mixed, 3))
    assert [(each["seq"], each["trained"], each["frames"], each["psnr_tissue_db"]) for each in binned] == [
        (0, True, 2, 35.0),
        (1, False, 1, 10.0),
        (3, True, 1, 20.0),
    ]


def test_series_contains_every_frame_once():
    entries = [entry(k, 20.0 + k % 7, trained=k % 8 != 1) for k in range(1000)]
    binned = list(series(entries, frames_per_entry(1000, 100)))
    assert len(binned) <= 2 * 100
    assert sum(each["frames"] for each in binned) == 1000
    for trained in (True, False):
        total = sum(each["frames"] * each["psnr_tissue_db"] for each in binned if each["trained"] is trained)
        assert total == pytest.approx(sum(each["psnr_tissue_db"] for each in entries if each["trained"] is trained))


@pytest.mark.parametrize(("frames", "per_entry"), [(0, 1), (1, 1), (4096, 1), (4097, 2), (8192, 2), (8193, 3)])
def test_series_has_at_most_4096_entries_per_kind(frames, per_entry):
    assert MAX_SERIES == 4096 and frames_per_entry(frames, MAX_SERIES) == per_entry
