"""Earlier sessions are deleted if a recording's limits apply to all recordings of the folder."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from gsplat_core.io.sessions import SessionReader, SessionWriter, WriterOptions
from gsplat_core.io.sessions import writer as retention_module
from gsplat_core.io.sessions.records import NoteLine
from gsplat_core.io.sessions.writer import DELETING, finish_removals, remove_whole
from tests.gsplat_core.io.sessions.made import Clock, new_frame, session_info

HOUR_S = 3600


def name(hour: int) -> str:
    return f"20260101T{hour:02d}0000Z"


def recorded(folder: Path, frames: int = 4, hours_ago: float = 0.0) -> Path:
    """A session that ended so long ago."""
    writer = SessionWriter(folder, session_info())
    for seq in range(frames):
        writer.frame(new_frame(seq))
    writer.close("end")
    for log in folder.rglob("log.jsonl"):
        at = log.stat().st_mtime - hours_ago * HOUR_S
        os.utime(log, (at, at))
    return folder


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def notes_of(folder: Path) -> list[str]:
    return [line.text for _, line in SessionReader(folder).lines() if isinstance(line, NoteLine)]


@pytest.fixture
def three(tmp_path) -> Path:
    """Recordings of five, two and one hour ago."""
    for hour, ago in ((10, 5), (13, 2), (14, 1)):
        recorded(tmp_path / name(hour), hours_ago=ago)
    return tmp_path


def left(recordings: Path) -> list[str]:
    return sorted(path.name for path in recordings.iterdir())


def test_new_session_removes_expired_sessions(three):
    options = WriterOptions(keep_s=3 * HOUR_S, with_earlier=True)
    writer = SessionWriter(three / name(15), session_info(), options)
    writer.close("end")
    assert left(three) == [name(13), name(14), name(15)]
    assert writer.deleted_sessions == 1 and writer.deleted_segments == 0
    (note,) = notes_of(three / name(15))
    assert name(10) in note and "removed" in note


def test_keep_bytes_removes_oldest_sessions_before_own_segments(three):
    one = size_of(three / name(10))
    options = WriterOptions(segment_bytes=one, keep_bytes=int(3.5 * one), with_earlier=True)
    writer = SessionWriter(three / name(15), session_info(), options)
    assert left(three) == [name(13), name(14), name(15)], "there has to be room for a segment"
    for seq in range(9):
        writer.frame(new_frame(seq))
        assert size_of(three) < 4.5 * one
    writer.close("end")
    assert left(three)[-1] == name(15) and name(13) not in left(three)
    assert writer.deleted_segments == 0
    assert SessionReader(three / name(15)).frame_count == 9, "earlier sessions go before its own segments"


def test_keep_bytes_removes_own_segments_after_earlier_sessions(three):
    one = size_of(three / name(10))
    options = WriterOptions(segment_bytes=one // 2, keep_bytes=2 * one, with_earlier=True)
    writer = SessionWriter(three / name(15), session_info(), options)
    for seq in range(24):
        writer.frame(new_frame(seq))
    writer.close("end")
    assert left(three) == [name(15)] and writer.deleted_sessions == 3 and writer.deleted_segments > 0
    assert size_of(three) < 2.5 * one
    seqs = [frame.seq for _, frame in SessionReader(three / name(15)).frames() if frame is not None]
    assert seqs == list(range(seqs[0], 24))


def test_limits_without_with_earlier_keep_other_sessions(three):
    SessionWriter(three / name(15), session_info(), WriterOptions(keep_bytes=1, keep_s=0.0)).close("end")
    assert left(three) == [name(10), name(13), name(14), name(15)]


def test_retention_keeps_foreign_folders_and_links(three):
    (three / name(13)).rename(three / "the one with the bleeding")
    (three / name(11)).mkdir()
    (three / name(11) / "notes.txt").write_text("mine")
    elsewhere = three.parent / f"{three.name}-elsewhere"
    shutil.move(three / name(14), elsewhere)
    (three / name(14)).symlink_to(elsewhere)
    options = WriterOptions(keep_bytes=1, keep_s=0.0, with_earlier=True)
    SessionWriter(three / name(15), session_info(), options).close("end")
    assert left(three) == [name(11), name(14), name(15), "the one with the bleeding"]
    assert SessionReader(elsewhere).frame_count == 4
    shutil.rmtree(elsewhere)


def test_interrupted_removal_is_finished_by_next_session(three, monkeypatch):
    def killed(folder: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(retention_module.shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        remove_whole(three / name(10))
    monkeypatch.undo()
    assert left(three)[0] == DELETING + name(10), "it is no session any more"
    SessionWriter(three / name(15), session_info(), WriterOptions(keep_s=HOUR_S * 9, with_earlier=True)).close("end")
    assert left(three) == [name(13), name(14), name(15)]


def test_failed_session_removal_is_noted_and_recording_continues(three, monkeypatch):
    def locked(folder: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(retention_module, "remove_whole", locked)
    options = WriterOptions(keep_s=3 * HOUR_S, with_earlier=True)
    writer = SessionWriter(three / name(15), session_info(), options)
    writer.frame(new_frame(0))
    writer.close("end")
    assert writer.deleted_sessions == 0 and name(10) in left(three)
    assert notes_of(three / name(15)) == [f"the earlier session {name(10)} could not be removed: Permission denied"]
    monkeypatch.undo()
    (three / (DELETING + "old")).mkdir()
    monkeypatch.setattr(retention_module.shutil, "rmtree", locked)
    assert [why for _, why in finish_removals(three)] == ["Permission denied"]


def test_session_expiring_during_recording_is_removed(three):
    clock = Clock()
    options = WriterOptions(segment_s=60, keep_s=3 * HOUR_S, clock=clock, with_earlier=True)
    writer = SessionWriter(three / name(15), session_info(), options)
    for seq in range(4):
        writer.frame(new_frame(seq))
        clock.now_ns += HOUR_S * 10**9 // 2
    writer.close("end")
    assert left(three) == [name(14), name(15)]
