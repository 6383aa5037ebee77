"""Messages between a source's process and its reader: both ways, and refused where they are none."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_origin import DEPTH_ORIGINS
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources import wire
from operators.sources.options import SourceOptions
from operators.sources.source import SourceDescription
from operators.sources.wire import BadHeader

IMAGE = np.zeros((2, 3, 3), np.uint8)
CAMERA = Camera.from_focal(30.0, 3, 2)


def header(**fields):
    return wire.frame_header(Frame(4, 5, IMAGE)) | fields


def test_a_frame_comes_back_with_all_that_it_has():
    frame = Frame(
        3, -7, IMAGE, arrived_ns=11, status=FrameStatus.DAMAGED, damage="cut off", depth=np.ones((2, 3), np.float32),
        depth_origin=DEPTH_ORIGINS["measured"], right_image=IMAGE + np.uint8(9), right_camera=CAMERA,
    )  # fmt: skip
    planes = wire.planes_of(frame)
    assert set(planes) == {"image", "depth", "right_image"}
    back = wire.frame_from(wire.parsed(wire.message("frame", **wire.frame_header(frame))), planes)
    assert (back.seq, back.pts_ns, back.arrived_ns, back.status, back.damage) == (
        3,
        -7,
        11,
        FrameStatus.DAMAGED,
        "cut off",
    )
    assert back.depth_origin is DEPTH_ORIGINS["measured"] and back.depth is frame.depth
    assert back.right_camera is not None and np.array_equal(back.right_camera.K, CAMERA.K)


@pytest.mark.parametrize(
    "fields",
    [
        {"seq": 2**62}, {"pts_ns": 2**62}, {"pts_ns": -(2**62)}, {"seq": True}, {"seq": 1.0}, {"pts_ns": "1"}, {"pts_ns": None},
        {"damage": 3}, {"arrived_ns": 1.5}, {"arrived_ns": True}, {"status": "asleep"}, {"depth_origin": "guess"},
        {"right_camera": {"K": 1}}, {"right_camera": 4},
    ],
)  # fmt: skip
def test_a_header_that_is_no_frame_is_refused(fields):
    with pytest.raises(BadHeader):
        wire.frame_from(header(**fields), {"image": IMAGE})


def test_the_largest_numbers_are_taken_and_a_missing_one_is_refused():
    frame = wire.frame_from(header(seq=2**62 - 1, pts_ns=1 - 2**62, arrived_ns=None), {"image": IMAGE})
    assert (frame.seq, frame.pts_ns, frame.arrived_ns) == (2**62 - 1, 1 - 2**62, None)
    for name in ("seq", "pts_ns", "arrived_ns", "damage", "status"):
        incomplete = header()
        del incomplete[name]
        with pytest.raises(BadHeader, match="this is no frame"):
            wire.frame_from(incomplete, {"image": IMAGE})


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[]", b"3", b"{}", b'{"kind": 3}'])
def test_bytes_that_are_no_message_are_refused(data):
    with pytest.raises(BadHeader):
        wire.parsed(data)


def test_a_description_and_options_come_back():
    about = SourceDescription("cam", 3, 2, 25.0, CAMERA, frozenset({"mask", "depth"}), frame_count=7, notes=("a", "b"))
    back = wire.description_from(wire.parsed(wire.message("x", about=wire.description_to(about)))["about"])
    assert (back.name, back.width_px, back.height_px, back.fps, back.fields) == ("cam", 3, 2, 25.0, about.fields)
    assert back.frame_count == 7 and back.notes == ("a", "b") and np.array_equal(back.camera.K, CAMERA.K)
    options = SourceOptions(scale=0.5, loop=True, waiting=3, stereo="top_bottom")
    assert wire.options_from(wire.options_to(options)) == options


@pytest.mark.parametrize("change", [{"camera": None}, {"camera": {"K": 1}}, {"notes": 3}, {"more": 1}])
def test_what_describes_no_source_is_refused(change):
    about = SourceDescription("cam", 3, 2, 25.0, CAMERA)
    with pytest.raises(BadHeader, match="describes no source"):
        wire.description_from(wire.description_to(about) | change)


def test_counts_are_numbers_by_reason():
    assert wire.finite_counts({"late": 3, "lost": "many", "odd": 1.5}) == {"late": 3}
    assert wire.finite_counts([1]) == {} == wire.finite_counts(None)


def test_arrays_without_gaps_are_kept_as_they_are():
    plane = np.arange(12).reshape(3, 4)
    found = wire.as_contiguous({"a": plane, "b": plane[:, ::2]})
    assert found["a"] is plane and found["b"].flags.c_contiguous and found["b"].tolist() == [[0, 2], [4, 6], [8, 10]]
