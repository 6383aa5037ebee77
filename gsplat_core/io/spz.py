"""Gaussians as `.spz`, the compressed format of Niantic: 20 bytes each plus one per coefficient, compressed.

A header of 16 bytes (magic `NGSP`, version, count, SH degree, fractional bits, flags) is followed by one array per
attribute: positions (24 bit fixed point), opacities, colours, log-scales, rotations and harmonics (8 bit). Rotations are
the x, y and z of a unit quaternion in version 2. In version 3 they are its three smallest components with 10 bits. Axes
are x right, y up, z backward, so y and z change their signs against `.ply`. Versions 2 and 3 are one gzip stream, and are
read and written. Version 4, which is read only, has the arrays of version 3 as Zstandard streams. A header of 32 bytes is
followed by extensions, a table with the sizes of the streams, and the streams.

Decompression of Zstandard streams (RFC 8878) by the system's libzstd, which every Debian and Ubuntu has.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import struct
import weakref
import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, BundleError, ExportError
from gsplat_core.io.model_files import BLOCK_BYTES, check_memory, gaussians_of, logit_of_bytes, open_model_file
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, Gaussians

NAMES = ("libzstd.so.1", "libzstd.1.dylib")
PIECE_BYTES = 1 << 17


class ZstdError(Exception):
    """libzstd is not installed, or a Zstandard stream is damaged or truncated."""


class _Buffer(ctypes.Structure):
    """C structure of libzstd's `ZSTD_inBuffer` and `ZSTD_outBuffer`, which have the same layout."""

    _fields_ = (("data", ctypes.c_void_p), ("size", ctypes.c_size_t), ("done", ctypes.c_size_t))


@cache
def library() -> Any:
    """Return the library with the types of its functions.

    Raises:
        ZstdError: if it is not installed.
    """
    for name in NAMES:
        try:
            found = ctypes.CDLL(name)
        except OSError:
            continue
        found.ZSTD_createDStream.restype = ctypes.c_void_p
        found.ZSTD_freeDStream.argtypes = [ctypes.c_void_p]
        found.ZSTD_decompressStream.restype = ctypes.c_size_t
        found.ZSTD_decompressStream.argtypes = [ctypes.c_void_p, ctypes.POINTER(_Buffer), ctypes.POINTER(_Buffer)]
        found.ZSTD_isError.argtypes = found.ZSTD_getErrorName.argtypes = [ctypes.c_size_t]
        found.ZSTD_getErrorName.restype = ctypes.c_char_p
        return found
    raise ZstdError(f"{NAMES[0]} is not installed; install the package libzstd1")


class ZstdStream:
    """Reader of one stream in a part of a file, which never holds more than a piece of it. Its window is at most 128 MiB,
    the library's default limit.
    """

    def __init__(self, descriptor: int, start: int, size: int) -> None:
        """Start at the byte `start` of an open file; the stream has `size` bytes.

        Raises:
            ZstdError: if the library is not installed.
        """
        self._library = library()
        self._descriptor, self._at, self._end = descriptor, start, start + size
        self._stream = ctypes.c_void_p(self._library.ZSTD_createDStream())
        if not self._stream:
            raise MemoryError("there is no memory for the decompression of zstd")
        weakref.finalize(self, self._library.ZSTD_freeDStream, self._stream)
        self._piece = ctypes.create_string_buffer(PIECE_BYTES)
        self._input = _Buffer(ctypes.addressof(self._piece), 0, 0)

    def read(self, most: int) -> bytes:
        """Return up to `most` further bytes; b"" at the end of the stream.

        Raises:
            ZstdError: if the stream is damaged or ends within a frame.
        """
        target = ctypes.create_string_buffer(max(1, most))
        output = _Buffer(ctypes.addressof(target), most, 0)
        while output.done < most:
            if self._input.done == self._input.size:
                piece = os.pread(self._descriptor, min(PIECE_BYTES, self._end - self._at), self._at)
                self._at += len(piece)
                ctypes.memmove(self._piece, piece, len(piece))
                self._input.size, self._input.done = len(piece), 0
            before = output.done, self._input.done
            code = self._library.ZSTD_decompressStream(self._stream, ctypes.byref(output), ctypes.byref(self._input))
            if self._library.ZSTD_isError(code):
                raise ZstdError(self._library.ZSTD_getErrorName(code).decode())
            is_used_up = self._input.done == self._input.size and self._at >= self._end
            if is_used_up and (output.done, self._input.done) == before:
                break
        return target.raw[: output.done]


MAGIC = b"NGSP"
VERSIONS = (2, 3)
"""Versions of the `.spz` format that are stored in a gzip stream. They can be read and written; version 4 is read only."""
ZSTD_VERSION = 4
HEADER_4 = struct.Struct("<4sIIBBBBI12x")
"""Header of version 4: magic, version, count, degree of the harmonics, fractional bits, flags, number of streams and offset of
their table.
"""
MOST_ZSTD = 20_000
"""Largest plausible ratio of decompressed to compressed size of a Zstandard stream. Equal bytes are compressed by more
than 1,000.
"""
MOST_STREAMS = 16
MARK = b"written by IntraSplat"
"""Comment in the header of the gzip stream that identifies a file written by this program."""
GZIP_START = b"\x1f\x8b\x08\x10" + bytes(4) + b"\x00\xff" + MARK + b"\0"
"""Header of a gzip stream with a comment and without a time, so that equal models give equal bytes."""
MOST_DEFLATED = 1032
"""Largest ratio of decompressed to compressed size of the deflate algorithm."""
MOST_EXTENSIONS = 1 << 24
"""Largest number of bytes after the arrays (extensions) that are skipped to reach the stream's checksum; beyond it, the checksum is
not verified.
"""
COLOUR_SCALE = 0.15
MOST_FRACTIONAL_BITS = 23
HALF_TURN = np.array([1.0, -1.0, -1.0], np.float32)
"""Signs of x, y and z that exchange the axes of `.ply` and `.spz`: a half turn around x."""


def load_spz(path: Path) -> Gaussians:
    """Read the Gaussians of a `.spz` file.

    Raises:
        BundleCorrupt: if the file has another format or version, is truncated or damaged.
        BundleError: if it is missing, not a regular file, or larger than the available memory.
    """
    with open_model_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(4)
        if start == MAGIC:
            return _load_version_4(file, path, size)
        if start[:2] != b"\x1f\x8b":
            raise BundleCorrupt(f"{path} starts with {start!r} in place of a gzip stream; it is no .spz file")
        file.seek(0)
        content = _Inflated(file, path)
        magic, version, count, degree, fraction, _, _ = struct.unpack("<4sIIBBBB", content.read(16))
        if magic != MAGIC:
            raise BundleCorrupt(f"{path} holds {magic!r} in place of {MAGIC!r}; it is no .spz file")
        if version not in VERSIONS:
            raise BundleCorrupt(f"{path} is a .spz file of version {version}; versions 2 to 4 are read, so convert it")
        _check_header(path, degree, fraction)
        higher = (degree + 1) ** 2 - 1
        needed = 16 + count * (9 + 1 + 3 + 3 + (3 if version == 2 else 4) + 3 * higher)
        if needed > MOST_DEFLATED * size:
            raise BundleCorrupt(
                f"{path}: {count} Gaussians take {needed} bytes, more than a gzip stream of {size} bytes can hold; the file was cut short"
            )
        check_memory(path, count * 4 * (14 + 3 * higher))
        gaussians = _read_arrays(content, count, version, higher, fraction)
        content.check_end()
        return gaussians


def _check_header(path: Path, degree: int, fraction: int) -> None:
    if degree > MAX_SH_DEGREE or fraction > MOST_FRACTIONAL_BITS:
        raise BundleCorrupt(
            f"{path} has harmonics of degree {degree} and {fraction} fractional bits; at most {MAX_SH_DEGREE} and {MOST_FRACTIONAL_BITS} are possible"
        )


def _load_version_4(file: BinaryIO, path: Path, size: int) -> Gaussians:
    file.seek(0)
    header = file.read(HEADER_4.size)
    if len(header) < HEADER_4.size:
        raise BundleCorrupt(
            f"{path} has {size} bytes, fewer than the header of .spz; the file was cut short, copy it again"
        )
    _, version, count, degree, fraction, _, streams, table = HEADER_4.unpack(header)
    if version in VERSIONS:
        raise BundleCorrupt(f"{path} is a .spz file of version {version} that is not compressed; compress it with gzip")
    if version != ZSTD_VERSION:
        raise BundleCorrupt(f"{path} is a .spz file of version {version}; versions 2 to 4 are read, so convert it")
    _check_header(path, degree, fraction)
    higher = (degree + 1) ** 2 - 1
    widths = [width for width in (9, 1, 3, 3, 4, 3 * higher) if width]
    if not len(widths) <= streams <= MOST_STREAMS or table < HEADER_4.size:
        raise BundleCorrupt(
            f"{path} has {streams} streams with their table at byte {table}; a .spz file of degree {degree} has {len(widths)}"
        )
    if table + 16 * streams > size:
        raise BundleCorrupt(f"{path} ends before its table of streams; the file was cut short, copy it again")
    file.seek(table)
    sizes = struct.unpack(f"<{2 * streams}Q", file.read(16 * streams))
    packed, plain = sizes[: 2 * len(widths) : 2], sizes[1 : 2 * len(widths) : 2]
    if list(plain) != [count * width for width in widths]:
        raise BundleCorrupt(
            f"{path} has streams of other sizes than {count} Gaussians of degree {degree}; copy it again"
        )
    start = table + 16 * streams
    if start + sum(sizes[::2]) > size or any(
        much > MOST_ZSTD * (few + 1) for few, much in zip(packed, plain, strict=True)
    ):
        raise BundleCorrupt(f"{path}: {count} Gaussians need more bytes than its {size}; the file was cut short")
    check_memory(path, count * 4 * (14 + 3 * higher))
    content = _Streams(file.fileno(), path, start, packed)
    gaussians = _read_arrays(content, count, ZSTD_VERSION, higher, fraction)
    content.check_end()
    return gaussians


def _read_arrays(content: _Inflated | _Streams, count: int, version: int, higher: int, fraction: int) -> Gaussians:
    means, quats, log_scales = (np.empty((count, width), np.float32) for width in (3, 4, 3))
    logits, sh = np.empty(count, np.float32), np.empty((count, 1 + higher, 3), np.float32)
    signs = _signs(higher)

    def each(width: int, store: Callable[[slice, NDArray[np.uint8]], None]) -> None:
        step = max(1, BLOCK_BYTES // max(1, width))
        for first in range(0, count if width else 0, step):
            rows = slice(first, min(first + step, count))
            stored = np.frombuffer(content.read((rows.stop - first) * width), np.uint8)
            store(rows, stored.reshape(-1, width))

    def store_means(rows: slice, stored: NDArray[np.uint8]) -> None:
        parts = stored.reshape(-1, 3, 3).astype(np.int32)
        fixed = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
        fixed -= (fixed & 0x800000) << 1
        means[rows] = fixed.astype(np.float32) / np.float32(2**fraction) * HALF_TURN

    def store_logits(rows: slice, stored: NDArray[np.uint8]) -> None:
        logits[rows] = logit_of_bytes(stored[:, 0])

    def store_colours(rows: slice, stored: NDArray[np.uint8]) -> None:
        sh[rows, 0] = (stored / np.float32(255) - 0.5) / COLOUR_SCALE

    def store_scales(rows: slice, stored: NDArray[np.uint8]) -> None:
        log_scales[rows] = stored / np.float32(16) - 10

    def store_quats(rows: slice, stored: NDArray[np.uint8]) -> None:
        xyzw = _first_three(stored) if version == 2 else _smallest_three(stored)
        quats[rows, 0], quats[rows, 1:] = xyzw[:, 3], xyzw[:, :3] * HALF_TURN

    def store_higher(rows: slice, stored: NDArray[np.uint8]) -> None:
        values = (stored.astype(np.float32) - 128) / 128
        sh[rows, 1:] = values.reshape(-1, higher, 3) * signs

    each(9, store_means)
    each(1, store_logits)
    each(3, store_colours)
    each(3, store_scales)
    each(3 if version == 2 else 4, store_quats)
    each(3 * higher, store_higher)
    return gaussians_of(means, quats, log_scales, logits, sh)


def _signs(higher: int) -> NDArray[np.float32]:
    """Return the signs [K, 1] of the higher harmonics under a half turn around x.

    The function of degree l and order m changes its sign with z if l + m is odd. For a negative m, it also changes its
    sign with y or with x and y.
    """
    orders = [(degree, m) for degree in range(1, MAX_SH_DEGREE + 1) for m in range(-degree, degree + 1)]
    signs = [(-1.0) ** (degree + abs(m)) * (-1.0 if m < 0 else 1.0) for degree, m in orders]
    return np.array(signs, np.float32)[:higher, None]


def _first_three(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    xyz = stored / np.float32(127.5) - 1
    return np.column_stack([xyz, np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1)))])


def _smallest_three(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    packed = stored.copy().view("<u4")[:, 0]
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], 1)
    magnitude = (fields & 511).astype(np.float32) / 511 * np.float32(np.sqrt(0.5))
    three = np.where(fields & 512, -magnitude, magnitude)
    largest = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    which = packed >> 30
    columns = [
        np.where(which == j, largest, np.where(which > j, three[:, min(j, 2)], three[:, max(j - 1, 0)]))
        for j in range(4)
    ]
    return np.stack(columns, 1)


class _Inflated:
    """Reader of a gzip stream that never decompresses more than is requested."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        self._stream = zlib.decompressobj(wbits=31)

    def read(self, length: int) -> bytes:
        """Return the next `length` bytes.

        Raises:
            BundleCorrupt: if the stream ends before, or is damaged.
        """
        pieces, missing = [], length
        while missing:
            pieces.append(self._next(missing))
            missing -= len(pieces[-1])
        return b"".join(pieces)

    def check_end(self) -> None:
        """Skip extensions after the arrays, up to `MOST_EXTENSIONS`, and compare the stream with its checksum.

        Raises:
            BundleCorrupt: if the stream is damaged or has no end.
        """
        skipped = 0
        while not self._stream.eof and skipped < MOST_EXTENSIONS:
            skipped += len(self._next(1 << 16))

    def _next(self, most: int) -> bytes:
        waiting = self._stream.unconsumed_tail or self._file.read(1 << 16)
        if self._stream.eof or not waiting:
            raise BundleCorrupt(f"{self._path} ends before its last array; the file was cut short, copy it again")
        try:
            return self._stream.decompress(waiting, most)
        except zlib.error as error:
            raise BundleCorrupt(f"{self._path} is a damaged gzip stream ({error}); copy it again") from error


class _Streams:
    """Reader of the Zstandard streams of version 4, one after the other."""

    def __init__(self, descriptor: int, path: Path, start: int, sizes: Sequence[int]) -> None:
        self._path = path
        try:
            starts = itertools.accumulate(sizes, initial=start)
            self._streams = [ZstdStream(descriptor, at, size) for at, size in zip(starts, sizes, strict=False)]
        except ZstdError as error:
            raise BundleError(f"{path} is a .spz file of version {ZSTD_VERSION}: {error}") from error

    def read(self, length: int) -> bytes:
        """Return the next `length` bytes.

        Raises:
            BundleCorrupt: if the streams end before, or are damaged.
        """
        pieces, missing = [], length
        while missing:
            if not self._streams:
                raise BundleCorrupt(f"{self._path} ends before its last array; the file was cut short, copy it again")
            piece = self._next(missing)
            if not piece:
                self._streams.pop(0)
            pieces.append(piece)
            missing -= len(piece)
        return b"".join(pieces)

    def check_end(self) -> None:
        """Raise an error if the streams contain more data than was read.

        Raises:
            BundleCorrupt: in this case, or if a stream is damaged.
        """
        while self._streams:
            if self._next(1):
                raise BundleCorrupt(f"{self._path} has more bytes in a stream than its table states; copy it again")
            self._streams.pop(0)

    def _next(self, most: int) -> bytes:
        try:
            return self._streams[0].read(most)
        except ZstdError as error:
            raise BundleCorrupt(f"{self._path} has a damaged Zstandard stream ({error}); copy it again") from error


def spz_pieces(gaussians: Gaussians, version: int = 3) -> Iterator[bytes]:
    """Yield a `.spz` file of Gaussians on the CPU with unit quaternions.

    Positions have as many fractional bits as the farthest one leaves, up to `MOST_FRACTIONAL_BITS`.

    Args:
        gaussians: Gaussians of SH degree 0 to 3.
        version: 2 for readers of before 2025, else 3, which has more exact rotations.

    Raises:
        ExportError: if the format cannot represent the Gaussians.
    """
    g = {name: tensor.detach().float().numpy() for name, tensor in gaussians.tensors().items()}
    degree, farthest = gaussians.sh_degree, float(np.abs(g["means"]).max(initial=0))
    if degree > 3:
        raise ExportError(f"the model's harmonics are of degree {degree}, and .spz holds 3 at most; export it as .ply")
    if version not in VERSIONS:
        raise ExportError(f"version {version} of .spz is not written; choose 2 or 3")
    if farthest >= 2**23 - 1:
        raise ExportError(
            f"a Gaussian is {farthest:.3g} from the origin, and .spz holds {2**23 - 1} at most; export it as .ply"
        )
    fraction = min(MOST_FRACTIONAL_BITS, math.floor(math.log2((2**23 - 1) / max(farthest, 1.0))))
    header = struct.pack("<4sIIBBBB", MAGIC, version, gaussians.count, degree, fraction, 0, 0)
    stream = zlib.compressobj(6, zlib.DEFLATED, -15)
    checksum, length = 0, 0
    yield GZIP_START
    for piece in _arrays(g, header, version, fraction):
        checksum, length = zlib.crc32(piece, checksum), length + len(piece)
        yield stream.compress(piece)
    yield stream.flush() + struct.pack("<II", checksum, length & 0xFFFFFFFF)


def _arrays(g: dict[str, NDArray[np.float32]], header: bytes, version: int, fraction: int) -> Iterator[bytes]:
    yield header
    count = len(g["means"])
    blocks = [slice(first, first + (1 << 18)) for first in range(0, count, 1 << 18)]
    for rows in blocks:
        fixed = np.rint(g["means"][rows].astype(np.float64) * HALF_TURN * 2**fraction).astype("<i4")
        yield np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[..., :3].tobytes()
    for rows in blocks:
        yield _byte(255 / (1 + np.exp(-np.maximum(g["logit_opacities"][rows].astype(np.float64), -80)))).tobytes()
    for rows in blocks:
        yield _byte((g["sh"][rows, 0] * COLOUR_SCALE + 0.5) * 255).tobytes()
    for rows in blocks:
        yield _byte((g["log_scales"][rows] + 10) * 16).tobytes()
    for rows in blocks:
        yield _packed_rotations(g["quats"][rows], version).tobytes()
    higher = g["sh"].shape[1] - 1
    for rows in blocks if higher else []:
        # Quantise harmonics of degree 1 to five bits and others to four, like the reference encoder: fewer values compress better.
        step = np.array([8.0] * 3 + [16.0] * (higher - 3))[:, None]
        steps = np.floor((np.rint(g["sh"][rows, 1:] * _signs(higher) * 128 + 128) + step / 2) / step)
        yield _byte(steps * step).tobytes()


def _packed_rotations(quats: NDArray[np.float32], version: int) -> NDArray[Any]:
    xyzw = np.column_stack([quats[:, 1:] * HALF_TURN, quats[:, 0]])
    if version == 2:
        xyz = np.where(xyzw[:, 3:] < 0, -xyzw[:, :3], xyzw[:, :3])
        return _byte(xyz * 127.5 + 127.5)
    largest = np.abs(xyzw).argmax(1)
    sign = np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    three = np.take_along_axis(xyzw * sign, others, 1)
    magnitude = np.minimum(511, np.rint(np.abs(three) * (511 * math.sqrt(2)))).astype(np.uint32)
    a, b, c = (magnitude | (three < 0).astype(np.uint32) << 9).T
    return np.asarray(largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c, "<u4")


def _byte(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
