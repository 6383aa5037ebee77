"""Hostile or damaged session recordings: unreadable content is refused with a sentence or omitted."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from gsplat_core.errors import RecordingError, UserError
from gsplat_core.io.recordings import open_recording, validate_recording
from gsplat_core.io.recordings.decoder import whole_clusters
from gsplat_core.io.sessions import SessionReader, SessionWriter
from gsplat_core.scene.frames import FrameStatus
from operators.applications.replay import ReplaySettings, followed_session
from tests.gsplat_core.io.sessions.made import new_frame, same_frame, session_info, write_frames

FRAMES = 5
LOG = "segments/000000/log.jsonl"
IMAGE = "segments/000000/image_24x16.mkv"


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("attacked") / "session"
    writer = SessionWriter(folder, session_info())
    write_frames(writer, [new_frame(seq) for seq in range(FRAMES)])
    writer.close("end")
    return folder


@pytest.fixture
def session(whole, tmp_path) -> Path:
    shutil.copytree(whole, tmp_path / "session")
    return tmp_path / "session"


def outcome_of(folder: Path) -> list[Any] | str:
    """Read a session in every way. Return its frames, or the sentence that refuses it."""
    try:
        recording = open_recording(folder)
        frames = list(recording)
        reader = SessionReader(folder)
        list(reader.prepared())
        list(reader.schedule())
        assert recording.frame_count == len(frames)
    except RecordingError as error:
        assert "\n" not in str(error)
        assert not validate_recording(folder).ok
        return str(error)
    validate_recording(folder)
    return frames


def change_lines(folder: Path, change: Callable[[dict[str, Any]], None], event: str = "frame") -> None:
    """Change all log lines of an event in place."""
    lines = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    for line in lines:
        if line["event"] == event:
            change(line)
    (folder / LOG).write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.mark.parametrize(
    "values",
    [
        {"seq": -1},
        {"seq": 2**70},
        {"seq": 1.5},
        {"seq": True},
        {"pts_ns": 10**400},
        {"width_px": 0},
        {"width_px": 65_536, "height_px": 65_536},
        {"width_px": 25},
        {"tracks": {"../../../etc/passwd": 0}},
        {"tracks": {"image": -1}},
        {"tracks": {"mask": 0}},
        {"tracks": {"image": 10**9}},
        {"tracks": []},
        {"tracks": {}},
        {"status": "alive"},
        {"pose": [1.0] * 15},
        {"pose": [1.0] * 16},
        {"pose": [1e300] * 12 + [0, 0, 0, 1]},
        {"withheld": "x" * 10_000},
        {"damage": {"a": "b"}},
        {"event": "end"},
        {"event": ["frame"]},
    ],
    ids=str,
)
def test_session_with_invalid_frame_values_yields_no_frames(session, values):
    change_lines(session, lambda line: line.update(values))
    found = outcome_of(session)
    assert isinstance(found, str), "no frame of it is whole"


def test_session_omits_repeated_or_decreasing_frame_numbers(session):
    data = (session / LOG).read_bytes().splitlines(keepends=True)
    (session / LOG).write_bytes(b"".join([*data[:-1], *data[1:]]))
    found = outcome_of(session)
    assert [frame.seq for frame in found] == list(range(FRAMES))


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity"])
def test_session_with_non_finite_number_is_refused(session, value):
    text = (session / LOG).read_text()
    assert '"fx":20.0,' in text
    (session / LOG).write_text(text.replace('"fx":20.0,', f'"fx":{value},'))
    assert isinstance(outcome_of(session), str)


def test_session_log_with_endless_line_is_refused(session):
    with (session / LOG).open("ab") as file:
        file.truncate(200)
        file.seek(200)
        file.write(b"[" * 5_000_000)
    assert isinstance(outcome_of(session), str)


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"null", b"{}", b"[" * 100_000, b"\xff\xfe", b'{"format":"other"}', b"{" * 3_000_000]
)
def test_malformed_session_json_is_refused(session, text):
    (session / "session.json").write_bytes(text)
    assert isinstance(outcome_of(session), str)


@pytest.mark.parametrize(
    "camera",
    [
        {"fx": 0},
        {"fx": -3},
        {"fx": 1e300},
        {"width_px": 10**9},
        {"model": "magic"},
        {"world_to_camera": [0] * 16},
        {"cx": None},
    ],
    ids=str,
)
def test_session_with_invalid_camera_is_refused(session, camera):
    values = json.loads((session / "session.json").read_text())
    values["camera"].update(camera)
    (session / "session.json").write_text(json.dumps(values))
    assert isinstance(outcome_of(session), str)


@pytest.mark.parametrize("name", [LOG, IMAGE, "session.json", "segments/000000", "segments"])
def test_session_with_links_is_refused(session, tmp_path, name):
    target = tmp_path / "elsewhere"
    (session / name).rename(target)
    (session / name).symlink_to(target)
    found = outcome_of(session)
    assert isinstance(found, str)


@pytest.mark.parametrize("name", [LOG, IMAGE])
def test_session_with_pipe_as_file_is_refused_without_hang(session, name):
    (session / name).unlink()
    os.mkfifo(session / name)
    assert isinstance(outcome_of(session), str)


def other_video(path: Path, codec: str, pixels: str, width: int = 24, height: int = 16) -> None:
    path.unlink()
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        for k in range(FRAMES):
            frame = av.VideoFrame(width, height, pixels)
            for plane in frame.planes:
                plane.update(bytes(plane.buffer_size))
            frame.pts = k
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("codec", "pixels", "size"),
    [
        ("mjpeg", "yuvj420p", (24, 16)),
        ("ffv1", "yuv420p", (24, 16)),
        ("ffv1", "gray", (24, 16)),
        ("ffv1", "bgr0", (48, 32)),
        ("libx264", "yuv420p", (24, 16)),
    ],
)
def test_session_track_with_other_video_is_refused_or_damaged(session, codec, pixels, size):
    other_video(session / IMAGE, codec, pixels, *size)
    found = outcome_of(session)
    assert isinstance(found, str) or all(frame.status is FrameStatus.DAMAGED for frame in found)


@pytest.mark.slow
def test_session_with_flipped_bits_yields_true_or_damaged_frames(session, whole, rng):
    """An image that is not reported as damaged equals the recorded one byte for byte."""
    names = [str(path.relative_to(whole)) for path in whole.rglob("*") if path.is_file()]
    for k in range(120):
        name = names[k % len(names)]
        data = bytearray((whole / name).read_bytes())
        for at in rng.integers(0, len(data), 1 + k % 3):
            data[at] ^= 1 << int(rng.integers(8))
        (session / name).write_bytes(data)
        found = outcome_of(session)
        if not isinstance(found, str) and name.endswith(".mkv"):
            for frame in found:
                wanted = new_frame(frame.seq)
                assert frame.status is FrameStatus.DAMAGED or same_frame(frame, wanted), f"{name} {k}"
        (session / name).write_bytes((whole / name).read_bytes())


@pytest.mark.parametrize("track", ["image", "prepared_loss_mask"])
def test_prepared_frame_of_damaged_track_is_marked_damaged(session, track):
    path = session / f"segments/000000/{track}_24x16.mkv"
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        ends = [cluster.end for cluster in whole_clusters(file, len(data), check_sums=True)]
    data[ends[2] - 20] ^= 0x40
    path.write_bytes(data)
    found = list(SessionReader(session).prepared())
    assert [frame.status is FrameStatus.DAMAGED for frame in found] == [False, False, True, False, False]
    assert not found[2].mask.any()


@pytest.mark.parametrize(
    "values",
    [
        {"steps": -1},
        {"steps": 10**12},
        {"seq": "0"},
        {"train": 1},
    ],
    ids=str,
)
def test_session_schedule_omits_invalid_observe_lines(session, values):
    change_lines(session, lambda line: line.update(values), "observe")
    outcome_of(session)
    assert not [line for line in SessionReader(session).schedule() if line.event == "observe"]


@pytest.mark.parametrize(
    "made",
    [
        {"config": {"gaussians": 10**12}},
        {"config": {"field": "none such"}},
        {"config": {"no such setting": 1}},
        {"training": {"rate_steps": 0}},
        {"seed": -1},
        {"device": "/dev/sda"},
    ],
    ids=str,
)
def test_session_with_invalid_reconstructor_is_refused_or_noted(session, tmp_path, made):
    camera = json.loads((session / "session.json").read_text())["camera"]
    line = {
        "event": "reconstructor",
        "device": "cpu",
        "seed": 0,
        "renderer": "alpha",
        "config": {},
        "training": {},
        "camera": camera,
    }
    data = (session / LOG).read_bytes().splitlines(keepends=True)
    (session / LOG).write_bytes(b"".join([data[0], json.dumps(line | made).encode() + b"\n", *data[1:]]))
    notes: list[str] = []
    try:
        followed = followed_session(ReplaySettings(recording=session, out=tmp_path / "out"), notes)
    except UserError as error:
        assert "--ignore-schedule" in str(error)
    else:
        assert followed is None or notes or made == {"config": {"no such setting": 1}}


def test_unmodified_session_is_read_unchanged(session):
    found = outcome_of(session)
    assert all(same_frame(frame, new_frame(frame.seq)) for frame in found)
    assert len(found) == FRAMES
    assert np.array_equal(found[0].image, new_frame(0).image)
