"""Decompression of Zstandard streams (RFC 8878) by the system's libzstd, which every Debian and Ubuntu has."""

from __future__ import annotations

import ctypes
import os
import weakref
from functools import cache
from typing import Any

NAMES = ("libzstd.so.1", "libzstd.1.dylib")
PIECE_BYTES = 1 << 17


class ZstdError(Exception):
    """The library is missing, or the stream is damaged or truncated."""


class _Buffer(ctypes.Structure):
    """`ZSTD_inBuffer` and `ZSTD_outBuffer`, which have the same layout."""

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
