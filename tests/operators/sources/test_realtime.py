"""A recording played by the clock. The clock here is the test's own, so nothing depends on how fast this machine is."""

from __future__ import annotations

import math
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting, RecordingMissing
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.scene.frames import FrameStatus
from operators.sources import recording as recording_module
from operators.sources.address import SourceOptions
from operators.sources.recording import RealtimeSource, RecordingSource
from operators.sources.registry import open_source
from operators.sources.source import FrameSource, SourceState
from tests.gsplat_core.io.recordings import videos

SOON_S = 300.0


@pytest.fixture
def clock(monkeypatch):
    """Time in ns; `wait` moves it."""
    now = SimpleNamespace(ns=5_000_000_000)
    monkeypatch.setattr(recording_module, "time", SimpleNamespace(monotonic_ns=lambda: now.ns))

    def wait(self, seconds):
        now.ns += round(seconds * 1e9)
        return False

    monkeypatch.setattr(RealtimeSource, "wait", wait)
    return now


def released(source, clock, most=math.inf):
    """(seq, pts in ms, ms after the start at which it was released)."""
    start, found = clock.ns, []
    for frame in source.frames():
        found.append((frame.seq, frame.pts_ns / 1e6, (clock.ns - start) / 1e6))
        if len(found) >= most:
            break
    return found


def test_realtime_source_releases_each_frame_at_its_time(recording, clock):
    source = RealtimeSource(recording)
    assert isinstance(source, FrameSource)
    assert released(source, clock) == [(k, 40 * k, 40 * k) for k in range(5)]
    about = source.description
    assert (about.name, about.fps, about.frame_count, about.digest) == ("fake", 25, 5, None)


def test_realtime_loop_continues_numbers_and_times(recording, clock):
    source = RealtimeSource(recording, SourceOptions(loop=True))
    assert source.description.frame_count is None
    assert released(source, clock, 23) == [(k, 40 * k, 40 * k) for k in range(23)]
    assert recording.opened == 1, "later rounds come out of memory"


def test_realtime_loop_decodes_again_if_recording_exceeds_cache(recording, clock, monkeypatch):
    monkeypatch.setattr(recording_module, "REMEMBERED_BYTES", 2000)
    assert len(released(RealtimeSource(recording, SourceOptions(loop=True)), clock, 12)) == 12
    assert recording.opened >= 3


def test_realtime_source_keeps_uneven_times(recording, clock, frame):
    recording.frames[:] = [frame(k, pts_ns=pts * 10**6) for k, pts in enumerate((7, 47, 167))]
    source = RealtimeSource(recording, SourceOptions(loop=True))
    assert [pts for _, pts, _ in released(source, clock, 6)] == [0, 40, 160, 200, 240, 360]


def test_realtime_times_of_variable_frame_rate_equal_replay_times(tmp_path, clock):
    times_ms = [0, 33, 99, 132, 232, 265]
    path = videos.write_timed(tmp_path / "v.mkv", times_ms, 30, Fraction(1, 1000))
    replayed = [frame.pts_ns / 1e6 for frame in RecordingSource(open_recording(path)).frames()]
    played = released(RealtimeSource(open_recording(path)), clock)
    assert replayed == [pts_ms for _, pts_ms, _ in played] == pytest.approx(times_ms, abs=1e-6)
    assert [at_ms for _, _, at_ms in played] == pytest.approx(times_ms, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "pts_ms", "at_ms"),
    [
        (SourceOptions(speed=2), 40, 20),
        (SourceOptions(speed=0.5), 40, 80),
        (SourceOptions(fps=50), 20, 20),
        (SourceOptions(fps=50, speed=4), 20, 5),
        (SourceOptions(speed=math.inf), 40, 0),
    ],
)
def test_realtime_speed_changes_release_and_fps_changes_timestamps(recording, clock, options, pts_ms, at_ms):
    assert released(RealtimeSource(recording, options), clock) == [(k, pts_ms * k, at_ms * k) for k in range(5)]


def test_realtime_at_infinite_speed_drops_no_frame(recording):
    source = RealtimeSource(recording, SourceOptions(loop=True, speed=math.inf, max_frames=200, waiting=1))
    source.open()
    seqs = []
    while (frame := source.read(SOON_S)) is not None:
        seqs.append(frame.seq)
    assert seqs == list(range(200)) and source.counts() == {}
    assert source.state is SourceState.ENDED
    source.close()


def test_realtime_counts_late_frame_and_keeps_later_times(recording, clock, monkeypatch):
    source = RealtimeSource(recording)
    frames = iter(recording)

    def slow():
        for k, frame in enumerate(frames):
            clock.ns += 90_000_000 if k == 2 else 0
            yield frame

    monkeypatch.setattr(source, "_numbered", slow)
    monkeypatch.setattr(recording_module, "read_ahead", lambda items, *_: items)
    assert [at for _, _, at in released(source, clock)] == [0, 40, 130, 130, 160]
    assert source.counts() == {"decoded_late": 1}


def test_realtime_clock_starts_after_opening(recording, clock, monkeypatch):
    source = RealtimeSource(recording)
    numbered = source._numbered

    def slow_to_open():
        clock.ns += 30_000_000
        yield from numbered()

    monkeypatch.setattr(source, "_numbered", slow_to_open)
    assert [at_ms - 30 for _, _, at_ms in released(source, clock)] == [0, 40, 80, 120, 160]


def test_realtime_clock_restarts_after_system_suspend(recording, clock, monkeypatch):
    source = RealtimeSource(recording)
    frames = iter(recording)

    def suspended():
        for k, frame in enumerate(frames):
            clock.ns += 60_000_000_000 if k == 2 else 0
            yield frame

    monkeypatch.setattr(source, "_numbered", suspended)
    monkeypatch.setattr(recording_module, "read_ahead", lambda items, *_: items)
    assert [at for _, _, at in released(source, clock)] == [0, 40, 60_040, 60_080, 60_120]
    assert source.counts() == {"decoded_late": 1, "clock_restarts": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=4, width_px=64, height_px=48, stereo=True)


def test_realtime_option_plays_recording_with_sidecar_fields(folder):
    assert isinstance(open_source(folder), RecordingSource), "only where it is asked for"
    source = open_source(folder, SourceOptions(realtime=True, loop=True, speed=math.inf, scale=0.5))
    assert isinstance(source, RealtimeSource) and source.description.width_px == 32
    expected = list(open_recording(folder, scale=0.5))
    source.open()
    for k in range(9):
        frame, same = source.read(SOON_S), expected[k % 4]
        assert (frame.seq, frame.status) == (k, FrameStatus.LIVE) and frame.arrived_ns > 0
        for name in ("image", "right_image", "mask", "depth", "pose"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(same, name))
    source.close()


def test_realtime_address_options(folder):
    source = open_source(f"realtime:{folder}?loop=1&speed=2.5&fps=60")
    assert (source.options.loop, source.options.speed, source.options.fps) == (True, 2.5, 60)
    assert open_source(f"realtime://{folder}?speed=max").drops is False
    assert open_source(f"realtime:{folder}", SourceOptions(max_frames=3)).description.frame_count == 3


@pytest.mark.parametrize(
    ("query", "what"),
    [
        ("speed=0", "speed is '0'"),
        ("speed=nan", "speed is 'nan'"),
        ("speed=-1", "speed is '-1'"),
        ("fps=1e9", "fps is '1e9'"),
        ("loop=perhaps", "loop is 'perhaps'"),
        ("loops=1", "unknown option 'loops'; known are fps, loop, speed"),
        ("loop=1&loop=0", "'loop' occurs twice"),
    ],
)
def test_realtime_address_error_names_invalid_option(folder, query, what):
    with pytest.raises(InvalidSetting, match=what):
        open_source(f"realtime:{folder}?{query}")


def test_realtime_address_of_missing_recording_is_refused():
    with pytest.raises(RecordingMissing):
        open_source("realtime:/nowhere/at/all")


@pytest.mark.parametrize(
    "wrong", [{"speed": 0}, {"speed": math.nan}, {"fps": 0.0}, {"waiting": 0}, {"stereo": "both"}, {"speed": 10**6}]
)
def test_source_options_out_of_range_are_refused(wrong):
    with pytest.raises(InvalidSetting, match=next(iter(wrong))):
        SourceOptions(**wrong)
