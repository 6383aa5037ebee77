"""A recording that was cut anywhere plays up to there: what is read is what was written, and nothing is raised."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording, validate_recording
from gsplat_core.io.recordings.decoder import whole_clusters
from gsplat_core.io.sessions import SessionReader
from gsplat_core.scene.frames import Frame
from tests.gsplat_core.io.sessions.made import FRAMES, PER_SEGMENT, same_frame

POSITIONS = 8
FILES = [
    f"segments/{segment:06d}/{name}"
    for segment in range(2)
    for name in (
        "log.jsonl",
        "image_24x16.mkv",
        "right_image_24x16.mkv",
        "mask_24x16.mkv",
        "loss_mask_24x16.mkv",
        "depth_24x16.mkv",
        "depth_confidence_24x16.mkv",
        "prepared_loss_mask_24x16.mkv",
        "shown_24x16.mkv",
    )
]
OF_FRAMES = [name for name in FILES if "prepared" not in name and "shown" not in name]


def read(folder: Path) -> list[Frame]:
    return [frame for _, frame in SessionReader(folder).frames() if frame is not None]


def plays(folder: Path, frames: list[Frame]) -> list[int]:
    """The numbers of the frames that are read; each must be as it was written."""
    found = read(folder)
    for frame in found:
        assert same_frame(frame, frames[frame.seq]), frame.seq
    return [frame.seq for frame in found]


def whole_before(path: Path, at: int) -> int:
    """Return the number of pictures or lines of a file that end before a byte."""
    if path.suffix == ".jsonl":
        return path.read_bytes()[:at].count(b'"event":"frame"')
    with path.open("rb") as file:
        return sum(
            cluster.intact and cluster.end <= at
            for cluster in whole_clusters(file, path.stat().st_size, check_sums=True)
        )


def test_session_fixture_has_expected_files_and_segments(session, frames):
    assert sorted(str(path.relative_to(session)) for path in session.rglob("*.*") if path.is_file()) == sorted(
        [*FILES, "session.json"]
    )
    assert plays(session, frames) == list(range(FRAMES))
    lines = [line for line in (session / FILES[0]).read_text().splitlines() if '"event":"frame"' in line]
    assert len(lines) == PER_SEGMENT


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_session_file_cut_anywhere_plays_up_to_cut(name, session, frames, tmp_path):
    size = (session / name).stat().st_size
    rng = np.random.default_rng(len(name))
    ends = {0, 1, size - 1, *map(int, rng.integers(0, size, POSITIONS))}
    for at in sorted(ends):
        folder = tmp_path / str(at)
        shutil.copytree(session, folder)
        with (folder / name).open("r+b") as file:
            file.truncate(at)
        seqs = plays(folder, frames)
        first = PER_SEGMENT * int("000001" in name)
        others = [seq for seq in range(FRAMES) if not first <= seq < first + PER_SEGMENT]
        count = whole_before(session / name, at) if name in OF_FRAMES else PER_SEGMENT
        here = [seq for seq in seqs if seq not in others]
        assert [seq for seq in seqs if seq in others] == others
        assert here == list(range(first, first + len(here)))
        assert len(here) in (count, max(0, count - 1)), f"cut at byte {at}: {len(here)} frames, {count} are whole"
        assert list(SessionReader(folder).lines()) is not None
        shutil.rmtree(folder)


@pytest.mark.parametrize("name", FILES)
def test_session_file_ending_in_zeros_plays_up_to_zeros(name, session, frames, tmp_path):
    """After a power failure a file may have its length and not its last bytes."""
    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    log = folder / name.rsplit("/", 1)[0] / "log.jsonl"
    if log.name not in name:  # and the segment's end was not written either
        log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:-1]))
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    (folder / name).write_bytes(data)
    seqs = plays(folder, frames)
    assert set(range(FRAMES)) > set(seqs) if name in OF_FRAMES else seqs == list(range(FRAMES))
    assert len(seqs) > PER_SEGMENT


@pytest.mark.parametrize("name", FILES)
def test_missing_session_file_drops_frames_of_segment(name, session, frames, tmp_path):
    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    (folder / name).unlink()
    seqs = plays(folder, frames)
    assert len(seqs) == (FRAMES - PER_SEGMENT if name in OF_FRAMES else FRAMES)


def test_truncated_session_json_is_refused(session, tmp_path):
    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    data = (folder / "session.json").read_bytes()
    for at in (0, 1, 10, len(data) // 2, len(data) - 4):
        (folder / "session.json").write_bytes(data[:at])
        report = validate_recording(folder)
        assert [str(problem).count("session.json") for problem in report.problems] == [1]
        assert str(report.problems[0]).endswith(". Copy the session again from its source.")
        with pytest.raises(RecordingInvalid, match=r"session\.json"):
            open_recording(folder)
        assert not validate_recording(folder).ok


def test_truncated_session_opens_with_note(session, tmp_path):
    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    path = folder / "segments/000001/mask_24x16.mkv"
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)
    recording = open_recording(folder)
    assert PER_SEGMENT < recording.frame_count < FRAMES
    assert len(list(recording)) == recording.frame_count
    (note,) = recording.notes
    assert "segment 000001 is cut off" in note
    assert validate_recording(folder).ok


def test_unfinished_session_can_be_read(record, frames):
    folder = record(frames, close=False)
    seqs = plays(folder, frames)
    assert seqs in (list(range(FRAMES)), list(range(FRAMES - 1)))  # FFmpeg keeps the newest picture until the next one
