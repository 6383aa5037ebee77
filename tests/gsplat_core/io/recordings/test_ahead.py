"""Reading ahead: order, bound, errors and the end of the thread."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.contents import read_ahead
from gsplat_core.io.recordings.plain_files import quiet_decoder

NAME = "read ahead in a test"


def reading_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith(("read ahead", "read what lies"))]


def test_read_ahead_yields_items_in_order_and_ends_thread():
    assert list(read_ahead((number for number in range(100)), NAME)) == list(range(100))
    assert not reading_threads()


def test_read_ahead_of_empty_iterator():
    assert list(read_ahead((number for number in ()), NAME)) == []


def test_read_ahead_limits_items_in_advance():
    third, made = threading.Event(), []

    def items():
        for number in range(10):
            made.append(number)
            if len(made) == 3:
                third.set()
            yield number

    reader = read_ahead(items(), NAME, ahead=2)
    assert next(reader) == 0
    assert third.wait(300)
    assert not threading.Event().wait(0.05)
    assert made == [0, 1, 2]
    reader.close()


def test_read_ahead_raises_error_after_earlier_items():
    def items():
        yield 1
        yield 2
        raise ValueError("the third is broken")

    reader = read_ahead(items(), NAME)
    assert [next(reader), next(reader)] == [1, 2]
    with pytest.raises(ValueError, match="the third is broken"):
        next(reader)
    assert not reading_threads()


def test_read_ahead_close_ends_thread_and_closes_iterator():
    closed_in: list[str] = []

    def items():
        try:
            while True:
                yield 0
        finally:
            closed_in.append(threading.current_thread().name)

    reader = read_ahead(items(), NAME)
    next(reader)
    reader.close()
    assert closed_in == [NAME]
    assert not reading_threads()


def test_recording_raises_broken_mask_after_earlier_frames_and_ends_thread(endonerf_folder):
    masks = sorted((endonerf_folder / "masks").iterdir())
    recording = open_recording(endonerf_folder)
    masks[4].write_bytes(b"no picture")
    seen = []
    with pytest.raises(RecordingInvalid, match=masks[4].name):
        for frame in recording:
            seen.append(frame.seq)
    assert seen == [0, 1, 2, 3]
    assert not reading_threads()


def test_closing_recording_iterator_early_ends_thread(endonerf_folder):
    frames = iter(open_recording(endonerf_folder))
    assert np.all(next(frames).mask <= 1)
    frames.close()
    assert not reading_threads()


def test_quiet_decoder_restores_opencv_log_level_after_last_thread():
    before = cv2.utils.logging.getLogLevel()
    first, second = quiet_decoder(), quiet_decoder()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_SILENT
    second.__exit__(None, None, None)
    assert cv2.utils.logging.getLogLevel() == before
