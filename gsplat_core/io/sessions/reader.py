"""Reader of a session's recording: its log lines in order, and the received frames.

Session recording as an ordinary recording of its received frames, for replay and evaluation.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.frame_codec import camera_of, frame_from
from gsplat_core.io.recordings.calibration import Calibration, default_calibration
from gsplat_core.io.recordings.contents import digest_of
from gsplat_core.io.recordings.decoder import NO_PICTURE
from gsplat_core.io.recordings.plain_files import Findings, printable
from gsplat_core.io.sessions.records import (
    COPY_AGAIN,
    SCHEDULE_LINES,
    SEGMENTS_FOLDER,
    SESSION_FILE,
    DepthTaken,
    FrameLine,
    Line,
    LostLine,
    PreparedLine,
    ReconstructorMade,
    ScheduleLine,
    ShownLine,
    read_session_file,
)
from gsplat_core.io.sessions.segments import FIELDS, SegmentPictures, SegmentReader, mask_of_nothing
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame, FrameStatus

MOST_ARRIVED = 64
"""Maximum number of received frames kept while reading, until the log has their lines as prepared for training."""
_SEGMENT = re.compile(r"\d{6,9}")


def is_session(folder: Path) -> bool:
    """Return True if the folder contains a recorded session."""
    return (folder / SESSION_FILE).is_file()


class SessionReader:
    """Reader of the intact part of a recorded session; a truncated file ends its segment early.

    Opening reads all logs and indexes the tracks without decoding.

    Raises:
        RecordingInvalid: if `session.json` is missing or invalid, or the folder of segments cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = read_session_file(folder)
        self.segments: list[SegmentReader] = []
        last = -1
        for path in _segment_folders(folder):
            self.segments.append(SegmentReader(path, last))
            last = self.segments[-1].seqs[-1] if self.segments[-1].seqs else last
        playable = [segment for segment in self.segments if segment.seqs]
        self.first = playable[0].first if playable else None
        """Log line of the first readable frame."""
        self.fields = frozenset(FIELDS).intersection(*(segment.fields for segment in playable))
        """Optional fields that every readable frame has."""
        self.notes: list[str] = []
        """Sentences for the user about missing or damaged parts of the recording."""
        self._take_notes()

    @property
    def frame_count(self) -> int:
        """Number of readable frames."""
        return sum(len(segment.seqs) for segment in self.segments)

    def lines(self) -> Iterator[tuple[SegmentReader, Line]]:
        """Yield every line of every segment in order, with its segment."""
        for segment in self.segments:
            for line in segment.lines():
                yield segment, line

    def frame_lines(self) -> Iterator[FrameLine]:
        """Yield the lines of the readable frames."""
        for segment in self.segments:
            yield from _of(segment)

    def frames(self) -> Iterator[tuple[FrameLine, Frame | None]]:
        """Yield the received frames in order, each with its log line.

        A damaged frame has the status `DAMAGED`. The frame is None if its image cannot be decoded at all.
        """
        for segment in self.segments:
            with segment.open() as pictures:
                for line in _of(segment):
                    yield line, frame_of(line, pictures)

    def prepared(self) -> Iterator[Frame]:
        """Yield the frames as passed to training, in order; unreadable ones are skipped."""
        arrived: OrderedDict[int, Frame] = OrderedDict()
        for segment in self.segments:
            there = set(segment.seqs)
            with segment.open() as pictures:
                for line in segment.lines():
                    if isinstance(line, FrameLine) and line.seq in there:
                        there.discard(line.seq)
                        frame = frame_of(line, pictures)
                        if frame is not None:
                            arrived[line.seq] = frame
                        while len(arrived) > MOST_ARRIVED:
                            arrived.popitem(last=False)
                    elif isinstance(line, PreparedLine) and line.seq in arrived and segment.there(line):
                        prepared = prepared_of(line, arrived.pop(line.seq), pictures)
                        if prepared is not None:
                            yield prepared

    @property
    def prepared_count(self) -> int:
        """Number of frames that `prepared` yields if no picture proves damaged."""
        count = 0
        arrived: set[int] = set()
        for segment in self.segments:
            arrived.update(segment.seqs)
            for line in segment.lines():
                if isinstance(line, PreparedLine) and line.seq in arrived and segment.there(line):
                    arrived.discard(line.seq)
                    count += 1
        return count

    def schedule(self) -> Iterator[ScheduleLine | LostLine]:
        """Yield the training schedule in order, including markers of lost depth at their position."""
        for _, line in self.lines():
            if isinstance(line, SCHEDULE_LINES) or (isinstance(line, LostLine) and line.what == "depth"):
                yield line

    def late_depths(self) -> Iterator[dict[str, Any] | None]:
        """Yield the fields of each `take_depth` line (depth that arrived after its frame) by name; None if its pictures
        are unreadable.
        """
        for segment in self.segments:
            with segment.open() as pictures:
                for line in segment.lines():
                    if isinstance(line, DepthTaken):
                        yield late_depth_of(line, pictures) if segment.there(line) else None

    def digests(self) -> Iterator[ShownLine]:
        """Yield the log lines of newly displayed pictures, which have digests, in order."""
        return (line for _, line in self.lines() if isinstance(line, ShownLine) and line.sha256 is not None)

    @property
    def made(self) -> ReconstructorMade | None:
        """Return the log line with the settings of the session's first reconstructor.

        None if the line, or any data before it, has been deleted.
        """
        if not self.segments or int(self.segments[0].folder.name) != 0:
            return None
        return next((line for line in self.segments[0].lines() if isinstance(line, ReconstructorMade)), None)

    def files(self) -> list[Path]:
        """Return the paths of all files of the session that are read, sorted."""
        return [self.folder / SESSION_FILE, *(path for segment in self.segments for path in segment.files())]

    def _take_notes(self) -> None:
        if not self.segments:
            self.notes.append("the session has no segment: nothing was recorded")
        for segment in self.segments:
            name = printable(segment.folder.name)
            if segment.begins is None:
                self.notes.append(f"segment {name} cannot be read: its log is cut off at its beginning")
            elif len(segment.seqs) < segment.named:
                self.notes.append(
                    f"segment {name} is cut off: {len(segment.seqs)} of the {segment.named} frames that it names are there"
                )
            elif segment.ends is None:
                self.notes.append(
                    f"segment {name} has no end: the program that recorded it was ended, or its log is damaged; it has {len(segment.seqs)} frames"
                )
        first = self.segments[0] if self.segments else None
        if first is not None and first.folder.name != "000000":
            self.notes.append(f"the recording begins with segment {first.folder.name}: those before it were removed")


def _of(segment: SegmentReader) -> Iterator[FrameLine]:
    """Yield the log lines of a segment's readable frames; lines that repeat a sequence number are skipped."""
    wanted = iter(segment.seqs)
    due = next(wanted, None)
    for line in segment.lines():
        if isinstance(line, FrameLine) and line.seq == due:
            yield line
            due = next(wanted, None)


def frame_of(line: FrameLine, pictures: SegmentPictures) -> Frame | None:
    """Return the frame that a line of a segment's log describes.

    The frame is marked damaged if one of its pictures cannot be decoded. None if its colour image is missing.
    """
    planes, damage = pictures.of(line)
    return _frame(line, planes, line.damage or damage)


def prepared_of(line: PreparedLine, arrived: Frame, pictures: SegmentPictures) -> Frame | None:
    """Return the frame as passed to training.

    The frame is damaged if the received frame or one of its own planes is. None without any image.
    """
    planes, damage = pictures.of(line)
    for track in line.same:
        plane = getattr(arrived, track, None)
        if plane is not None:
            planes[track] = plane
    if line.status is not FrameStatus.DAMAGED and arrived.status is FrameStatus.DAMAGED:
        damage = damage or arrived.damage
    return _frame(line, planes, line.damage or damage)


def late_depth_of(line: DepthTaken, pictures: SegmentPictures) -> dict[str, Any] | None:
    """Return the fields of a depth map that arrived after its frame, from its log line; None if it cannot be decoded completely."""
    planes, damage = pictures.of(line)
    if damage is not None or "depth" not in planes:
        return None
    confidence, origin = planes.get("depth_confidence"), DEPTH_ORIGINS[line.origin]
    return {"depth": planes["depth"], "depth_confidence": confidence, "depth_origin": origin, "depth_error": line.error}


def _frame(line: FrameLine | PreparedLine, planes: dict[str, NDArray[Any]], damage: str | None) -> Frame | None:
    image = planes.get("image")
    if image is None:
        return None
    status = FrameStatus.REPLAY if line.status is FrameStatus.LIVE else line.status
    if damage is not None and damage != line.damage:
        # The pictures were damaged after they were recorded, so no pixel is known to be tissue.
        status, planes = FrameStatus.DAMAGED, {**planes, "mask": mask_of_nothing(*image.shape[:2])}
    if line.pose is not None:
        planes = {**planes, "pose": np.array(line.pose).reshape(4, 4)}
    try:
        return frame_from(line.seq, line.pts_ns, line, planes, status=status, damage=damage, arrived_ns=None)
    except InvalidInput as error:
        raise RecordingInvalid(f"frame {line.seq} of the session cannot be one: {error}") from error


def _segment_folders(folder: Path) -> list[Path]:
    """Return the segment folders in order, excluding links."""
    segments = folder / SEGMENTS_FOLDER
    if not segments.is_dir() or segments.is_symlink():
        return []
    try:
        found = [path for path in segments.iterdir() if _SEGMENT.fullmatch(path.name)]
    except OSError as error:
        raise RecordingInvalid(
            f"{printable(segments)}: it cannot be read: {error.strerror}. Check its permissions."
        ) from error
    return sorted((path for path in found if path.is_dir() and not path.is_symlink()), key=lambda path: int(path.name))


_ADVICE = "What can be read is played"


@dataclass(frozen=True)
class SessionImages:
    """Number of a session's frames, and their picture size."""

    frame_count: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class SessionContents:
    """Contents of a session; counterpart of `Contents` for other layouts.

    A recording has a single picture size. Frames of another size than the first one are skipped.
    """

    root: Path
    reader: SessionReader
    images: SessionImages
    calibration: Calibration
    fps: float
    fields: frozenset[str]
    layout: str = "session"
    tool_share: float | None = None
    stereo_baseline_mm: float | None = None

    def frames(self, findings: Findings, limit: int | None = None) -> Generator[Frame | None, None, None]:
        """Yield the frames in order, with their numbers and times in the session; None after a problem."""
        yield from islice(self._frames(findings), limit)

    def _frames(self, findings: Findings) -> Iterator[Frame | None]:
        last: Frame | None = None
        for line, decoded in self.reader.frames():
            if not self._fits(line):
                continue
            frame = decoded
            if frame is None and last is not None:
                nothing = np.zeros(last.image.shape[:2], np.uint8)
                frame = last.with_fields(
                    seq=line.seq, pts_ns=line.pts_ns, status=FrameStatus.DAMAGED, damage=NO_PICTURE, mask=nothing
                )
            if frame is None:
                findings.problem(
                    self.root, f"the image of frame {line.seq} cannot be decoded", "Copy the session again"
                )
            else:
                last = frame
            yield frame

    def files(self) -> list[Path]:
        """Return the paths of all files of the session that are read."""
        return self.reader.files()

    def digest(self) -> str:
        """Return the digest of all files; see `digest_of`."""
        return digest_of(self.root, self.files())

    def _fits(self, line: FrameLine) -> bool:
        return (line.width_px, line.height_px) == (self.images.width_px, self.images.height_px)


def session_contents(path: Path, findings: Findings) -> SessionContents | None:
    """Open the recording of a session; None after a problem."""
    try:
        reader = SessionReader(path)
    except RecordingInvalid as error:
        file = path / SESSION_FILE
        what = str(error).removeprefix(f"{printable(file)}: ").removesuffix(f". {COPY_AGAIN}.")
        findings.problem(file, what, COPY_AGAIN)
        return None
    for note in reader.notes:
        findings.warn(path, note, _ADVICE)
    first = reader.first
    if first is None:
        findings.problem(path, "no frame of the session can be read", "Copy it again from its source")
        return None
    size = first.width_px, first.height_px
    count, others, poses = _of_size(reader, size)
    if others:
        findings.warn(
            path,
            f"{others} of {count + others} frames have another size than the first one, {size[0]}x{size[1]} px",
            "They are left out",
        )
    camera = camera_of(reader.info.camera)
    calibration = Calibration(camera, None, SESSION_FILE)
    if (camera.width_px, camera.height_px) != size:
        calibration = default_calibration(path, *size, findings)
    if poses is not None:
        calibration = replace(calibration, poses=poses, camera=calibration.camera.with_pose(poses[0]))
    return SessionContents(
        root=path,
        reader=reader,
        images=SessionImages(count, *size),
        calibration=calibration,
        fps=reader.info.fps,
        fields=frozenset(reader.fields),
    )


def _of_size(reader: SessionReader, size: tuple[int, int]) -> tuple[int, int, NDArray[np.float64] | None]:
    """Return the numbers of frames with and without this size, and the poses [N, 4, 4].

    The poses are None unless every frame of this size has one.
    """
    poses: list[NDArray[np.float64]] = []
    count = others = 0
    for line in reader.frame_lines():
        if (line.width_px, line.height_px) != size:
            others += 1
            continue
        count += 1
        if line.pose is not None:
            poses.append(np.array(line.pose).reshape(4, 4))
    return count, others, np.stack(poses) if len(poses) == count else None
