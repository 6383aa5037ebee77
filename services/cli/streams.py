"""Standard output and standard error that may be closed, full or broken during a run.

A run takes long and its results are files, so a failing stream neither ends it nor changes its
results. The first write error is remembered and reflected in the exit code
(`StandardStreams.code`).
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
"""Exit code that a shell reports after a broken pipe: 128 plus the number of SIGPIPE."""
_READER_GONE = (errno.EPIPE, errno.EIO, errno.EBADF, errno.ECONNRESET)
"""Errors of a closed pipe, terminal or descriptor."""
_NAMES = "intrasplat-names"


class _Descriptor(io.RawIOBase):
    """Raw stream that writes to a descriptor. After the first error, which is kept, all output is
    dropped."""

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
                # another program set the pipe to non-blocking, and it is full
                select.select([], [self._descriptor], [])
            except OSError as error:
                self.error = error
        return len(data)


class StandardStreams:
    """Replacement of `sys.stdout` and `sys.stderr` for the rest of the process."""

    def __init__(self) -> None:
        _occupy_closed_descriptors()
        codecs.register_error(_NAMES, _as_the_system_spells_it)
        self._out, sys.stdout = _guarded(sys.stdout, 1)
        self._err, sys.stderr = _guarded(sys.stderr, 2)

    def code(self, code: int) -> int:
        """Flush all output and return the final exit code.

        If the reader closed the output, 0 becomes OUTPUT_CLOSED without a message. Another write
        error, such as a full disk, prints one sentence, and 0 becomes 2.

        Args:
            code: exit code of the command.
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
    """Open /dev/null for closed standard streams. Otherwise the next opened file would get the
    descriptor and receive printed text."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _guarded(stream: TextIO | None, descriptor: int) -> tuple[_Descriptor | None, TextIO]:
    if stream is None:
        # closed at program start, so no program reads the output
        return None, open(os.devnull, "w", encoding="utf-8", errors="replace")
    raw = _Descriptor(descriptor)
    errors = _NAMES if descriptor == 1 else "backslashreplace"
    buffer = io.BufferedWriter(raw)
    return raw, io.TextIOWrapper(
        buffer, stream.encoding, errors, line_buffering=descriptor == 2 or raw.isatty(), write_through=descriptor == 2
    )


def _as_the_system_spells_it(error: UnicodeError) -> tuple[bytes | str, int]:
    """Encoding error handler: undecodable bytes of file names are written unchanged, other missing
    characters as escapes."""
    assert isinstance(error, UnicodeEncodeError)
    character = ord(error.object[error.start])
    if 0xDC80 <= character <= 0xDCFF:
        return bytes([character - 0xDC00]), error.start + 1
    return error.object[error.start].encode("ascii", "backslashreplace"), error.start + 1


MOST_WORD = 240
"""Longest word in a message; a longer value is shortened in the middle."""


def sentence(text: str) -> str:
    """Return an error text on one line, with long values shortened so the remedy stays visible."""
    return re.sub(rf"\S{{{MOST_WORD + 1},}}", lambda word: f"{word[0][:160]}...{word[0][-60:]}", printable(text))


def printable(text: str) -> str:
    """Return a text on one line, with control characters escaped, because file names may contain
    terminal sequences."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode("ascii") for c in text)
