"""Small videos of every codec, made with PyAV where they are needed, and ways to damage them."""

from __future__ import annotations

import random
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

WIDTH, HEIGHT, FRAMES, GROUP = 160, 128, 20, 10
"""A key frame every GROUP frames."""

CODECS: dict[str, tuple[str, str, str, dict[str, str]]] = {
    "h264": ("mp4", "libx264", "yuv420p", {"preset": "veryfast"}),
    "h264_mkv": ("mkv", "libx264", "yuv420p", {"preset": "veryfast"}),
    "h265": (
        "mp4",
        "libx265",
        "yuv420p",
        {"preset": "ultrafast", "x265-params": "log-level=none:keyint=10:min-keyint=10"},
    ),
    "vp9": ("webm", "libvpx-vp9", "yuv420p", {"deadline": "realtime", "cpu-used": "8"}),
    "vp9_mp4": ("mp4", "libvpx-vp9", "yuv420p", {"deadline": "realtime", "cpu-used": "8"}),
    "vp8": ("webm", "libvpx", "yuv420p", {"deadline": "realtime", "cpu-used": "8"}),
    "mjpeg": ("avi", "mjpeg", "yuvj420p", {}),
    "mjpeg_mov": ("mov", "mjpeg", "yuvj420p", {}),
    "mpeg4": ("mp4", "mpeg4", "yuv420p", {}),
    "ffv1": ("mkv", "ffv1", "yuv420p", {"level": "3", "slicecrc": "1", "slices": "4"}),
    "ffv1_avi": ("avi", "ffv1", "yuv420p", {"level": "3", "slicecrc": "1", "slices": "4"}),
}


def pictures(count: int = FRAMES, size: tuple[int, int] = (WIDTH, HEIGHT)) -> list[np.ndarray]:
    """A texture that moves, so that frames are predicted from each other and differ."""
    width, height = size
    texture = np.random.default_rng(7).integers(0, 256, (height // 8 + 4, width // 8 + 4, 3), np.uint8)
    large = np.kron(texture, np.ones((8, 8, 1), np.uint8))
    noise = np.random.default_rng(8).integers(-24, 25, large.shape)
    large = np.clip(large * 0.7 + 30 + noise, 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(large[i % 16 : i % 16 + height, i // 2 : i // 2 + width]) for i in range(count)]


def encode(path: Path, codec: str, images: Sequence[np.ndarray] | None = None, **stream_settings: Any) -> Path:
    """Write images as video with one of CODECS; further settings are called on the stream (`set_display_rotation=90`)."""
    _, encoder, pixels, options = CODECS[codec]
    images = pictures() if images is None else images
    with av.open(str(path), "w") as container:
        stream = container.add_stream(encoder, rate=25, options=options)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.gop_size = GROUP
        for name, value in stream_settings.items():
            getattr(stream, name)(value)
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def write_timed(path: Path, ticks: list[int], rate: int = 25, tick: Fraction = Fraction(1, 25)) -> Path:
    """Write one frame for each display time, in units of `tick` seconds, to a file that states `rate`.

    Matroska states no number of frames. Its blocks have no checksum, so that `set_times` may change them.
    """
    with av.open(str(path), "w", options={"write_crc32": "0"} if path.suffix == ".mkv" else {}) as container:
        stream = container.add_stream("ffv1" if path.suffix == ".mkv" else "mjpeg", rate=rate)
        stream.width, stream.height, stream.pix_fmt = 48, 40, "bgr0" if path.suffix == ".mkv" else "yuvj420p"
        stream.codec_context.time_base = tick
        for index, time in enumerate(ticks):
            frame = av.VideoFrame.from_ndarray(np.full((40, 48, 3), 20 * index % 240, np.uint8), format="rgb24")
            frame.pts, frame.time_base = time, tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def set_times(path: Path, times_ms: list[int]) -> None:
    """Overwrite the times of a Matroska file's blocks, which an encoder would refuse to write."""
    with av.open(str(path)) as container:
        packets = [(packet.pos, bytes(packet)) for packet in container.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    for (position, payload), time_ms in zip(packets, times_ms, strict=True):
        at = data.index(payload, position)  # before it: the track, the time in 2 bytes, flags
        data[at - 3 : at - 1] = time_ms.to_bytes(2, "big", signed=True)
    path.write_bytes(data)


def name_of(codec: str) -> str:
    return f"{codec}.{CODECS[codec][0]}"


def payload(path: Path) -> list[tuple[int, int]]:
    """Return begin and end of each coded picture in the file, in decoding order."""
    with av.open(str(path)) as container:
        return [
            (p.pos + _header(path, p), p.pos + _header(path, p) + p.size) for p in container.demux(video=0) if p.size
        ]


def _header(path: Path, packet: av.Packet) -> int:
    """Bytes from where FFmpeg says that a packet begins to its data."""
    data, blob = path.read_bytes(), bytes(packet)
    return data.index(blob, packet.pos) - packet.pos


def flipped(data: bytes, at: int, seed: int) -> bytes:
    damaged = bytearray(data)
    damaged[at] ^= 1 << random.Random(seed).randrange(8)
    return bytes(damaged)


def with_hole(data: bytes, at: int, length: int) -> bytes:
    return data[:at] + bytes(len(data[at : at + length])) + data[at + length :]
