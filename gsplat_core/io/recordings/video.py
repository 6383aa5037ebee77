"""Video files: the container is indexed first, then decoded in order without seeking."""

from __future__ import annotations

from array import array
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple

import av
from av.stream import Disposition

from gsplat_core.io.recordings.decoder import (
    NO_PICTURE,
    Container,
    Orientation,
    PictureConverter,
    PictureDecoder,
    UnusableContainer,
    captured_log,
    frame_rate,
    is_shown,
    orientation_of,
    recognise,
)
from gsplat_core.io.recordings.plain_files import DEPENDS, MAX_PIXELS, Findings, Picture, UnreadableFile, open_plain

_NOT_SHOWN = -1
_MAX_LOST = 10_000


@dataclass(frozen=True)
class VideoIndex:
    """Packets of a video stream, numbered from 0 in file order."""

    positions: array
    """Display position of each packet's picture; -1 if not displayed."""
    key_packets: bytes
    """One byte per packet: 1 if decoding can start at the packet, else 0."""
    damaged: dict[int, str]
    """Damage reported by the container, by packet number."""
    frame_count: int
    """Number of displayed pictures, including those lost to container damage."""
    times: tuple[int, ...] | None
    """Display times of the pictures in units of the stream's time base.

    None without increasing times, and after container damage.
    """
    unordered: str | None
    """Reason as a phrase why the stated times cannot be used; None if they can, or if none are stated."""
    ordered: bool
    """True if `positions` is reliable.

    False for streams without timestamps whose pictures are reordered; only the decoder knows the order.
    """


def is_picture(packet: av.Packet) -> bool:
    """Return True if a packet holds data. An empty packet marks the end or repeats a picture."""
    return packet.size > 0


def open_container(file: BinaryIO, container: Container) -> av.container.InputContainer:
    """Open a file with the demuxer determined from its first bytes.

    Raises:
        av.FFmpegError: if it cannot be opened.
    """
    with captured_log():
        return av.open(
            file, mode="r", format=container.demuxer, metadata_errors="replace", options={"max_pixels": "67108864"}
        )


def read_index(opened: av.container.InputContainer, stream: av.VideoStream, container: Container) -> VideoIndex:
    """Read the packets of a stream once, up to the first error of the container, to build the index."""
    times: list[int | None] = []
    shown = bytearray()
    keys = bytearray()
    damaged: dict[int, str] = {}
    lost: dict[int, str] = {}
    name = stream.codec_context.codec.canonical_name
    packets = iter(opened.demux(stream))
    while True:
        with captured_log() as messages:
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                lost[len(times)] = error.strerror or str(error)
                break
        if messages:
            lost[len(times)] = messages[0][2].strip()
        if packet is None:
            break
        if not is_picture(packet):
            continue
        number = len(times)
        if number in lost:
            damaged[number] = lost[number]
        elif packet.pos is not None and any(begin <= packet.pos < end for begin, end in container.damaged_bytes):
            damaged[number] = "the checksum of its part of the file is wrong"
        times.append(packet.pts)
        keys.append(packet.is_keyframe)
        shown.append(not packet.is_discard and is_shown(name, bytes(packet)))
    duration = _frame_duration(stream)
    displayed = [time for time, is_visible in zip(times, shown, strict=True) if is_visible and time is not None]
    unordered = None if lost else _disorder(displayed, stream.codec_context.codec.reorder)
    if unordered is not None:
        times = [None] * len(times)
    positions, count, ordered = _positions(times, shown, lost, duration, stream.codec_context.has_b_frames)
    is_timed = len(displayed) == count and unordered is None and not lost
    in_order = tuple(sorted(displayed)) if is_timed else None
    return VideoIndex(positions, bytes(keys), damaged, count, in_order, unordered, ordered)


def _disorder(times: Sequence[int], reordered: bool) -> str | None:
    """Return what is wrong with display times in file order, as a phrase; None if nothing is.

    Args:
        times: display times of the displayed pictures that state one.
        reordered: True if the codec may store pictures in another order than they are displayed.
    """
    if repeated := len(times) - len(set(times)):
        return f"{repeated} of its {len(times)} frame times are repeated"
    back = 0 if reordered else sum(later < earlier for earlier, later in pairwise(times))
    return f"its frame times go backwards {back} times" if back else None


def _frame_duration(stream: av.VideoStream) -> Fraction | None:
    """Return the frame duration in units of the stream's time base; None if the frame rate is unknown."""
    rate = frame_rate(stream)
    if not rate or not stream.time_base:
        return None
    return 1 / (Fraction(rate).limit_denominator(1_000_000) * stream.time_base)


def _positions(
    times: list[int | None], shown: bytearray, lost: dict[int, str], duration: Fraction | None, reordered: bool
) -> tuple[array, int, bool]:
    """Return the display position of each packet's picture, the number of positions, and True if the positions are reliable.

    A picture that is not displayed has position -1. After container damage, a time gap counts as missing frames. Positions
    of reordered pictures without distinct timestamps are unreliable.
    """
    visible = [number for number in range(len(times)) if shown[number]]
    known = [times[number] for number in visible if times[number] is not None]
    timed = len(known) == len(visible) and len(set(known)) == len(known)
    if timed:
        visible.sort(key=lambda number: times[number] or 0)
    positions = array("q", [_NOT_SHOWN]) * len(times)
    count, before = 0, None
    for number in visible:
        time = times[number]
        if timed and lost and duration and before is not None and time is not None:
            missing = round((time - before) / duration) - 1
            if 0 < missing <= _MAX_LOST and any(abs(number - at) <= 16 for at in lost):
                count += missing
        positions[number] = count
        count, before = count + 1, time
    return positions, count, timed or not reordered


VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm"})
_REENCODE = "Copy the file again from its source, or re-encode it (ffmpeg -i IN -c:v libx264 OUT.mp4)"
MAX_JITTER = 0.5
"""Largest deviation of an evenly spaced display time from the stated frame rate, in frame durations, that is ignored."""
EVEN_WITHIN_S = 0.002
"""Largest deviation of a display time from even spacing that counts as rounding, in seconds.

Matroska rounds times to 1 ms, and a copy into another container may round again.
"""
SAME_RATE = 0.01
"""Largest relative difference of the stated frame rate from the mean rate of evenly spaced frames. Beyond it the stated rate
is wrong, and the mean rate replaces it.
"""
LEAST_FPS, MOST_FPS = 0.1, 1000.0
_MOST_LATE = 64
"""Number of packets for which reasons to suspect damage are kept, more than a decoder can delay a picture."""


class VideoFrames:
    """Frames of a video file, decoded sequentially."""

    def __init__(
        self,
        path: Path,
        container: Container,
        index: VideoIndex,
        timing: FrameTiming,
        orientation: Orientation,
    ) -> None:
        self.path = path
        self.files: tuple[Path, ...] = (path,)
        self.frame_count = index.frame_count
        self.numbers: list[int | None] = list(range(index.frame_count))
        self.width_px = self.height_px = 0
        self.times: Sequence[float] | None = timing.times
        self.fps: float | None = timing.fps
        self.keeps_times = timing.is_uneven
        self._container = container
        self._index = index
        self._orientation = orientation

    def frames(self, findings: Findings) -> Iterator[Picture | None]:
        """Yield the pictures in order, with damaged ones marked.

        A premature end is a problem, and so is a change of size, which yields None.
        """
        try:
            yield from self._frames(findings)
        # The file was changed or became unreadable, because its container was complete when it was opened.
        except (UnreadableFile, OSError, av.FFmpegError) as error:
            findings.problem(
                self.path, f"the video cannot be read any more: {error}", "Leave it alone while it is read"
            )

    def _frames(self, findings: Findings) -> Iterator[Picture | None]:
        due = 0
        last: Picture | None = None
        spread = DamageSpread(self._index)
        for position, decoded in self._decoded(spread):
            if self._index.ordered and position < due:
                continue  # duplicate or late picture
            while self._index.ordered and due < position and last is not None:
                yield Picture(last.image, spread.damage(due) or NO_PICTURE)
                due += 1
            image, damage = decoded.image, decoded.damage
            if image.shape != (self.height_px, self.width_px, 3):
                if damage is None or last is None:
                    findings.problem(
                        self.path,
                        f"frame {due} is {image.shape[1]}x{image.shape[0]}, the first one is {self.width_px}x{self.height_px}",
                        _REENCODE,
                    )
                    yield None
                    due += 1
                    continue
                image = last.image  # the size in a damaged header is unreliable
            last = Picture(image, damage)
            yield last
            due += 1
        if due < self.frame_count:
            findings.problem(
                self.path,
                f"the video ends early: {due} of {self.frame_count} announced frames could be decoded",
                f"{_REENCODE}, or replay only its beginning (--max-frames {due})",
            )

    def first_picture(self) -> Picture | None:
        """Decode the first frame, which determines the size of all frames; None if none decodes."""
        decoded = self._decoded(DamageSpread(self._index))
        position, first = next(decoded, (0, None))
        decoded.close()
        if first is not None:
            self.height_px, self.width_px = first.image.shape[:2]
            if self._index.ordered and position > 0:
                return Picture(first.image, NO_PICTURE)
        return first

    def _decoded(self, spread: DamageSpread) -> Generator[tuple[int, Picture], None, None]:
        """Yield the decoded pictures with their display positions."""
        with _opened(self.path, self._container) as (container, stream):
            decoder, converter = PictureDecoder(stream), PictureConverter(self._orientation)
            for number, packet in _numbered(container, stream):
                shown = number < len(self._index.positions) and self._index.positions[number] >= 0
                frames = decoder.decode(packet, number, shown)
                spread.follow(decoder.doubts, number)
                for own, frame in frames:
                    position = self._index.positions[own]
                    if position >= 0:
                        yield position, Picture(converter.picture(frame), spread.damage(position))


class DamageSpread:
    """Propagation of packet damage to dependent pictures.

    A picture is damaged if its own packet is suspect, or if it may be predicted from a damaged picture. The latter are
    all later pictures up to the next key frame, including those stored after the key frame but displayed before it.
    """

    def __init__(self, index: VideoIndex) -> None:
        self._index = index
        self._own: dict[int, str] = {}
        self._damage: dict[int, str] = {}
        self._cause: str | None = None
        self._before_position = -1
        self._next = 0

    def follow(self, doubts: dict[int, str], last: int) -> None:
        """Merge the decoder's reasons for suspecting damage of packets, up to packet number `last`."""
        self._own = doubts | self._own  # the first reason is usually the most specific
        begin = min([self._next, *doubts])  # classify pictures again from the first newly suspected packet on
        doubts.clear()
        self._next = min(last + 1, len(self._index.positions))
        for number in range(begin, self._next):
            self._judge(number)
        for number in [number for number in self._own if number < self._next - _MOST_LATE]:
            del self._own[number]

    def _judge(self, number: int) -> None:
        own = self._own.get(number) or self._index.damaged.get(number)
        position = self._index.positions[number]
        if self._index.key_packets[number] and own is None and self._cause is not None:
            self._cause, self._before_position = None, position
        if own is not None:
            self._cause = self._cause or f"frame {position}: {own}"
            self._damage[position] = own
        elif self._cause is not None:
            self._damage.setdefault(position, f"{DEPENDS} ({self._cause})")
        elif 0 <= position < self._before_position:
            self._damage.setdefault(position, f"{DEPENDS} before the key frame that follows it")

    def damage(self, position: int) -> str | None:
        """Return and remove the damage of the picture at a display position; None if intact."""
        return self._damage.pop(position, None)


@contextmanager
def _opened(path: Path, container: Container) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    with open_plain(path) as file, open_container(file, container) as opened:
        yield opened, opened.streams.video[0]


def _numbered(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[tuple[int, av.Packet | None]]:
    """Yield the packets with data up to an error, numbered as in the index, then None to flush the decoder."""
    number = 0
    packets = iter(container.demux(stream))
    while True:
        with captured_log():  # container errors are already recorded in the index
            try:
                packet = next(packets, None)
            except av.FFmpegError:
                packet = None
        if packet is None:
            break
        if is_picture(packet):
            yield number, packet
            number += 1
    yield max(number - 1, 0), None


def open_video(path: Path, findings: Findings) -> VideoFrames | None:
    """Check the container and the first frame; None after a problem."""
    try:
        with open_plain(path) as file:
            container = recognise(file)
        with _opened(path, container) as (opened, stream):
            return _inspect(path, container, opened, stream, findings)
    except UnreadableFile as error:
        findings.problem(path, str(error), "Give a video file")
    except UnusableContainer as error:
        findings.problem(path, str(error), _REENCODE)
    except (OSError, av.FFmpegError) as error:
        findings.problem(path, f"the video cannot be read: {error.strerror or error}", _REENCODE)
    except IndexError:
        findings.problem(path, "the file holds no video stream", _REENCODE)
    return None


def _inspect(
    path: Path,
    container: Container,
    opened: av.container.InputContainer,
    stream: av.VideoStream,
    findings: Findings,
) -> VideoFrames | None:
    context = stream.codec_context
    if context is None:
        findings.problem(path, "no decoder is known for the video in it", _REENCODE)
        return None
    if context.width * context.height > MAX_PIXELS:
        findings.problem(
            path,
            f"frames of {context.width}x{context.height} exceed the bound of {MAX_PIXELS} pixels",
            "Scale it down",
        )
        return None
    _warn_of_format(path, opened, stream, findings)
    fps = frame_rate(stream)
    index = read_index(opened, stream, container)
    timing = _timing(index, stream, findings, path)
    announced = stream.frames or int(fps * _duration_s(opened, stream))
    # Without a stated count, a video of irregular frame times has fewer frames than its duration suggests.
    found = index.frame_count
    if not stream.frames and timing.times is not None and index.times and stream.time_base:
        found = round((index.times[-1] - index.times[0]) * stream.time_base * Fraction(fps)) + 1
    # Neither a count nor usable times: the duration alone does not tell how many frames there were.
    is_unknown = not stream.frames and index.unordered is not None
    if found < 0.98 * announced - 2 and not _is_edited(index) and not is_unknown:
        findings.problem(path, f"the video ends early: {found} of about {announced} frames are there", _REENCODE)
        return None
    return _with_first_frame(path, container, index, timing, findings)


_SQUARE_WITHIN = 0.01
"""Largest deviation of the stated shape of pixels from a square that is ignored; 720x576 has 0.07 or more."""


def _warn_of_format(
    path: Path, opened: av.container.InputContainer, stream: av.VideoStream, findings: Findings
) -> None:
    """Warn of pixels that are not square and of further videos in the file."""
    shape = stream.sample_aspect_ratio
    if shape and abs(shape - 1) > _SQUARE_WITHIN:
        findings.warn(
            path,
            f"its pixels are not square: {shape.numerator}:{shape.denominator} wide to high",
            "They are read as if they were; scale the video (ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 OUT.mp4), or give a "
            "camera with fx and fy",
        )
    others = [other for other in opened.streams.video if not other.disposition & Disposition.attached_pic]
    if len(others) > 1:
        findings.warn(
            path,
            f"it holds {len(others)} videos",
            "The first one is read; write another one into a file of its own (ffmpeg -i IN -map 0:v:1 -c copy OUT.mkv)",
        )


class FrameTiming(NamedTuple):
    """Frame rate and display times of a video."""

    fps: float
    """Frame rate in Hz: the stated one, or the mean rate of uneven times and in place of a wrong statement."""
    times: tuple[float, ...] | None = None
    """Display times in units of 1 / `fps` since the first picture; None if frame i is at i / `fps`."""
    is_uneven: bool = False
    """True if the times are not evenly spaced."""


def _timing(index: VideoIndex, stream: av.VideoStream, findings: Findings, path: Path) -> FrameTiming:
    """Return the frame rate and the display times of a video, with a warning about times that are not evenly spaced or
    cannot be used.

    Evenly spaced times that agree with the stated frame rate up to `MAX_JITTER` are replaced by multiples of the frame
    duration, so that rounded times do not matter.
    """
    fps = frame_rate(stream)
    is_usable = LEAST_FPS <= fps <= MOST_FPS
    times = index.times or ()
    tick = stream.time_base or Fraction(1)
    span_s = (times[-1] - times[0]) * tick if times else Fraction(0)
    mean = Fraction(len(times) - 1) / span_s if span_s else Fraction(0)
    if not is_usable:
        rate, how = (float(mean), "the mean rate") if LEAST_FPS <= mean <= MOST_FPS else (30.0, "assumed")
        findings.warn(path, f"the container announces {fps:g} frames/s", f"{rate:g} frames/s are used, {how}")
        fps = rate
    if index.unordered is not None:
        findings.warn(path, index.unordered, f"Its frames are taken as evenly spaced, at {fps:g} frames/s")
    if not span_s:
        return FrameTiming(fps)
    within = min(MAX_JITTER, max(float(tick), EVEN_WITHIN_S) * float(mean))
    if any(abs(time - place) > within for place, time in enumerate(_scaled(times, tick * mean))):
        steps = [float((later - earlier) * tick) for earlier, later in pairwise(times)]
        findings.warn(
            path, f"its frames are {min(steps):.3g} to {max(steps):.3g} s apart", "They keep their times in the file"
        )
        unit = mean if LEAST_FPS <= mean <= MOST_FPS else Fraction(fps)
        return FrameTiming(float(unit), _scaled(times, tick * unit), is_uneven=True)
    duration = _frame_duration(stream) if is_usable else None
    if duration is None:
        return FrameTiming(fps)
    stated = _scaled(times, 1 / duration)
    if all(abs(time - place) <= MAX_JITTER for place, time in enumerate(stated)):
        return FrameTiming(fps)
    if LEAST_FPS <= mean <= MOST_FPS and abs(float(mean) / fps - 1) > SAME_RATE:
        return FrameTiming(float(mean), _scaled(times, tick * mean))
    return FrameTiming(fps, stated)


def _scaled(times: Sequence[int], factor: Fraction) -> tuple[float, ...]:
    """Return the times since the first one, multiplied by `factor`, correctly rounded."""
    return tuple((time - times[0]) * factor.numerator / factor.denominator for time in times)


def _duration_s(opened: av.container.InputContainer, stream: av.VideoStream) -> float:
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    # Matroska states the time of the end, and its first frame may be later than 0.
    start = max(0, stream.start_time or 0) * (stream.time_base or 0)
    return max(0.0, (opened.duration or 0) / av.time_base - float(start))


def _is_edited(index: VideoIndex) -> bool:
    """Return True if some packets are decoded but not displayed, as with an edit list."""
    return any(position < 0 for position in index.positions)


def _orientation(path: Path, container: Container, findings: Findings) -> Orientation:
    """Return the orientation of the pictures as the container states it, with a warning about what is not corrected; the
    stored one if no frame can be decoded.
    """
    with _opened(path, container) as (opened, stream), captured_log():
        try:
            frame = next(opened.decode(stream), None)
        except av.FFmpegError:
            frame = None
    if frame is None:
        return Orientation()
    orientation = orientation_of(frame)
    if orientation.ignored_degrees:
        findings.warn(
            path,
            f"the container asks for a rotation by {orientation.ignored_degrees}° more, which is not a quarter turn",
            "It is not applied",
        )
    if frame.interlaced_frame:
        findings.warn(
            path,
            "the video is interlaced: its frames hold two moments each, and what moves has combed edges",
            "Deinterlace it (ffmpeg -i IN -vf bwdif -c:v libx264 OUT.mp4)",
        )
    return orientation


def _with_first_frame(
    path: Path,
    container: Container,
    index: VideoIndex,
    timing: FrameTiming,
    findings: Findings,
) -> VideoFrames | None:
    """Return the video; None after a problem with its first frame, which must be intact to initialise the scene."""
    video = VideoFrames(path, container, index, timing, _orientation(path, container, findings))
    first = video.first_picture()
    if first is None:
        findings.problem(path, "no frame of the video can be decoded", _REENCODE)
        return None
    if first.damage is not None:
        findings.problem(
            path,
            f"the first frame is damaged: {first.damage}",
            f"{_REENCODE}, or cut off its beginning (ffmpeg -ss SECONDS -i IN -c:v libx264 OUT.mp4)",
        )
        return None
    return video
