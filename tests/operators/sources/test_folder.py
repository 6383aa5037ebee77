"""Images that appear one by one, whole or half written."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import FrameStatus
from operators.errors import SourceUnavailable
from operators.sources import folder as folder_module
from operators.sources.folder import NewFiles, following_name
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceState

ALL = SourceOptions(waiting=64)


def encoded(value, suffix=".png", height=40, width=60):
    rng = np.random.default_rng(value)
    pixels = (rng.integers(0, 20, (height, width, 3)) + value).astype(np.uint8)
    return cv2.imencode(suffix, pixels)[1].tobytes()


def value_of(frame):
    return round(float(frame.image.mean()) - 9.5)


@pytest.fixture
def images(tmp_path):
    (tmp_path / "images").mkdir()
    return tmp_path / "images"


def write(images, index, value, suffix=".png"):
    (images / f"frame-{index:06d}{suffix}").write_bytes(encoded(value, suffix))


def test_folder_source_reads_images_as_they_appear(images, reading):
    write(images, 3, 30)
    write(images, 4, 40)
    source = open_source(f"folder:{images}?fps=20", ALL)
    assert (source.description.width_px, source.description.height_px, source.description.fps) == (60, 40, 20)
    stream = reading(source)
    assert value_of(stream.frame()) == 40, "what is there already is passed over but for the newest"
    for index in range(5, 9):
        write(images, index, 10 * index)
        frame = stream.frame()
        assert value_of(frame) == 10 * index and frame.seq == index - 4 and frame.status is FrameStatus.LIVE
    assert frame.pts_ns >= 4 * 50_000_000 and source.counts() == {}


def test_folder_source_with_every_reads_existing_images(images, reading):
    for index in (1, 2, 10):
        write(images, index, index)
    stream = reading(open_source(f"folder:{images}?every=1", ALL))
    assert [value_of(stream.frame()) for _ in range(3)] == [1, 2, 10]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_folder_source_waits_for_partially_written_image(images, reading, suffix):
    write(images, 0, 50, suffix)
    stream = reading(open_source(f"folder:{images}", ALL))
    stream.frame()
    data = encoded(90, suffix)
    with open(images / f"frame-000001{suffix}", "wb", buffering=0) as file:
        for begin in range(0, len(data), len(data) // 4):
            file.write(data[begin : begin + len(data) // 4])
            if begin + len(data) // 4 < len(data):
                assert stream.source.read(0.1) is None
    assert abs(value_of(stream.frame()) - 90) <= 1 and stream.source.counts() == {}


def test_folder_source_reads_file_after_rename_to_final_name(images, reading):
    write(images, 0, 50)
    stream = reading(open_source(f"folder:{images}", ALL))
    stream.frame()
    (images / ".frame-000001.png").write_bytes(encoded(60))
    (images / "frame-000001.png.part").write_bytes(encoded(60))
    assert stream.source.read(0.1) is None
    os.rename(images / ".frame-000001.png", images / "frame-000001.png")
    assert value_of(stream.frame()) == 60


def test_folder_source_skips_and_counts_unreadable_files(images, reading, monkeypatch, tmp_path):
    monkeypatch.setattr(folder_module, "UNREADABLE_AFTER_S", 0.1)
    write(images, 0, 50)
    stream = reading(open_source(f"folder:{images}", ALL))
    stream.frame()
    (images / "frame-000001.png").write_bytes(encoded(60)[:-20])
    (images / "frame-000002.png").write_bytes(b"nonsense")
    (tmp_path / "elsewhere.png").write_bytes(encoded(60))
    (images / "frame-000003.png").symlink_to(tmp_path / "elsewhere.png")
    os.mkfifo(images / "frame-000004.png")
    (images / "frame-000005.png").mkdir()
    (images / "notes.txt").write_text("x")
    write(images, 6, 70)
    assert value_of(stream.frame()) == 70 and stream.source.counts()["unreadable"] == 5


def test_folder_source_skips_and_counts_out_of_order_image(images, reading):
    write(images, 5, 50)
    stream = reading(open_source(f"folder:{images}", ALL))
    stream.frame()
    write(images, 2, 20)
    stream.until(lambda: stream.source.counts() == {"out_of_order": 1})
    write(images, 6, 60)
    assert value_of(stream.frame()) == 60


def test_folder_source_passes_other_size_and_ignores_removed_images(images, reading):
    write(images, 0, 50)
    stream = reading(open_source(f"folder:{images}", ALL))
    stream.frame()
    (images / "frame-000000.png").unlink()
    (images / "frame-000001.png").write_bytes(encoded(60, height=8, width=90))
    assert stream.frame().image.shape == (8, 90, 3)


def test_folder_source_reconnects_after_folder_is_recreated(images, reading):
    write(images, 0, 50)
    stream = reading(open_source(f"folder:{images}", ALL))
    stream.frame()
    shutil.rmtree(images)
    stream.until(lambda: stream.source.state is SourceState.RECONNECTING)
    assert "cannot be read" in stream.source.state_sentence
    images.mkdir()
    time.sleep(0.05)
    write(images, 1, 60)
    assert value_of(stream.frame()) == 60 and stream.source.state is SourceState.LIVE


def test_folder_source_reopened_starts_at_newest_image(images, reading):
    write(images, 0, 50)
    source = open_source(f"folder:{images}", ALL)
    assert value_of(reading(source).frame()) == 50
    source.close()
    write(images, 1, 60)
    write(images, 2, 70)
    assert value_of(reading(source).frame()) == 70


def test_folder_source_refuses_missing_or_empty_folder(images, tmp_path):
    with pytest.raises(SourceUnavailable, match="is no folder"):
        open_source(f"folder:{tmp_path}/nothing")
    with pytest.raises(SourceUnavailable, match=r"no whole image came into .*/images within 0\.1 s"):
        open_source(f"folder:{images}?open_s=0.1")
    with pytest.raises(InvalidSetting, match="the path is empty"):
        open_source("folder:")


def test_new_files_predicts_next_name_without_scanning_folder(images, monkeypatch):
    for index in range(50):
        (images / f"{index}.png").touch()
    files = NewFiles(images)
    files.skip_to_newest()
    scans = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: scans.append(path) or scandir(path))
    assert files.next() == images / "49.png"
    files.taken()
    for index in range(50, 60):
        (images / f"{index}.png").touch()
        assert files.next() == images / f"{index}.png", "the next number is known without looking through all"
        files.taken()
    assert scans == []


def test_following_name_increments_number():
    assert following_name(Path("a/frame-000041.color.png")) == Path("a/frame-000042.color.png")
    assert following_name(Path("x9.jpg")) == Path("x10.jpg") and following_name(Path("left.png")) is None
