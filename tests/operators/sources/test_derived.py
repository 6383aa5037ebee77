"""Two eyes in one picture, and two sources as one."""

from __future__ import annotations

import threading
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.calibration import default_camera
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources.derived import JoinedSource, ScaledSource, SplitSource
from operators.sources.live import LiveSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import FrameSource, ReportingSource, SourceDescription, SourceState

SOON_S = 300.0
MS = 1_000_000


class Given(LiveSource):
    """Gives frames from a list, and waits where the list has an event."""

    def __init__(self, script, camera, name="eye", **about):
        super().__init__(waiting=64)
        self.script = script
        self.description = SourceDescription(name, camera.width_px, camera.height_px, 25.0, camera, **about)

    def frames(self):
        for step in self.script:
            if isinstance(step, threading.Event):
                step.wait(SOON_S)
            else:
                yield step


def all_of(source):
    found = []
    source.open()
    while (frame := source.read(SOON_S)) is not None:
        found.append(frame)
    source.close()
    return found


@pytest.mark.parametrize(("layout", "size"), [("side_by_side", (12, 16)), ("top_bottom", (24, 8))])
def test_split_source_splits_picture_into_two_eyes(frame, layout, size):
    whole = default_camera(24, 16)
    mask, depth = np.ones((16, 24), np.uint8), np.full((16, 24), 50, np.float32)
    given = [frame(k, mask=mask, depth=depth, labels=mask, loss_mask=mask, depth_confidence=depth) for k in range(3)]
    source = SplitSource(Given(given, whole), layout)
    assert isinstance(source, FrameSource) and isinstance(source, ReportingSource)
    about = source.description
    assert (about.width_px, about.height_px) == size and about.fields == {"right_image"}
    assert about.camera == default_camera(*size), "the camera of one eye"
    for split, full in zip(all_of(source), given, strict=True):
        axis = 1 if layout == "side_by_side" else 0
        np.testing.assert_array_equal(np.concatenate([split.image, split.right_image], axis), full.image)
        planes = (split.mask, split.depth, split.labels, split.loss_mask, split.depth_confidence)
        assert {plane.shape for plane in planes} == {size[::-1]} and split.image.flags.c_contiguous
    assert source.state is SourceState.ENDED and source.counts() == {}


def test_split_source_refuses_calibration_of_whole_picture():
    left = Camera(np.array([[30.0, 0, 6], [0, 30, 8], [0, 0, 1]]), 24, 16)
    assert SplitSource(Given([], left), "side_by_side").description.camera.K.tolist() == left.K.tolist()
    both = Camera.from_focal(30.0, 24, 16)
    with pytest.raises(InvalidSetting, match=r"not that of its left eye: the principal point \(12, 8\)"):
        SplitSource(Given([], both), "side_by_side")


def test_split_source_refuses_one_column_stereo_source_and_scans():
    with pytest.raises(InvalidSetting, match="1x16 px, which are not two eyes side by side"):
        SplitSource(Given([], Camera.from_focal(30.0, 1, 16)), "side_by_side")
    with pytest.raises(InvalidSetting, match="range scans"):
        SplitSource(Given([], default_camera(24, 16), fields=frozenset({"ranges"})), "top_bottom")
    with pytest.raises(InvalidSetting, match="has a right picture for each frame"):
        SplitSource(Given([], default_camera(24, 16), fields=frozenset({"right_image"})), "top_bottom")


def at(frame, index, ms, **fields):
    return frame(index, pts_ns=index, arrived_ns=round(ms * MS), **fields)


def test_joined_source_pairs_frames_by_arrival_time(camera, frame):
    left = Given([at(frame, k, 1000 + 40 * k) for k in range(5)], camera, "left")
    right = Given([at(frame, 10 + k, 1003 + 40 * k) for k in range(5)], camera, "right")
    source = JoinedSource(left, right, waiting=64)
    assert isinstance(source, FrameSource) and source.description.name == "left and right"
    joined = all_of(source)
    assert [each.seq for each in joined] == list(range(5)) and source.counts() == {}
    for k, each in enumerate(joined):
        np.testing.assert_array_equal(each.right_image, frame(10 + k).image)


def test_joined_source_passes_left_frames_without_right_partner(camera, frame):
    left = Given([at(frame, k, 1000 + 40 * k) for k in range(5)], camera)
    right = Given([at(frame, 10, 1000), at(frame, 13, 1120), at(frame, 99, 5000)], camera)
    source = JoinedSource(left, right, waiting=64)
    joined = all_of(source)
    assert [each.right_image is not None for each in joined] == [True, False, False, True, False]
    assert source.counts()["without_right"] == 3


def test_joined_source_marks_damage_and_drops_right_image_of_other_size(camera, frame):
    torn = {"status": FrameStatus.DAMAGED, "damage": "torn"}
    left = Given([at(frame, k, 1000 + 40 * k) for k in range(2)], camera)
    small = at(frame, 1, 1040, image=np.zeros((4, 4, 3), np.uint8))
    source = JoinedSource(left, Given([at(frame, 0, 1000, **torn), small], camera), waiting=64)
    first, second = all_of(source)
    assert (first.status, first.damage) == (FrameStatus.DAMAGED, "right eye: torn")
    assert second.right_image is None and source.counts() == {"right_of_another_size": 1}


def test_joined_source_refuses_eyes_of_different_size(camera):
    with pytest.raises(InvalidSetting, match="the left eye has 24x16 px and the right one 12x16"):
        JoinedSource(Given([], camera), Given([], Camera.from_focal(30.0, 12, 16)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=4, width_px=64, height_px=48, stereo=False)


def test_stereo_addresses_open_split_and_joined_sources(folder, tmp_path):
    (tmp_path / "double").mkdir()
    import cv2

    for k in range(3):
        cv2.imwrite(str(tmp_path / "double" / f"{k:06d}.png"), np.full((32, 96, 3), 50 + k, np.uint8))
    for address, options in (
        (f"realtime:{tmp_path}/double?speed=max&stereo=side_by_side", None),
        (f"realtime:{tmp_path}/double?stereo=side_by_side&speed=max", None),
        (tmp_path / "double", SourceOptions(stereo="side_by_side")),
    ):
        source = open_source(address, options)
        assert (source.description.width_px, source.description.height_px) == (48, 32)
        assert [each.right_image.shape for each in all_of(source)] == [(32, 48, 3)] * 3
    joined = open_source(f"stereo:realtime:{folder}?speed=max|realtime:{folder}?speed=max")
    left = list(open_recording(folder))
    assert [each.right_image is not None for each in all_of(joined)] and joined.description.camera == open_recording(
        folder
    ).camera
    assert len(left) == 4


@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("stereo:a", "1 sources are named; give stereo:LEFT|RIGHT"),
        ("stereo:a|b|c", "3 sources are named"),
        ("realtime:x?stereo=both", "stereo is 'both'; choose side_by_side or top_bottom"),
    ],
)
def test_invalid_stereo_address_is_refused(address, what):
    with pytest.raises(InvalidSetting, match=what.replace("|", r"\|")):
        open_source(address)


def test_existing_path_with_query_characters_is_opened(tmp_path):
    path = tmp_path / "take?stereo=side_by_side"
    synthesize(path, frames=1, width_px=64, height_px=48, stereo=False)
    assert open_source(path).description.width_px == 64


@pytest.mark.parametrize(
    ("at_ms", "right_ms", "paired", "left_over"),
    [(100, [60, 95, 103, 140], 103, [140]), (100, [60, 97, 110], 97, [110]), (100, [100, 100, 130], 100, [100, 130]), (100, [70], None, [70]), (100, [], None, [])],
)  # fmt: skip
def test_joined_source_pairs_nearest_right_frame_and_drops_earlier(at_ms, right_ms, paired, left_over):
    """Pictures are at most 20 ms apart."""
    picture = lambda ms: Frame(0, ms * 1_000_000, np.full((4, 4, 3), ms, np.uint8))
    rights, counted = iter([picture(ms) for ms in right_ms]), []
    source = object.__new__(JoinedSource)
    source._right = SimpleNamespace(read=lambda timeout_s: next(rights, None))
    source._apart_ns, source.count = 20_000_000, counted.append
    kept = deque()
    found = source._paired(picture(at_ms), kept)
    assert (None if found.right_image is None else found.right_image[0, 0, 0]) == paired
    assert counted == ([] if paired else ["without_right"])
    assert [each.image[0, 0, 0] for each in (*kept, *rights)] == left_over


def paired(at_ms, waiting_ms, comes_ms=(), **changed):
    """Return what a left frame at a moment is paired with, and the right frames that are left."""
    joined = object.__new__(JoinedSource)
    counted, coming = [], [picture(moment) for moment in comes_ms]
    joined._apart_ns, joined.count = 20_000_000, counted.append
    joined._right = SimpleNamespace(read=lambda timeout_s: coming.pop(0) if coming else None)
    kept = deque(picture(moment) for moment in waiting_ms)
    found = joined._paired(picture(at_ms, **changed), kept)
    right = None if found.right_image is None else int(found.right_image[0, 0, 0])
    return right, [int(each.image[0, 0, 0]) for each in kept], counted


def picture(moment_ms, **changed):
    """Return a frame of one colour, which is the moment at which it came."""
    return Frame(0, 0, np.full((4, 4, 3), moment_ms, np.uint8), arrived_ns=moment_ms * 1_000_000, **changed)


@pytest.mark.parametrize(
    ("at_ms", "waiting_ms", "comes_ms", "right", "left", "counted"),
    [
        (100, [60, 95, 130], [], 95, [130], []), (100, [60, 89, 108], [], 108, [], []), (100, [100], [200], 100, [], []),
        (100, [], [70, 90, 104, 140], 104, [], []), (100, [80], [], 80, [], []), (100, [79], [], None, [79], ["without_right"]),
        (100, [121, 140], [], None, [121, 140], ["without_right"]), (100, [], [], None, [], ["without_right"]),
        (100, [90], [200], 90, [200], []),
    ],
)  # fmt: skip
def test_joined_source_pairing_reads_at_most_one_later_frame(at_ms, waiting_ms, comes_ms, right, left, counted):
    """Within half a frame interval. Earlier frames of the other eye are dropped with it, and no more than one later frame is read."""
    found, kept, reasons = paired(at_ms, waiting_ms, comes_ms)
    assert (found, kept, reasons) == (right, left, counted)


def test_scaled_source_scales_frames_of_other_size_by_same_factor():
    description = SourceDescription("camera", 80, 60, 30.0, Camera.from_focal(50.0, 80, 60))
    scaled = ScaledSource(SimpleNamespace(description=description), 0.5)
    assert (scaled.description.width_px, scaled.description.height_px) == (40, 30)
    for size, expected in (((80, 60), (40, 30)), ((100, 20), (50, 10)), ((160, 1), (80, 1))):
        frame = Frame(0, 0, np.zeros((size[1], size[0], 3), np.uint8))
        found = scaled._derived(frame)
        assert (found.width_px, found.height_px) == expected
