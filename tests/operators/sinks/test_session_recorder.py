"""Recording next to a graph: the graph never waits for the disk, losses are counted, a full disk ends the recording."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.io.recordings import open_recording
from gsplat_core.io.sessions import SessionReader, SessionWriter
from gsplat_core.io.sessions.records import LostLine, Observed
from gsplat_core.io.sessions.writer import Shown
from operators.errors import OutputError, StorageFull
from operators.sinks import session_recorder
from operators.sinks.session_recorder import SessionRecorder, stated
from operators.storage import StorageReserve
from tests.gsplat_core.io.sessions.made import new_frame, same_frame, session_info


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """A disk that takes nothing until it is opened."""
    opened = threading.Event()
    written = SessionWriter.frame

    def slow(self, frame):
        assert opened.wait(300)
        written(self, frame)

    monkeypatch.setattr(SessionWriter, "frame", slow)
    yield opened
    opened.set()


def recorder_in(folder: Path, **options) -> SessionRecorder:
    recorder = SessionRecorder(folder / "s", session_info(), **options)
    recorder.open()
    return recorder


def frames_of(folder: Path):
    return [frame for _, frame in SessionReader(folder / "s").frames() if frame is not None]


def test_closed_recorder_has_written_all_frames_and_shown_pictures(tmp_path):
    recorder = recorder_in(tmp_path)
    frames = [new_frame(seq) for seq in range(20)]
    for frame in frames:
        recorder.frame(frame)
        recorder.prepared(frame)
        recorder.line(Observed(seq=frame.seq, steps=1, train=True))
        recorder.shown(Shown(frame, frame.image, 1))
    recorder.close()
    assert all(same_frame(a, b) for a, b in zip(frames_of(tmp_path), frames, strict=True))
    found = list(SessionReader(tmp_path / "s").prepared())
    assert all(same_frame(a, b) for a, b in zip(found, frames, strict=True))
    recorded = recorder.recorded
    assert (recorded.frames, recorded.shown, recorded.lost, recorded.ended) == (20, 20, {}, None)
    assert stated(recorded) == []


def test_recorder_drops_and_counts_frames_on_slow_disk_without_blocking(tmp_path, gate):
    frames = [new_frame(seq) for seq in range(50)]
    size = sum(
        frames[0].__dict__[name].nbytes
        for name in ("image", "right_image", "depth", "depth_confidence", "mask", "loss_mask")
    )
    recorder = recorder_in(tmp_path, queue_bytes=10 * size)
    begin = time.monotonic()
    for frame in frames:
        recorder.frame(frame)
    assert time.monotonic() - begin < 200, "a frame waited for the disk"  # which takes nothing for 300 s
    gate.set()
    recorder.close()
    assert [frame.seq for frame in frames_of(tmp_path)] == list(range(10))
    lost = [line for _, line in SessionReader(tmp_path / "s").lines() if isinstance(line, LostLine)]
    assert [(line.seq, line.what) for line in lost] == [(seq, "frame") for seq in range(10, 50)]
    assert recorder.recorded.lost == {"frame: writing is too slow": 40}
    assert "40 times" in stated(recorder.recorded)[0]


def test_recorder_drops_shown_pictures_before_frames(tmp_path, gate):
    frames = [
        new_frame(seq, right_image=None, depth=None, depth_confidence=None, mask=None, loss_mask=None)
        for seq in range(8)
    ]
    recorder = recorder_in(tmp_path, queue_bytes=8 * frames[0].image.nbytes)
    for frame in frames[:4]:
        recorder.frame(frame)
        recorder.shown(Shown(frame, frame.image, 1))
    gate.set()
    recorder.close()
    recorded = recorder.recorded
    assert recorded.frames == 4
    assert recorded.shown < 4
    assert recorded.lost == {"shown: writing is too slow": 4 - recorded.shown}


def test_recorder_drops_prepared_frame_of_lost_frame(tmp_path, gate):
    frames = [new_frame(seq) for seq in range(3)]
    recorder = recorder_in(tmp_path, queue_bytes=8000)
    for frame in frames:
        recorder.frame(frame)
    assert frames[2].image.nbytes < 8000
    recorder.prepared(frames[2])
    gate.set()
    recorder.close()
    assert [frame.seq for frame in frames_of(tmp_path)] == [0]
    assert recorder.recorded.lost == {
        "frame: writing is too slow": 2,
        "prepared: the frame itself is not there": 1,
    }


def test_full_disk_ends_recording_but_not_session(tmp_path, monkeypatch):
    room = [0]
    recorder = recorder_in(tmp_path, reserve=StorageReserve(tmp_path, lambda: room[0]))
    for seq in range(5):
        recorder.frame(new_frame(seq))
    while recorder.recorded.frames < 5:
        time.sleep(0.01)
    room[0] = 2**62
    for seq in range(5, 10):
        recorder.frame(new_frame(seq))
    recorder.close()
    recorded = recorder.recorded
    assert recorded.frames == 5
    assert recorded.ended is not None and "the disk of" in recorded.ended and "is full" in recorded.ended
    assert [frame.seq for frame in frames_of(tmp_path)] in (list(range(5)), list(range(4)))
    assert any("the recording ended before the session" in sentence for sentence in stated(recorded))


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), OSError(5, "Input/output error")])
def test_disk_error_ends_recording_with_one_line_reason(tmp_path, monkeypatch, error):
    recorder = recorder_in(tmp_path)
    recorder.frame(new_frame(0))
    while recorder.recorded.frames < 1:
        time.sleep(0.01)

    def fails(self, frame):
        raise error

    monkeypatch.setattr(SessionWriter, "frame", fails)
    recorder.frame(new_frame(1))
    recorder.close()
    assert recorder.recorded.ended is not None
    assert str(error.strerror) in recorder.recorded.ended
    assert "\n" not in recorder.recorded.ended


@pytest.mark.slow
def test_file_size_limit_ends_recording(tmp_path):
    """Apply a real system limit in a separate process."""
    program = f"""
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from pathlib import Path
from operators.sinks.session_recorder import SessionRecorder
from tests.gsplat_core.io.sessions.made import new_frame, session_info
recorder = SessionRecorder(Path({str(tmp_path / "s")!r}), session_info())
recorder.open()
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for seq in range(60):
    recorder.frame(new_frame(seq))
recorder.close()
print(recorder.recorded.ended)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=_root())
    assert done.returncode == 0, done.stderr
    assert "would be larger than this process may write" in done.stdout
    seqs = [frame.seq for frame in frames_of(tmp_path)]
    assert len(seqs) > 3 and seqs == list(range(len(seqs)))
    for frame in frames_of(tmp_path):
        assert same_frame(frame, new_frame(frame.seq))


@pytest.mark.slow
def test_recording_of_killed_process_is_readable_to_last_frame(tmp_path):
    program = f"""
from pathlib import Path
from operators.sinks.session_recorder import SessionRecorder
from gsplat_core.io.sessions import WriterOptions
from gsplat_core.io.sessions.writer import Shown
from tests.gsplat_core.io.sessions.made import new_frame, session_info
recorder = SessionRecorder(Path({str(tmp_path / "s")!r}), session_info(), WriterOptions(segment_bytes=60_000))
recorder.open()
for seq in range(100_000):
    frame = new_frame(seq)
    recorder.frame(frame)
    recorder.prepared(frame)
    recorder.shown(Shown(frame, frame.image, 1))
    while recorder.recorded.frames < seq:
        pass
    print(recorder.recorded.frames, flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=_root())
    assert process.stdout is not None
    written = 0
    for line in process.stdout:
        written = int(line)
        if written >= 25:
            break
    os.kill(process.pid, signal.SIGKILL)
    process.stdout.close()
    process.wait()
    frames = frames_of(tmp_path)
    assert [frame.seq for frame in frames] == list(range(len(frames)))
    assert len(frames) >= written - 1  # FFmpeg keeps the newest picture until the next one
    assert all(same_frame(frame, new_frame(frame.seq)) for frame in frames)
    recording = open_recording(tmp_path / "s")
    assert any("has no end" in note or "is cut off" in note for note in recording.notes)
    assert len(list(recording)) == len(frames)


def test_recorder_counts_frame_with_invalid_pose_as_lost(tmp_path):
    pose = np.full((4, 4), np.nan)
    recorder = recorder_in(tmp_path)
    recorder.frame(new_frame(0))
    recorder.frame(new_frame(1, pose=pose))
    recorder.frame(new_frame(2))
    recorder.close()
    assert [frame.seq for frame in frames_of(tmp_path)] == [0, 2]
    assert recorder.recorded.lost == {"frame: no recording can hold it": 1}
    (line,) = (line for _, line in SessionReader(tmp_path / "s").lines() if isinstance(line, LostLine))
    assert line.seq == 1 and "pose" in line.why


def test_recorder_close_raises_error_of_writer_thread(tmp_path, monkeypatch):
    def broken(self, frame):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(SessionWriter, "frame", broken)
    recorder = recorder_in(tmp_path)
    recorder.frame(new_frame(0))
    with pytest.raises(ZeroDivisionError):
        recorder.close()
    recorder.close()


def test_recorder_close_gives_up_on_unresponsive_disk(tmp_path, gate, monkeypatch):
    monkeypatch.setattr(session_recorder, "CLOSE_S", 0.2)
    recorder = recorder_in(tmp_path)
    recorder.frame(new_frame(0))
    recorder.close()
    assert recorder.recorded.ended is not None and "does not answer" in recorder.recorded.ended


def test_recorder_close_waits_for_slow_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(session_recorder, "CLOSE_S", 3.0)
    written = SessionWriter.frame

    def slow(self, frame):
        time.sleep(0.25)
        written(self, frame)

    monkeypatch.setattr(SessionWriter, "frame", slow)
    recorder = recorder_in(tmp_path)
    for seq in range(16):
        recorder.frame(new_frame(seq))
    recorder.close()
    assert (recorder.recorded.frames, recorder.recorded.ended) == (16, None)


def test_recorder_refuses_folder_that_holds_recording(tmp_path):
    recorder_in(tmp_path).close()
    with pytest.raises(OutputError, match="already holds a recording"):
        recorder_in(tmp_path)


def recorder_of(folder, reserve=None):
    return SessionRecorder(folder, session_info(), reserve=reserve)


def test_recorder_open_on_full_disk_fails_without_leftovers(tmp_path):
    full = StorageReserve(tmp_path, lambda: 2**62)
    (tmp_path / "out").mkdir()
    for folder in (tmp_path / "out" / "recordings" / "s", tmp_path / "s", tmp_path / "out" / "s"):
        with pytest.raises(StorageFull):
            recorder_of(folder, full).open()
    assert [path.name for path in tmp_path.rglob("*")] == ["out"], "folders that were there before stay"


def test_failed_recorder_open_keeps_earlier_recordings(tmp_path, monkeypatch):
    (tmp_path / "recordings" / "earlier").mkdir(parents=True)

    def begun(folder, *_):
        (folder / "segments").mkdir()
        (folder / "session.json").write_text("{")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("operators.sinks.session_recorder.SessionWriter", begun)
    with pytest.raises(StorageFull):
        recorder_of(tmp_path / "recordings" / "s").open()
    assert [path.name for path in (tmp_path / "recordings").iterdir()] == ["earlier"]
    (tmp_path / "recordings" / "empty").mkdir()
    with pytest.raises(StorageFull):
        recorder_of(tmp_path / "recordings" / "empty").open()
    assert (tmp_path / "recordings" / "empty").is_dir(), "it was there before"


def _root() -> Path:
    return Path(__file__).resolve().parents[3]


def test_recorder_logs_lost_late_depth_at_its_schedule_position(tmp_path, gate):
    recorder = recorder_in(tmp_path, queue_bytes=10_000)
    recorder.frame(new_frame(0))
    recorder.line(Observed(seq=0, steps=1, train=True))
    recorder.depth(new_frame(0, 64, 64))
    recorder.line(Observed(seq=1, steps=1, train=True))
    recorder.depth(new_frame(0))
    gate.set()
    recorder.close()
    assert recorder.recorded.lost == {"depth: writing is too slow": 1}
    events = [(line.event, line.seq) for line in SessionReader(tmp_path / "s").schedule()]
    assert events == [("observe", 0), ("lost", 0), ("observe", 1), ("take_depth", 0)]
