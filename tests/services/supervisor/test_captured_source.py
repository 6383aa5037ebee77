from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.errors import SourceUnavailable
from operators.sources.source import SourceDescription, SourceState
from services.bus.messages import CommandServer, Heartbeats, PicturePublisher
from services.supervisor.capture import CapturedSource

SOON_S = 300.0
ABOUT = SourceDescription("made up", 6, 4, 25.0, Camera.from_focal(5.0, 6, 4), fields=frozenset({"depth", "mask"}))


class StandIn:
    """Stand-in for a capture process."""

    def __init__(self, folder, run: int) -> None:
        self.run, self.said = run, {"state": "live", "reason": "well"}
        self.publisher = PicturePublisher(folder.pictures("capture"))
        self.heartbeats = Heartbeats(folder.status("capture"), lambda: dict(self.said))
        self.commands = CommandServer(
            folder.commands("capture"), {"describe": lambda _: {"description": ABOUT.as_json()}}
        )

    def send(self, seq: int, **changes) -> None:
        frame = Frame(
            seq, seq * 40_000_000, np.full((4, 6, 3), seq, np.uint8), arrived_ns=time.monotonic_ns(), **changes
        )
        self.publisher.publish_frame({"run": self.run}, frame)

    def close(self) -> None:
        self.publisher.close()
        self.commands.close()
        self.heartbeats.close()


@pytest.fixture
def folder(runtime):
    return runtime.stream("a")


def first(source: CapturedSource, capture: StandIn, seq: int = 0, **changes) -> Frame:
    """Send frames until the source returns one."""
    until_s = time.monotonic() + SOON_S
    while time.monotonic() < until_s:
        capture.send(seq, **changes)
        frame = source.read(0.02)
        if frame is not None:
            return frame
        seq += 1
    raise AssertionError("no frame came")


def wait_until(what) -> None:
    until_s = time.monotonic() + SOON_S
    while not what():
        assert time.monotonic() < until_s, "condition not met in time"
        time.sleep(0.01)


def test_captured_source_receives_image_mask_depth_and_status(folder):
    capture = StandIn(folder, run=1)
    source = CapturedSource(folder)
    assert (source.description.camera, source.description.fields) == (ABOUT.camera, ABOUT.fields)
    source.open()
    mask, depth = np.ones((4, 6), np.uint8), np.full((4, 6), 7, np.float32)
    frame = first(source, capture, mask=mask, depth=depth, status=FrameStatus.DAMAGED, damage="torn")
    assert (frame.status, frame.damage) == (FrameStatus.DAMAGED, "torn")
    assert frame.mask is not None and frame.depth is not None
    np.testing.assert_array_equal(frame.depth, depth)
    assert frame.arrived_ns is not None and frame.arrived_ns < time.monotonic_ns()
    source.close()
    capture.close()


def test_captured_source_continues_numbers_and_times_after_restart(folder):
    capture = StandIn(folder, run=1)
    source = CapturedSource(folder)
    source.open()
    last = first(source, capture, seq=100)
    capture.close()
    wait_until(lambda: source.state is SourceState.RECONNECTING)
    assert "capture process" in source.state_sentence
    capture = StandIn(folder, run=2)
    following = first(source, capture, seq=0)
    assert following.seq > last.seq
    assert following.pts_ns > last.pts_ns
    wait_until(lambda: source.state is SourceState.LIVE)
    source.close()
    capture.close()


@pytest.mark.parametrize(
    ("said", "state"),
    [("stalled", SourceState.STALLED), ("ended", SourceState.STALLED), ("opening", SourceState.RECONNECTING)],
)
def test_captured_source_reports_state_of_capture_process(folder, said, state):
    capture = StandIn(folder, run=1)
    source = CapturedSource(folder)
    source.open()
    first(source, capture)
    capture.said = {"state": said, "reason": "the cable is out"}
    while source.read(0) is not None:
        pass
    wait_until(lambda: source.state is state and source.state_sentence == "the cable is out")
    source.close()
    capture.close()


def test_captured_source_counts_malformed_messages(folder, monkeypatch):
    capture = StandIn(folder, run=1)
    source = CapturedSource(folder)
    source.open()
    first(source, capture)
    with monkeypatch.context() as patch:
        patch.setattr("services.bus.messages.encode", lambda frame: [b"nonsense"])
        capture.send(1)
    wait_until(lambda: source.counts().get("bad_messages") == 1)
    capture.publisher.publish({"seq": 1}, np.zeros((4, 6, 3), np.uint8))
    wait_until(lambda: source.counts().get("bad_messages") == 2)
    source.close()
    capture.close()


def test_captured_source_stops_waiting_on_stop_request(folder):
    stop = threading.Event()
    threading.Timer(0.2, stop.set).start()
    with pytest.raises(SourceUnavailable, match="has not opened its source"):
        CapturedSource(folder, stop.is_set)


def test_captured_source_scales_frames_and_camera(folder):
    capture = StandIn(folder, run=1)
    sizes: list[tuple[int, int]] = []

    def scale_for(about: SourceDescription) -> float:
        sizes.append((about.width_px, about.height_px))
        return 0.5

    source = CapturedSource(folder, scale_for=scale_for)
    assert sizes == [(6, 4)]
    assert source.description.camera == ABOUT.camera.scaled(0.5)
    assert (source.description.width_px, source.description.height_px) == (3, 2)
    source.open()
    frame = first(source, capture, seq=7, mask=np.ones((4, 6), np.uint8))
    assert frame.image.shape == (2, 3, 3) and frame.mask is not None and frame.mask.shape == (2, 3)
    np.testing.assert_array_equal(frame.image, frame.seq)
    source.close()
    capture.close()
