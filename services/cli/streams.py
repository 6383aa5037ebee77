"""Standard output and standard error that may be closed, full or broken while the program runs.

A run takes long and its results are files: what happens to the streams neither ends it nor changes what it writes. A stream that refuses to
be written is remembered, and the exit code says so at the end (`StandardStreams.code`).
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import re
import select
import sys
from typing import Any, TextIO

OUTPUT_CLOSED = 141
"""What a shell reports of a program that a broken pipe ended: 128 and the number of SIGPIPE."""
_READER_GONE = (errno.EPIPE, errno.EIO, errno.EBADF, errno.ECONNRESET)
"""A closed pipe; a terminal that was closed; a descriptor that was closed."""
_NAMES = "intrasplat-names"


class _Descriptor(io.RawIOBase):
    """Writes to a descriptor until that fails; the first error is kept, and everything after it is dropped."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.error: OSError | None = None

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def write(self, data: Any) -> int:
        while self.error is None:
            try:
                return os.write(self._descriptor, data)
            except BlockingIOError:
                # A pipe that another program has set to non-blocking is full.
                select.select([], [self._descriptor], [])
            except OSError as error:
                self.error = error
        return len(data)


class StandardStreams:
    """Takes the place of `sys.stdout` and `sys.stderr` for the rest of the process."""

    def __init__(self) -> None:
        _occupy_closed_descriptors()
        codecs.register_error(_NAMES, _as_the_system_spells_it)
        self._out, sys.stdout = _guarded(sys.stdout, 1)
        self._err, sys.stderr = _guarded(sys.stderr, 2)

    def code(self, code: int) -> int:
        """The exit code of a program that would end with `code`, after all that it has printed was written out.

        A reader that has closed our output has had enough: nothing is said, and 0 becomes OUTPUT_CLOSED. An output that cannot be
        written, such as a file on a full disk, is the user's to know: one sentence, and 0 becomes 2.
        """
        sys.stdout.flush()
        error = self._out.error if self._out is not None else None
        if error is not None and code == 0:
            if error.errno in _READER_GONE:
                code = OUTPUT_CLOSED
            else:
                code = 2
                print(f"error: standard output cannot be written ({error.strerror}); free space or choose another place for it", file=sys.stderr)  # fmt: skip  # noqa: T201
        sys.stderr.flush()
        return code


def _occupy_closed_descriptors() -> None:
    """Open /dev/null where a standard stream is closed. Otherwise the next file would get its number, and be written to by what prints there."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _guarded(stream: TextIO | None, descriptor: int) -> tuple[_Descriptor | None, TextIO]:
    if stream is None:
        # It was closed when the program started: nobody wants to read it.
        return None, open(os.devnull, "w", encoding="utf-8", errors="replace")
    raw = _Descriptor(descriptor)
    errors = _NAMES if descriptor == 1 else "backslashreplace"
    buffer = io.BufferedWriter(raw)
    return raw, io.TextIOWrapper(
        buffer, stream.encoding, errors, line_buffering=descriptor == 2 or raw.isatty(), write_through=descriptor == 2
    )


def _as_the_system_spells_it(error: UnicodeError) -> tuple[bytes | str, int]:
    """Bytes of a file's name that are not text come out as they are; other characters that the terminal's encoding lacks, as escapes."""
    assert isinstance(error, UnicodeEncodeError)
    character = ord(error.object[error.start])
    if 0xDC80 <= character <= 0xDCFF:
        return bytes([character - 0xDC00]), error.start + 1
    return error.object[error.start].encode("ascii", "backslashreplace"), error.start + 1


MOST_WORD = 240
"""Characters of a word in a sentence; a longer one is a value that somebody gave, and is cut in its middle."""


def sentence(text: str) -> str:
    """Return an error's text on one line, in which no value makes what to do about it impossible to find."""
    return re.sub(rf"\S{{{MOST_WORD + 1},}}", lambda word: f"{word[0][:160]}...{word[0][-60:]}", printable(text))


def printable(text: str) -> str:
    """The text on one line, with control characters as escapes: a file's name may hold anything, what steers a terminal too."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode("ascii") for c in text)
