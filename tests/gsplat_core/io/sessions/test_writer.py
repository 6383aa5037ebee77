"""Segments of bounded size, the removal of old ones, frames of changing size, jumping clocks."""

from __future__ import annotations

import json
import shutil
from hashlib import sha256

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.sessions import SessionReader, SessionWriter, WriterOptions
from gsplat_core.io.sessions.reader import prepared_of
from gsplat_core.io.sessions.records import DeletedLine, Observed, PreparedLine, ShownLine
from gsplat_core.io.sessions.writer import Shown
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame, FrameStatus
from tests.gsplat_core.io.sessions.made import Clock, new_frame, same_frame, session_info


def frames_of(folder) -> list[Frame]:
    return [frame for _, frame in SessionReader(folder).frames() if frame is not None]


def test_session_frames_round_trip_bit_for_bit(session, frames):
    found = frames_of(session)
    assert all(same_frame(a, b) for a, b in zip(found, frames, strict=True))
    assert {frame.status for frame in found} == {FrameStatus.REPLAY}
    lines = [line for line, _ in SessionReader(session).frames()]
    assert [line.arrived_ns for line in lines] == [frame.arrived_ns for frame in frames]


def test_prepared_frames_round_trip_bit_for_bit(session, frames):
    arrived = {frame.seq: frame for frame in frames_of(session)}
    seen = 0
    for segment in SessionReader(session).segments:
        with segment.open() as pictures:
            for line in segment.lines():
                if isinstance(line, PreparedLine):
                    frame = prepared_of(line, arrived[line.seq], pictures)
                    assert frame is not None
                    wanted = frames[line.seq].with_fields(loss_mask=np.ones_like(frames[line.seq].mask))
                    assert same_frame(frame, wanted)
                    assert line.same == ("image", "right_image", "mask", "depth", "depth_confidence")
                    seen += 1
    assert seen == len(frames)


def test_late_depth_round_trips_in_schedule_order(tmp_path):
    frames = [new_frame(seq, depth=None, depth_confidence=None, depth_origin=None) for seq in range(3)]
    late = new_frame(1, depth_origin=DEPTH_ORIGINS["stereo"])
    bare = new_frame(0, depth_confidence=None, depth_origin=DEPTH_ORIGINS["light"])
    writer = SessionWriter(tmp_path / "s", session_info(), WriterOptions(segment_bytes=5000))
    for frame, found in zip(frames, [None, bare, late], strict=True):
        writer.frame(frame)
        writer.line(Observed(seq=frame.seq, steps=1, train=True))
        if found is not None:
            writer.late_depth(found)
    writer.close("end")
    reader = SessionReader(tmp_path / "s")
    assert len(reader.segments) > 1 and reader.fields >= {"mask", "right_image"} and "depth" not in reader.fields
    events = [(line.event, line.seq) for line in reader.schedule()]
    assert events == [("observe", 0), ("observe", 1), ("take_depth", 0), ("observe", 2), ("take_depth", 1)]
    first, second = reader.late_depths()
    assert first["depth"].tobytes() == bare.depth.tobytes() and first["depth_confidence"] is None
    assert second["depth_confidence"].tobytes() == late.depth_confidence.tobytes()
    assert (first["depth_origin"], second["depth_origin"]) == (DEPTH_ORIGINS["light"], DEPTH_ORIGINS["stereo"])


def test_late_depth_with_missing_picture_is_none(tmp_path):
    writer = SessionWriter(tmp_path / "s", session_info())
    for seq in range(3):
        writer.frame(new_frame(seq))
        writer.late_depth(new_frame(seq))
    writer.close("end")
    log = tmp_path / "s/segments/000000/log.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    (number,) = (at for at, line in enumerate(lines) if '"take_depth","seq":1,' in line)
    entry = json.loads(lines[number])
    entry["tracks"]["depth_confidence"] += 1
    lines[number] = json.dumps(entry) + "\n"
    log.write_text("".join(lines))
    found = list(SessionReader(tmp_path / "s").late_depths())
    assert found[1] is None and found[2]["depth"].tobytes() == new_frame(2).depth.tobytes()


def test_shown_line_sha256_is_digest_of_picture_bytes(session, frames):
    lines = [line for _, line in SessionReader(session).lines() if isinstance(line, ShownLine)]
    for line, frame in zip(lines, frames, strict=True):
        assert line.sha256 == sha256(np.ascontiguousarray(frame.image[::-1])).hexdigest()
        assert (line.model_version, line.state, line.age_ns) == (frame.seq + 1, "live", 7)


def test_shown_pictures_are_kept_as_lossy_video(tmp_path):
    rng = np.random.default_rng(1)
    smooth = np.clip(
        np.add.outer(np.arange(40), np.arange(49))[..., None] * 2 + rng.integers(0, 3, (40, 49, 3)), 0, 255
    )
    frame = new_frame(0, 40, 49)
    writer = SessionWriter(tmp_path / "s", session_info())
    writer.shown(Shown(frame, smooth.astype(np.uint8), 1))
    writer.close("end")
    (segment,) = SessionReader(tmp_path / "s").segments
    (line,) = (line for line in segment.lines() if isinstance(line, ShownLine))
    with segment.open() as pictures:
        found, damage = pictures.of(line)
    assert damage is None
    assert found["shown"].shape == (40, 49, 3)
    assert 0 < np.abs(found["shown"].astype(int) - smooth).mean() < 6


def test_segment_bytes_limit_starts_new_segment_without_frame_loss(record):
    frames = [new_frame(seq) for seq in range(20)]
    folder = record(frames, WriterOptions(segment_bytes=20_000))
    reader = SessionReader(folder)
    assert len(reader.segments) > 3
    assert all(same_frame(a, b) for a, b in zip(frames_of(folder), frames, strict=True))
    assert {segment.ends.why for segment in reader.segments if segment.ends} == {"bytes", "end"}


def test_keep_bytes_removes_oldest_segments_with_note(record):
    frames = [new_frame(seq) for seq in range(40)]
    folder = record(frames, WriterOptions(segment_bytes=20_000, keep_bytes=60_000))
    reader = SessionReader(folder)
    on_disk = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert on_disk < 90_000
    found = frames_of(folder)
    assert [frame.seq for frame in found] == list(range(found[0].seq, 40))
    assert found[0].seq > 20
    numbers = [line.segment for _, line in reader.lines() if isinstance(line, DeletedLine)]
    assert numbers and numbers[-1] + 1 == int(reader.segments[0].folder.name)
    assert any("those before it were removed" in note for note in open_recording(folder).notes)


def test_keep_s_removes_old_segments(tmp_path):
    clock = Clock()
    writer = SessionWriter(tmp_path / "s", session_info(), WriterOptions(segment_s=1, keep_s=3.5, clock=clock))
    for seq in range(10):
        writer.frame(new_frame(seq))
        clock.now_ns += 10**9
    writer.close("end")
    assert [frame.seq for frame in frames_of(tmp_path / "s")] == [5, 6, 7, 8, 9]


def test_session_writer_refuses_used_folder(tmp_path):
    SessionWriter(tmp_path / "s", session_info()).close("end")
    with pytest.raises(FileExistsError):
        SessionWriter(tmp_path / "s", session_info())


def test_session_frames_of_changing_size_round_trip(tmp_path):
    sizes = [(16, 24), (16, 24), (33, 17), (16, 24), (9, 8), (33, 17), (3, 1), (1, 1), (1, 5)]
    frames = [new_frame(seq, *size) for seq, size in enumerate(sizes)]
    writer = SessionWriter(tmp_path / "s", session_info())
    for frame in frames:
        writer.frame(frame)
        writer.shown(Shown(frame, frame.image, 1))
    writer.close("end")
    assert all(same_frame(a, b) for a, b in zip(frames_of(tmp_path / "s"), frames, strict=True))
    recording = open_recording(tmp_path / "s")
    assert [frame.seq for frame in recording] == [0, 1, 3]
    assert any("6 of 9 frames have another size" in note for note in recording.notes)


def test_many_frame_sizes_start_new_segments(tmp_path):
    writer = SessionWriter(tmp_path / "s", session_info())
    frames = [new_frame(seq, 8 + seq, 8) for seq in range(40)]
    for frame in frames:
        writer.frame(frame)
    writer.close("end")
    assert len(SessionReader(tmp_path / "s").segments) >= 3
    assert all(same_frame(a, b) for a, b in zip(frames_of(tmp_path / "s"), frames, strict=True))


@pytest.mark.parametrize(
    "times_ns",
    [
        [0, 1, 2, 3],
        [5 * 10**9, 0, 10**9, 10**9],
        [0, 10**17, 10**17 + 1, 2 * 10**17],
        [-(10**15), 0, -5, 10**18],
    ],
    ids=["nanoseconds", "backwards", "years ahead", "negative"],
)
def test_session_timestamps_round_trip_for_any_clock(tmp_path, times_ns):
    frames = [new_frame(seq, pts_ns=time_ns) for seq, time_ns in enumerate(times_ns)]
    writer = SessionWriter(tmp_path / "s", session_info())
    for frame in frames:
        writer.frame(frame)
    writer.close("end")
    assert all(same_frame(a, b) for a, b in zip(frames_of(tmp_path / "s"), frames, strict=True))


def test_session_reader_ignores_unknown_event(session, tmp_path, frames):

    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    log = folder / "segments/000000/log.jsonl"
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join([lines[0], b'{"event":"thought","of":"tomorrow"}\n', *lines[1:]]))
    assert len(frames_of(folder)) == len(frames)
    assert sum(isinstance(line, Observed) for _, line in SessionReader(folder).lines()) == len(frames)


def test_session_reader_ignores_obsolete_track(session, tmp_path, frames):
    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    log = folder / "segments/000000/log.jsonl"
    text = log.read_text()
    for old, new in (('"mask":', '"rehearsal_mask":0,"mask":'), ('"same":[', '"same":["rehearsal_mask",')):
        assert old in text
        text = text.replace(old, new)
    log.write_text(text)
    assert all(same_frame(a, b) for a, b in zip(frames_of(folder), frames, strict=True))
    prepared = [line for line in SessionReader(folder).segments[0].lines() if isinstance(line, PreparedLine)]
    assert prepared and all("rehearsal_mask" not in line.same for line in prepared)


def test_session_log_lines_are_json_with_event(session):
    for line in (session / "segments/000000/log.jsonl").read_text().splitlines():
        assert next(iter(json.loads(line))) == "event"


@pytest.mark.parametrize(
    "options", [{"segment_bytes": 0}, {"segment_s": -1}, {"keep_bytes": -1}, {"keep_s": float("nan")}]
)
def test_writer_options_refuse_values_out_of_range(options):
    with pytest.raises(InvalidInput, match=next(iter(options))):
        WriterOptions(**options)
