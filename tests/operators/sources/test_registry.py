"""Resolution of an address to its source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting, RecordingMissing
from gsplat_core.io.recordings import open_recording, synthesize
from operators.applications.session import FirstFrames
from operators.sources import registry
from operators.sources.recording import RecordingSource
from operators.sources.registry import SOURCES, SourceOptions, open_source


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=4, width_px=64, height_px=48, stereo=False)


def test_open_source_of_path_reads_recording_frames(folder):
    source = open_source(folder, SourceOptions(scale=0.5, max_frames=3))
    recording = open_recording(folder, scale=0.5, max_frames=3)
    assert isinstance(source, RecordingSource)
    described = source.description
    assert (described.name, described.frame_count, described.fps) == (folder.name, 3, recording.fps)
    assert (described.width_px, described.height_px) == (32, 24) == (described.camera.width_px, 24)
    assert described.fields == recording.fields and described.digest == recording.digest
    for _ in range(2):  # it can be read again
        for played, expected in zip(FirstFrames(source, 9), recording, strict=True):
            assert (played.seq, played.pts_ns) == (expected.seq, expected.pts_ns)
            np.testing.assert_array_equal(played.image, expected.image)
            np.testing.assert_array_equal(played.mask, expected.mask)
            np.testing.assert_array_equal(played.depth, expected.depth)


def test_first_frames_returns_at_most_requested_count(folder):
    source = open_source(folder)
    assert [frame.seq for frame in FirstFrames(source, 2)] == [0, 1]
    assert list(FirstFrames(source, 0)) == []


@pytest.mark.parametrize("address", ["tape://studio/7?take=2", Path("tape://studio/7?take=2")])
def test_open_source_selects_parser_by_scheme(monkeypatch, address):
    asked = []
    SOURCES.add("tape", lambda rest, options: asked.append((rest, options)))
    try:
        open_source(address, SourceOptions(0.5, 7))
    finally:
        SOURCES.remove("tape")
    assert asked == [("studio/7?take=2", SourceOptions(0.5, 7))]


def test_open_source_accepts_recording_scheme(folder):
    assert open_source(f"recording://{folder}").description.name == folder.name


def test_open_source_refuses_unknown_scheme():
    with pytest.raises(InvalidSetting, match="unknown source 'tapes'; known are recording, realtime"):
        open_source("tapes://studio/1")


def test_open_source_prefers_existing_path_over_scheme(folder, tmp_path, monkeypatch):
    (tmp_path / "tape:").mkdir()
    (tmp_path / "tape:" / "take").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    assert open_source("tape://take").description.frame_count == 4


@pytest.mark.parametrize("address", ["nowhere", "/nowhere/at/all", "C:/recordings", "a:b", ""])
def test_open_source_of_missing_path_raises_recording_missing(address, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecordingMissing):
        open_source(address or tmp_path / "empty")


@pytest.mark.parametrize(
    "address",
    ["", " ", "\t\n", "recording:", "realtime:", "folder:", "v4l2:", "zmq+ipc://", "pipe:", "folder:?pattern=x"],
)
def test_open_source_refuses_empty_address(address, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidSetting, match="is empty"):
        open_source(address, SourceOptions(process=True, realtime=True))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0, -1.0, 1e9])
def test_source_options_refuse_invalid_fps(value):
    with pytest.raises(InvalidSetting, match="fps is"):
        SourceOptions(fps=value)


@pytest.mark.parametrize(
    ("address", "rest"),
    [
        ("rtsp://h/s?stereo=side_by_side", "rtsp://h/s"),
        ("rtsp://h/s?stereo=side_by_side&a=b", "rtsp://h/s?a=b"),
        ("rtsp://h/s?a=b&stereo=side_by_side#stall_s=7", "rtsp://h/s?a=b#stall_s=7"),
        ("rtsp://h/s#stereo=side_by_side", "rtsp://h/s"),
        ("rtsp://h/s#stereo=side_by_side&stall_s=7&transport=udp", "rtsp://h/s#stall_s=7&transport=udp"),
        ("rtsp://h/s#stall_s=7&stereo=side_by_side&transport=udp", "rtsp://h/s#stall_s=7&transport=udp"),
    ],
)
def test_stereo_option_is_removed_from_address_alone(address, rest):
    assert registry._stereo_of(address, SourceOptions()) == (rest, "side_by_side")
