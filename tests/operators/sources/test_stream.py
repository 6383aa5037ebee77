"""Streams of external senders: sizes of frames, times that no sender states, waiting times between attempts."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.plain_files import MAX_PIXELS
from gsplat_core.scene.frames import Frame
from operators.sources.address import SourceOptions
from operators.sources.live import Backoff, SteadyClock, StreamSource, check_size, resized


def test_check_size_at_limits():
    check_size("cam", 1, 1)
    check_size("cam", MAX_PIXELS, 1)
    check_size("cam", 8, 9, least=8)
    for width, height, least in ((0, 5, 1), (5, 0, 1), (MAX_PIXELS + 1, 1, 1), (7, 9, 8), (9, 7, 8)):
        with pytest.raises(InvalidSetting, match=f"cam: frames of {width}x{height} px cannot be used"):
            check_size("cam", width, height, least)


@pytest.mark.parametrize(("scale", "size"), [(1, (4, 6)), (0.5, (2, 3)), (1.5, (6, 9)), (0.01, (1, 1))])
def test_resized_scales_frame_by_factor(scale, size):
    frame = Frame(0, 0, np.full((4, 6, 3), 9, np.uint8))
    found = resized(frame, scale)
    assert found.image.shape == (*size, 3) and (found.image == 9).all()
    assert (found is frame) is (scale == 1)


@pytest.mark.parametrize(("fps", "rate", "notes"), [(None, 30.0, 2), (12.5, 12.5, 1)])
def test_stream_source_notes_assumed_frame_rate(fps, rate, notes):
    source = StreamSource(SourceOptions(max_frames=5))
    source.describe("cam", (64, 48), fps)
    about = source.description
    assert (about.fps, about.width_px, about.height_px, about.frame_count) == (rate, 64, 48, 5) and len(
        about.notes
    ) == notes


def test_scaled_stream_source_refuses_sides_below_eight_pixels():
    StreamSource(SourceOptions()).describe("cam", (3, 3), 30)
    StreamSource(SourceOptions(scale=0.5)).describe("cam", (16, 16), 30)
    with pytest.raises(InvalidSetting, match="7x7 px cannot be used; both sides must be at least 8 px"):
        StreamSource(SourceOptions(scale=0.5)).describe("cam", (14, 14), 30)


S = 1_000_000_000


@pytest.mark.parametrize(
    ("arrived_ns", "time_ns"),
    [
        (0, 100_000_000),  # faster than the rate: the rate counts
        (100_000_000, 100_000_000),
        (120_000_000, 101_000_000),  # a twentieth of 20 ms behind
        (1_100_000_000, 150_000_000),  # 1 s behind is still made good bit by bit
        (1_100_000_001, 1_100_000_001),  # more is a pause
    ],
)
def test_steady_clock_catches_up_gradually(arrived_ns, time_ns):
    clock = SteadyClock(10)
    assert clock.time_ns(5 * S) == 0
    assert clock.time_ns(5 * S + arrived_ns) == time_ns
    assert clock.time_ns(5 * S) == time_ns + 100_000_000


def test_backoff_doubles_up_to_limit_and_resets_on_success():
    backoff = Backoff()
    assert [backoff.failed() for _ in range(6)] == [0.25, 0.5, 1.0, 2.0, 2.0, 2.0]
    assert backoff.failures == 6
    backoff.worked()
    assert backoff.failures == 0 and backoff.failed() == 0.25


def test_backoff_does_not_overflow_after_thousands_of_failures():
    backoff = Backoff(1e-9, 1e30)
    waits = [backoff.failed() for _ in range(5000)]
    assert waits[:3] == [1e-9, 2e-9, 4e-9] and waits[30] == waits[-1] == 1e-9 * 2**30
