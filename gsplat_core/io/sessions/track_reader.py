"""Reading a track: first which pictures are there whole, then those that are asked for, in order."""

from __future__ import annotations

import io
from array import array
from bisect import bisect_left
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import av
from numpy.typing import NDArray

from gsplat_core.io.recordings.containers import Container
from gsplat_core.io.recordings.decoder import PictureDecoder, captured_log
from gsplat_core.io.recordings.image_files import MAX_PIXELS
from gsplat_core.io.recordings.matroska import whole_clusters
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain
from gsplat_core.io.recordings.video_index import open_container
from gsplat_core.io.sessions.coding import CODINGS, Coding, decoded

_CODECS = ("ffv1", "vp9")
_MOST_MS = 2**62
MOST_PICTURES = 1_000_000
"""In one file: nine hours at 30 pictures/s, where segments last minutes."""


class TrackIndex:
    """Which pictures of a track's file can be decoded: those in clusters that are whole, up to the first one that is not."""

    def __init__(self, path: Path, *, check_sums: bool) -> None:
        """check_sums: whether it ends before the first cluster whose checksum is wrong, too; that reads the whole file. Without it, such
        clusters are noticed when they are decoded. Raises UnreadableFile, OSError."""
        self.path, self.checked = path, check_sums
        self.end = 0
        self._times = array("q")
        if path.is_symlink():
            raise UnreadableFile("it is a link")
        with open_plain(path) as file:
            size = file.seek(0, io.SEEK_END)
            for cluster in islice(whole_clusters(file, size, check_sums=check_sums), MOST_PICTURES):
                rising = cluster.time < _MOST_MS and (not self._times or cluster.time > self._times[-1])
                if not cluster.intact or not rising:  # our writer's times rise
                    break
                self._times.append(cluster.time)
                self.end = cluster.end

    def __contains__(self, time_ms: object) -> bool:
        """Whether there is a picture at a time."""
        assert isinstance(time_ms, int)
        at = bisect_left(self._times, time_ms)
        return at < len(self._times) and self._times[at] == time_ms

    def damaged(self) -> frozenset[int]:
        """The times of pictures whose checksum is wrong. Raises UnreadableFile, OSError."""
        if self.checked:
            return frozenset()
        with open_plain(self.path) as file:
            clusters = islice(whole_clusters(file, self.end, check_sums=True), MOST_PICTURES)
            return frozenset(cluster.time for cluster in clusters if not cluster.intact)


class TrackReader:
    """Decodes pictures of one track; ask for them in the order of their times."""

    def __init__(self, index: TrackIndex, track: str, height_px: int, width_px: int) -> None:
        self._index, self._size = index, (height_px, width_px)
        self._coding: Coding = CODINGS[track]
        self._pictures: Iterator[tuple[int, NDArray[Any] | None, str | None]] | None = None
        self._next: tuple[int, NDArray[Any] | None, str | None] | None = None

    def picture(self, time_ms: int) -> tuple[NDArray[Any] | None, str | None]:
        """The picture at a time, or None; and what is wrong with it. Raises UnreadableFile, OSError, av.FFmpegError."""
        if self._pictures is None:
            self._pictures = self._decode()
            self._next = next(self._pictures, None)
        while self._next is not None and self._next[0] < time_ms:
            self._next = next(self._pictures, None)
        if self._next is None or self._next[0] != time_ms:
            return None, "its picture is missing"
        return self._next[1:]

    def close(self) -> None:
        """Close the file."""
        pictures, self._pictures, self._next = self._pictures, None, None
        if pictures is not None:
            pictures.close()  # type: ignore[attr-defined]

    def _decode(self) -> Iterator[tuple[int, NDArray[Any] | None, str | None]]:
        """Time, picture and damage of all pictures."""
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
            coding: Coding = "vp9" if context.codec.canonical_name == "vp9" else self._coding
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
    """The packets that hold data, and None at the end. What cannot be read ends them."""
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
    """The first bytes of a file, as if it ended there."""

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
