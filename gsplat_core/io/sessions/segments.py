"""Segments of a session's recording: a folder with a log, and a Matroska file with checksums per track and size.

Each picture of a track has its own cluster. Pictures are coded losslessly with FFV1 (RFC 9043), or with VP9 for viewing. The
reader of a track indexes the complete pictures, then decodes requested ones in order. A segment truncated by a crash is
readable as far as its files are complete.
"""

from __future__ import annotations

import io
import os
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, Literal, cast

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.frame_codec import Record
from gsplat_core.io.recordings.decoder import Container, PictureDecoder, captured_log, whole_clusters
from gsplat_core.io.recordings.plain_files import MAX_PIXELS, UnreadableFile, open_plain
from gsplat_core.io.recordings.video import open_container
from gsplat_core.io.sessions.records import (
    LOG_FILE,
    DepthTaken,
    FrameLine,
    Line,
    LogWriter,
    PreparedLine,
    SegmentBegins,
    SegmentEnds,
    ShownLine,
    read_log,
)

Stage = Literal["", "prepared_", "late_"]
"""Name prefix of a track file that states at which stage of the pipeline its pictures were recorded.

"" marks received and displayed pictures, "prepared_" those passed to training, and "late_" depth
passed to training later.
"""
MOST_FILES = 64
"""Maximum number of track files of a segment; if another one is needed, a new segment is started."""


def track_file(stage: str, track: str, height_px: int, width_px: int) -> str:
    """Return the file name of a track."""
    return f"{stage}{track}_{width_px}x{height_px}.mkv"


class SegmentWriter:
    """Writer of one segment; pictures are written before the line that names them.

    Methods raise OSError and av.FFmpegError.
    """

    def __init__(self, folder: Path, begins: SegmentBegins, *, fps: float) -> None:
        """Create the segment's folder and log."""
        folder.mkdir()
        self.folder = folder
        self.number, self.begun_ns = begins.number, begins.monotonic_ns
        self.frames = 0
        self._fps = fps
        self._tracks: dict[str, TrackWriter] = {}
        self._start_ns: int | None = None
        self._closed = False
        self._log = LogWriter(folder / LOG_FILE)
        self._log.write(begins)

    @property
    def bytes(self) -> int:
        """Current size of the segment on disk in bytes."""
        return self._log.bytes + sum(track.bytes for track in self._tracks.values())

    @property
    def full(self) -> bool:
        """True if the segment has the maximum number of track files. A track or picture size that it does not have yet
        then needs a new segment.
        """
        return len(self._tracks) >= MOST_FILES

    def picture(self, stage: Stage, track: str, picture: NDArray[Any], pts_ns: int) -> int:
        """Append a picture to a track and return its timestamp in the file in milliseconds.

        `stage` is the name prefix of the track's file: received or displayed (""), prepared for training, or late.
        """
        if self._start_ns is None:
            self._start_ns = pts_ns
        height, width = picture.shape[:2]
        name = track_file(stage, track, height, width)
        if name not in self._tracks:
            self._tracks[name] = TrackWriter(self.folder / name, CODINGS[track], height, width, self._fps)
        return self._tracks[name].write(picture, (pts_ns - self._start_ns) // 1_000_000)

    def line(self, line: Record) -> None:
        """Append a line to the log."""
        self._log.write(line)
        self.frames += isinstance(line, FrameLine)

    def sync(self) -> None:
        """Sync everything to disk, pictures before the lines that name them."""
        for track in self._tracks.values():
            track.sync()
        self._log.sync()

    def close(self, why: str) -> None:
        """Finish all files. The log is closed last, because its final line marks the tracks as complete."""
        for track in self._tracks.values():
            track.close()
        self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.sync()
        self._log.close()
        self._closed = True

    def abandon(self, why: str) -> None:
        """Close the files after an error, without encoding the last pictures and without syncing to disk.

        `why` is written to the last line of the segment's log if possible. Without effect after `close`.
        """
        if self._closed:
            return
        self._closed = True
        for track in self._tracks.values():
            track.abandon()
        with suppress(OSError):  # a failing disk is the usual reason for abandoning
            self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.close()


PictureLine = FrameLine | PreparedLine | ShownLine | DepthTaken
"""Log lines that refer to pictures in tracks."""
FIELDS = ("right_image", "mask", "depth", "pose")
MOST_OPEN = 128
"""Maximum number of files of a segment; a log that names more is invalid."""


class SegmentReader:
    """Reader of a segment's lines and pictures."""

    def __init__(self, folder: Path, after_seq: int = -1) -> None:
        """Open a segment; `after_seq` is the last frame number of the previous segments."""
        self.folder = folder
        self.begins: SegmentBegins | None = None
        self.ends: SegmentEnds | None = None
        """Last line of the log; None if the log is truncated or still being written."""
        self.named = 0
        """Number of received frames in the log, whether or not their pictures are readable."""
        self.seqs = array("q")
        """Sequence numbers of the readable frames, in order."""
        self.first: FrameLine | None = None
        """Line of the first readable frame."""
        self.fields = frozenset(FIELDS)
        """Names of the optional frame fields that all readable frames of the segment have."""
        self._indices: dict[str, TrackIndex | None] = {}
        self._poll(after_seq)

    def lines(self) -> Iterator[Line]:
        """Yield the readable lines in order."""
        if self.folder.joinpath(LOG_FILE).is_symlink():
            return
        try:
            yield from read_log(self.folder / LOG_FILE)
        except (UnreadableFile, OSError):
            return  # a log that cannot be read counts as ending here, like a truncated one

    def there(self, line: PictureLine) -> bool:
        """Return True if all pictures that a log line refers to are complete in their track files."""
        return all(
            (index := self._index(_file(line, track))) is not None and time in index
            for track, time in line.tracks.items()
        )

    def open(self) -> SegmentPictures:
        """Return a decoder of the segment's pictures for one pass over its log lines."""
        return SegmentPictures(self._indices, self.folder)

    def files(self) -> list[Path]:
        """Return the paths of the segment's log and track files that are read."""
        return sorted([self.folder / LOG_FILE, *(index.path for index in self._indices.values() if index is not None)])

    def _poll(self, after_seq: int) -> None:
        """Read the log once to find its last line, its track files, and the frames whose pictures are complete."""
        lines = self.lines()
        first = next(lines, None)
        if not isinstance(first, SegmentBegins):
            return
        self.begins = first
        last: Line = first
        named: set[str] = set()
        frames: list[FrameLine] = []
        for last in lines:
            if isinstance(last, PictureLine):
                named.update(_file(last, track) for track in last.tracks)
                if len(named) > MOST_OPEN:
                    break
                if isinstance(last, FrameLine):
                    frames.append(last)
        self.named = len(frames)
        self.ends = last if isinstance(last, SegmentEnds) else None
        for name in sorted(named)[:MOST_OPEN]:
            try:
                # Verify checksums only in an incomplete segment. A complete one was synced to disk before its last log line.
                self._indices[name] = TrackIndex(self.folder / name, check_sums=self.ends is None)
            except (UnreadableFile, OSError):
                self._indices[name] = None
        self._find_frames(frames, after_seq)

    def _find_frames(self, frames: list[FrameLine], after_seq: int) -> None:
        for line in frames:
            if line.seq <= after_seq or "image" not in line.tracks or line.height_px * line.width_px > MAX_PIXELS:
                continue
            if not self.there(line):
                break  # the pictures of later frames are incomplete as well
            after_seq = line.seq
            self.seqs.append(line.seq)
            self.first = self.first or line
            self.fields &= {*line.tracks, *(["pose"] if line.pose is not None else [])}

    def _index(self, name: str) -> TrackIndex | None:
        return self._indices.get(name)


class SegmentPictures:
    """Decoder of a segment's pictures, as a context manager; request them in line order."""

    def __init__(self, indices: dict[str, TrackIndex | None], folder: Path) -> None:
        self._indices, self._folder = indices, folder
        self._open = ExitStack()
        self._readers: dict[str, TrackReader] = {}

    def __enter__(self) -> SegmentPictures:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        self._readers.clear()

    def of(self, line: PictureLine) -> tuple[dict[str, NDArray[Any]], str | None]:
        """Decode the pictures of a line.

        Returns:
            Pictures by track, without unreadable ones, and the first damage or None.
        """
        pictures: dict[str, NDArray[Any]] = {}
        damage: str | None = None
        for track, time in line.tracks.items():
            name = _file(line, track)
            try:
                picture, wrong = self._reader(name, track, line).picture(time)
            except (UnreadableFile, OSError, av.FFmpegError) as error:
                picture, wrong = None, str(error) or type(error).__name__
            if picture is not None:
                pictures[track] = picture
            if wrong is not None:
                damage = damage or f"{name}: {wrong}"
        return pictures, damage

    def _reader(self, name: str, track: str, line: PictureLine) -> TrackReader:
        if name not in self._readers:
            index = self._indices.get(name)
            if index is None:
                raise UnreadableFile("the file is not there")
            self._readers[name] = TrackReader(index, track, line.height_px, line.width_px)
            self._open.callback(self._readers[name].close)
        return self._readers[name]


def _file(line: PictureLine, track: str) -> str:
    stage: Stage = ""
    if isinstance(line, PreparedLine | DepthTaken):
        stage = "prepared_" if isinstance(line, PreparedLine) else "late_"
    return track_file(stage, track, line.height_px, line.width_px)


def mask_of_nothing(height_px: int, width_px: int) -> NDArray[np.uint8]:
    """Return a tissue mask of zeros [H, W] for a damaged frame."""
    return np.zeros((height_px, width_px), np.uint8)


Coding = Literal["colour", "grey", "float", "vp9"]
CODINGS: Mapping[str, Coding] = {
    "image": "colour",
    "right_image": "colour",
    "mask": "grey",
    "loss_mask": "grey",
    "depth": "float",
    "depth_confidence": "float",
    "shown": "vp9",
}
"""Video coding of a track's pictures, by track: the name of a picture field of `Frame`, or `shown` for displayed pictures."""
PIXEL_FORMATS: Mapping[Coding, str] = {"colour": "bgr0", "grey": "gray", "float": "gray", "vp9": "yuv420p"}
ENCODERS: Mapping[Coding, str] = {"colour": "ffv1", "grey": "ffv1", "float": "ffv1", "vp9": "libvpx-vp9"}
_VP9 = {
    "deadline": "realtime",
    "cpu-used": "8",
    "lag-in-frames": "0",
    "row-mt": "1",
    "tile-columns": "2",
    "crf": "24",
    "b": "0",
}
_FLOAT_BYTES = 4


def encoder_options(coding: Coding, height_px: int, width_px: int) -> dict[str, str]:
    """Return encoder options for a coding and picture size."""
    if coding == "vp9":
        return _VP9
    # Four slices limit the damage of a flipped bit. Tiny pictures cannot be split into four.
    slices = "4" if min(height_px, width_px) >= 8 else "1"
    return {"level": "3", "slices": slices, "slicecrc": "1", "g": "1"}


def coded_size(coding: Coding, height_px: int, width_px: int) -> tuple[int, int]:
    """Return height and width of the coded video, which can exceed those of a picture [height_px, width_px]."""
    if coding == "vp9":
        return height_px + height_px % 2, width_px + width_px % 2
    return (_FLOAT_BYTES * height_px if coding == "float" else height_px), width_px


def encoded(coding: Coding, picture: NDArray[Any]) -> av.VideoFrame:
    """Convert a picture to the encoder's pixel format.

    Raises:
        InvalidInput: if the array does not fit the coding.
    """
    if coding == "colour":
        _require(picture, np.uint8, 3)
        frame = av.VideoFrame(picture.shape[1], picture.shape[0], "bgr0")
        cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA, dst=_pixels(frame, 4))
        return frame
    if coding == "vp9":
        _require(picture, np.uint8, 3)
        height, width = coded_size(coding, *picture.shape[:2])
        padding = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
        even = np.pad(picture, padding, mode="edge") if any(map(any, padding)) else picture
        planes = np.asarray(cv2.cvtColor(even, cv2.COLOR_RGB2YUV_I420), np.uint8)
        return av.VideoFrame.from_ndarray(planes, format="yuv420p")
    _require(picture, np.uint8 if coding == "grey" else np.float32, 2)
    if coding == "float":
        height, width = picture.shape
        parts = np.ascontiguousarray(picture, "<f4").view(np.uint8).reshape(height, width, _FLOAT_BYTES)
        picture = parts.transpose(2, 0, 1).reshape(_FLOAT_BYTES * height, width)
    frame = av.VideoFrame(picture.shape[1], picture.shape[0], "gray")
    np.copyto(_pixels(frame, 1)[..., 0], picture)
    return frame


def decoded(coding: Coding, frame: av.VideoFrame, height_px: int, width_px: int) -> NDArray[Any] | None:
    """Decode a picture [height_px, width_px]; None if the frame does not fit the coding or size."""
    if frame.format.name != PIXEL_FORMATS[coding] or (frame.height, frame.width) != coded_size(
        coding, height_px, width_px
    ):
        return None
    if coding == "colour":
        return np.asarray(cv2.cvtColor(_pixels(frame, 4), cv2.COLOR_BGRA2RGB), np.uint8)
    if coding == "vp9":
        planes = frame.to_ndarray(format="yuv420p")
        picture = np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420), np.uint8)
        return np.ascontiguousarray(picture[:height_px, :width_px])
    grey = _pixels(frame, 1)[..., 0]
    if coding == "grey":
        return grey.copy()
    parts = grey.reshape(_FLOAT_BYTES, height_px, width_px).transpose(1, 2, 0)
    return np.ascontiguousarray(parts).view("<f4").reshape(height_px, width_px).astype(np.float32, copy=False)


def _require(picture: NDArray[Any], dtype: type, dimensions: int) -> None:
    fits = picture.ndim == dimensions and picture.dtype == dtype and (dimensions == 2 or picture.shape[2] == 3)
    if not fits or 0 in picture.shape:
        raise InvalidInput(f"cannot record a picture {list(picture.shape)} of {picture.dtype}")


def _pixels(frame: av.VideoFrame, channels: int) -> NDArray[np.uint8]:
    """Return the first plane [H, W, channels] as a view of the frame's memory."""
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8)[: plane.line_size * frame.height].reshape(
        frame.height, plane.line_size
    )
    return rows[:, : channels * frame.width].reshape(frame.height, frame.width, channels)


MOST_MS_AHEAD = 3_600_000
"""Largest timestamp step in ms; later clock jumps are clamped. The log has the true times."""
_MS = Fraction(1, 1000)
_MUXER = {
    # Each packet is written as a separate cluster with a CRC-32, so a truncated file loses only
    # the data after the cut. FFmpeg writes a cluster when the next one begins, so one picture is
    # always pending.
    "flush_packets": "1",
    "cluster_time_limit": "0",
}


class TrackWriter:
    """Encoder of pictures into a new file.

    Methods raise OSError and av.FFmpegError. After an error only `abandon` may be called.
    """

    def __init__(self, path: Path, coding: Coding, height_px: int, width_px: int, fps: float) -> None:
        self.path, self.coding = path, coding
        self.bytes = 0
        """Total size of the encoded pictures in bytes, without the container's headers and index."""
        self._last_ms = -1
        self._file = path.open("xb", buffering=0)
        self._container = av.open(self._file, mode="w", format="matroska", options=_MUXER)
        height, width = coded_size(coding, height_px, width_px)
        options = encoder_options(coding, height, width)
        rate = Fraction(fps).limit_denominator(1001) or Fraction(30)
        self._stream = cast(av.VideoStream, self._container.add_stream(ENCODERS[coding], rate=rate, options=options))
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = PIXEL_FORMATS[coding]
        context = self._stream.codec_context
        context.time_base = _MS
        # Use one thread, so that encoding does not take processor time from the pipeline's other operators.
        context.thread_count = 1
        if coding == "vp9":
            context.gop_size = max(1, round(2 * fps))
            context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.SMPTE170M
        context.open()

    def write(self, picture: NDArray[Any], wanted_ms: int) -> int:
        """Append a picture.

        Args:
            picture: picture in the track's coding.
            wanted_ms: requested timestamp.

        Returns:
            Timestamp in the file in milliseconds: `wanted_ms`, adjusted to exceed the previous one by at most
            `MOST_MS_AHEAD`.
        """
        frame = encoded(self.coding, np.ascontiguousarray(picture))
        self._last_ms += min(max(1, wanted_ms - self._last_ms), MOST_MS_AHEAD)
        frame.pts, frame.time_base = self._last_ms, _MS
        self._mux(frame)
        return self._last_ms

    def sync(self) -> None:
        """Force written data to the disk."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Write the last picture, index and duration, and sync the file to disk."""
        self._mux(None)
        self._container.close()
        self.sync()
        self._file.close()

    def abandon(self) -> None:
        """Close the file after an error.

        Unlike `close`, this neither encodes the last picture nor syncs the file to disk, and ignores errors of the container.
        """
        with suppress(OSError, av.FFmpegError):  # closing a file that failed before may fail again
            self._container.close()
        self._file.close()

    def _mux(self, frame: av.VideoFrame | None) -> None:
        for packet in self._stream.encode(frame):
            self.bytes += packet.size
            self._container.mux(packet)


_CODECS = ("ffv1", "vp9")
_MOST_MS = 2**62
MOST_PICTURES = 1_000_000
"""Maximum number of pictures read from one file.

Corresponds to nine hours at 30 pictures/s; segments last minutes.
"""


class TrackIndex:
    """Index of a track file's decodable pictures: those in complete clusters up to the first bad one."""

    def __init__(self, path: Path, *, check_sums: bool) -> None:
        """Index the clusters of a file.

        Args:
            path: track file.
            check_sums: also stop at the first wrong checksum, which reads the whole file. Otherwise
                such clusters are noticed on decoding.

        Raises:
            UnreadableFile: if the file is a link or not a regular file.
            OSError: if reading fails.
        """
        self.path, self.checked = path, check_sums
        self.end = 0
        self._times = array("q")
        if path.is_symlink():
            raise UnreadableFile("it is a link")
        with open_plain(path) as file:
            size = file.seek(0, io.SEEK_END)
            for cluster in islice(whole_clusters(file, size, check_sums=check_sums), MOST_PICTURES):
                rising = cluster.time < _MOST_MS and (not self._times or cluster.time > self._times[-1])
                # Timestamps that do not rise are damage, because `TrackWriter` writes increasing ones.
                if not cluster.intact or not rising:
                    break
                self._times.append(cluster.time)
                self.end = cluster.end

    def __contains__(self, time_ms: object) -> bool:
        """Return True if a picture with this timestamp exists."""
        assert isinstance(time_ms, int)
        at = bisect_left(self._times, time_ms)
        return at < len(self._times) and self._times[at] == time_ms

    def damaged(self) -> frozenset[int]:
        """Return the timestamps of pictures with a wrong checksum.

        Raises:
            UnreadableFile: if the file is not a regular file.
            OSError: if reading fails.
        """
        if self.checked:
            return frozenset()
        with open_plain(self.path) as file:
            clusters = islice(whole_clusters(file, self.end, check_sums=True), MOST_PICTURES)
            return frozenset(cluster.time for cluster in clusters if not cluster.intact)


class TrackReader:
    """Decoder of a track's pictures; timestamps must be requested in increasing order."""

    def __init__(self, index: TrackIndex, track: str, height_px: int, width_px: int) -> None:
        self._index, self._size = index, (height_px, width_px)
        # In sessions of earlier versions, displayed pictures may be coded without loss.
        self._lossless: Coding = "colour" if track == "shown" else CODINGS[track]
        self._pictures: Iterator[tuple[int, NDArray[Any] | None, str | None]] | None = None
        self._next: tuple[int, NDArray[Any] | None, str | None] | None = None

    def picture(self, time_ms: int) -> tuple[NDArray[Any] | None, str | None]:
        """Decode the picture with this timestamp; timestamps must increase between calls.

        Returns:
            Picture or None, and a description of the damage or None.

        Raises:
            UnreadableFile: if the file is not a regular file.
            OSError: if reading fails.
            av.FFmpegError: if the file cannot be opened as a video.
        """
        if self._pictures is None:
            self._pictures = self._decode()
            self._next = next(self._pictures, None)
        while self._next is not None and self._next[0] < time_ms:
            self._next = next(self._pictures, None)
        if self._next is None or self._next[0] != time_ms:
            return None, "its picture is missing"
        return self._next[1:]

    def close(self) -> None:
        pictures, self._pictures, self._next = self._pictures, None, None
        if pictures is not None:
            pictures.close()  # type: ignore[attr-defined]

    def _decode(self) -> Iterator[tuple[int, NDArray[Any] | None, str | None]]:
        """Yield each picture of the track: its timestamp in ms, the picture or None, and a description of damage or None."""
        with (
            open_plain(self._index.path) as file,
            open_container(_Beginning(file, self._index.end), Container("matroska")) as container,  # type: ignore[arg-type]
        ):
            if len(container.streams) != 1 or len(container.streams.video) != 1:
                raise UnreadableFile(f"it holds {len(container.streams)} streams in place of one video")
            stream = container.streams.video[0]
            context = stream.codec_context
            if context is None or context.codec.canonical_name not in _CODECS:
                raise UnreadableFile("its video is neither FFV1 nor VP9")
            if context.width * context.height > 4 * MAX_PIXELS:
                raise UnreadableFile(f"frames of {context.width}x{context.height} exceed the bound of pixels")
            coding: Coding = "vp9" if context.codec.canonical_name == "vp9" else self._lossless
            decoder, wrong = PictureDecoder(stream), self._index.damaged()
            times: dict[int, int] = {}
            for number, packet in enumerate(_packets(container, stream)):
                if packet is not None:
                    if packet.pts is None or packet.time_base is None:
                        continue
                    times[number] = round(packet.pts * packet.time_base * 1000)
                for own, frame in decoder.decode(packet, number, True):
                    picture = decoded(coding, frame, *self._size)
                    damage = decoder.doubts.pop(own, None) if picture is not None else "it has another size or format"
                    time = times.pop(own)
                    yield time, picture, "the checksum of its part of the file is wrong" if time in wrong else damage
                decoder.doubts.clear()


def _packets(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.Packet | None]:
    """Yield the video packets that have data, then None, which flushes the decoder. An unreadable packet ends the sequence."""
    packets = iter(container.demux(stream))
    while True:
        with captured_log():
            try:
                packet = next(packets, None)
            except av.FFmpegError:
                packet = None
        if packet is None:
            break
        if packet.size:
            yield packet
    yield None


class _Beginning(io.RawIOBase):
    """File object that presents the first `end` bytes of a file as if the file ended there."""

    def __init__(self, file: io.BufferedIOBase | Any, end: int) -> None:
        self._file, self._end, self._at = file, end, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        left = max(0, self._end - self._at)
        self._file.seek(self._at)
        data: bytes = self._file.read(left if size < 0 else min(size, left))
        self._at += len(data)
        return data

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end}[whence]
        self._at = max(0, base + offset)
        return self._at
