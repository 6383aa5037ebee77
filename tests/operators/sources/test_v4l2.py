"""Cameras of this machine: with a device where there is one, and with a stand-in below FFmpeg's device layer everywhere."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import FrameStatus
from operators.errors import SourceUnavailable
from operators.sources import url
from operators.sources.process import ProcessSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceState

HERE = SourceOptions(process=False, waiting=64)
REAL_OPEN = av.open


def test_v4l2_device_delivers_frames(reading):
    devices = sorted(Path("/dev").glob("video*"))
    if not devices:
        pytest.skip("there is no /dev/video* here: neither a camera nor the v4l2loopback module of the kernel")
    try:
        source = open_source(f"v4l2:{devices[0]}")
    except SourceUnavailable as error:
        pytest.skip(f"{devices[0]} gives no pictures here: {error}")
    assert isinstance(source, ProcessSource)
    stream = reading(source)
    frames = [stream.frame() for _ in range(3)]
    assert frames[0].image.shape == (source.description.height_px, source.description.width_px, 3)


class Driver:
    """Takes FFmpeg's place at the device: what is asked of `v4l2` is answered by its test pictures, uncompressed as a camera's."""

    def __init__(self, monkeypatch):
        self.asked, self.unplugged, self.frames = [], False, 10_000
        monkeypatch.setattr(av, "open", self.open)
        monkeypatch.setattr(os, "stat", self.stat)
        self._stat = STAT

    def open(self, path, **given):
        if given.get("format") != "v4l2":
            return REAL_OPEN(path, **given)
        self.asked.append((path, given["options"]))
        if self.unplugged:
            raise av.error.OSError(19, "No such device", path)
        size = given["options"].get("video_size", "320x240")
        rate = given["options"].get("framerate", "25")
        pixels = given["options"].get("input_format", "yuyv422")
        graph = f"testsrc2=size={size}:rate={rate},format={pixels},trim=end_frame={self.frames}"
        return REAL_OPEN(graph, **{**given, "format": "lavfi", "options": {}})

    def stat(self, path, **more):
        if str(path).startswith("/dev/video"):
            if path != "/dev/video0":
                raise FileNotFoundError(2, "No such file or directory", path)
            return SimpleNamespace(st_mode=stat.S_IFCHR)
        return self._stat(path, **more)


STAT = os.stat


@pytest.fixture
def driver(monkeypatch):
    return Driver(monkeypatch)


def test_v4l2_options_reach_driver_and_frames_have_even_times(driver, reading):
    source = open_source("v4l2:/dev/video0?size=640x480&fps=50&format=uyvy422", HERE)
    assert driver.asked == [("/dev/video0", {"video_size": "640x480", "framerate": "50", "input_format": "uyvy422"})]
    about = source.description
    assert (about.name, about.width_px, about.height_px, about.fps) == ("camera /dev/video0", 640, 480, 50)
    stream = reading(source)
    frames = [stream.frame() for _ in range(5)]
    assert all(frame.image.shape == (480, 640, 3) and frame.status is FrameStatus.LIVE for frame in frames)
    steps = np.diff([frame.pts_ns for frame in frames]) / np.diff([frame.seq for frame in frames])
    assert frames[0].pts_ns >= 0 and (steps == 20_000_000).all()


def test_v4l2_without_options_uses_driver_defaults(driver, reading):
    reading(open_source("v4l2:/dev/video0", HERE)).frame()
    assert driver.asked == [("/dev/video0", {})]


def test_v4l2_source_reconnects_after_unplugging(driver, reading):
    driver.frames = 3
    source = open_source("v4l2:/dev/video0", HERE)
    driver.unplugged = True
    stream = reading(source)
    last = [stream.frame() for _ in range(3)][-1]
    stream.until(lambda: source.state is SourceState.RECONNECTING and "No such device" in source.state_sentence)
    driver.unplugged = False
    frame = stream.frame()
    assert frame.seq == last.seq + 1 and frame.pts_ns > last.pts_ns


@pytest.mark.parametrize(
    "path", ["/dev/null", "/dev/../etc/passwd", "/etc/passwd", "video0", "", "/dev/video", "/dev/video0\0x"]
)
def test_v4l2_refuses_path_that_is_not_a_video_device(driver, path):
    with pytest.raises(InvalidSetting, match="is no camera" if path else "the path is empty"):
        open_source(f"v4l2:{path}", HERE)
    assert driver.asked == []


def test_v4l2_missing_camera_raises_source_unavailable(driver):
    with pytest.raises(SourceUnavailable, match=r"there is no camera /dev/video7 \(No such file or directory\)"):
        open_source("v4l2:/dev/video7", HERE)
    driver.unplugged = True
    with pytest.raises(SourceUnavailable, match="camera /dev/video0 cannot be opened: No such device"):
        open_source("v4l2:/dev/video0", HERE)


def test_v4l2_refuses_regular_file(monkeypatch):
    monkeypatch.setattr(url.os, "stat", lambda path: SimpleNamespace(st_mode=stat.S_IFREG))
    with pytest.raises(SourceUnavailable, match="it is no device"):
        url.device_of("/dev/video0")


@pytest.mark.parametrize(
    ("query", "what"),
    [("size=big", "size is 'big'"), ("format=png", "format is 'png'"), ("rate=3", "unknown option 'rate'")],
)
def test_v4l2_address_error_names_invalid_option(query, what):
    with pytest.raises(InvalidSetting, match=what):
        open_source(f"v4l2:/dev/video0?{query}", HERE)
