"""Terminal of the program: standard streams that may be closed, full or broken, exit codes and messages of errors, tables, progress, and signals.

The first Ctrl-C asks the run to stop, the second ends it. Progress is written to stderr, so that stdout holds only the result:
a live bar on a terminal, plain lines otherwise.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import io
import math
import os
import re
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import TaskID

    from operators.applications.session import Progress

OK = 0
BUG = 1
BAD_INPUT = 2
NOTHING_SHOWN = 3
"""Exit code of a regular run that showed no frame."""
INTERRUPTED = 130
OUTPUT_CLOSED = 141
"""Exit code that a shell reports after a broken pipe: 128 plus the number of SIGPIPE."""
_READER_GONE = (errno.EPIPE, errno.EIO, errno.EBADF, errno.ECONNRESET)
"""Errno values that mean that the reader of the output has closed the pipe, terminal or descriptor."""
_NAMES = "intrasplat-names"


class _Descriptor(io.RawIOBase):
    """Raw stream that writes to a file descriptor. After a write error, stored in `error`, it discards all further
    output."""

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
                # The pipe is full, and another program has set it to non-blocking mode.
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
        if error is not None and code == OK:
            if error.errno in _READER_GONE:
                code = OUTPUT_CLOSED
            else:
                code = BAD_INPUT
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
        # The stream was closed at program start, so no program reads the output.
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
"""Longest word in an error message, in characters; a longer value is shortened in the middle."""


def sentence(text: str) -> str:
    """Return an error text on one line, with long values shortened so the remedy stays visible."""
    return re.sub(rf"\S{{{MOST_WORD + 1},}}", lambda word: f"{word[0][:160]}...{word[0][-60:]}", printable(text))


def printable(text: str) -> str:
    """Return a text on one line, with control characters escaped, because file names may contain terminal sequences."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode("ascii") for c in text)


_MACHINE = {
    errno.ENOSPC: "free space on that disk",
    errno.EDQUOT: "free space in that quota",
    errno.EFBIG: "raise the file-size limit (`ulimit -f`)",
    errno.EMFILE: "raise the limit of open files (`ulimit -n`)",
    errno.ENFILE: "close other programs' files",
    errno.ENOMEM: "free memory, or give a smaller --scale",
    errno.EROFS: "choose a place that can be written",
    errno.EIO: "check the disk",
    errno.ESTALE: "check the network drive",
}
"""Remedies by errno, for system errors whose cause is the machine and not the named file."""
_MEMORY_WORDS = ("can't allocate memory", "cannot allocate memory", "out of memory", "bad_alloc", "insufficient memory")


def exit_code_of(error: BaseException, arguments: Iterable[str] = ()) -> int:
    """Print an error to stderr and return its exit code.

    An error that the user can remedy (file, option, disk, memory) and an interrupt print one line. Everything else is a
    bug and prints a traceback.

    Args:
        error: the exception.
        arguments: the command line; OS errors about files named in it count as user errors.

    Returns:
        The exit code: 2 for user errors, 3 for a run that showed nothing, 130 for an interrupt, 1
        for a bug.
    """
    if isinstance(error, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)  # noqa: T201
        return INTERRUPTED
    sentence = user_sentence(error, arguments)
    if sentence is not None:
        print(f"error: {sentence}", file=sys.stderr)  # noqa: T201
        return NOTHING_SHOWN if _showed_nothing(error) else BAD_INPUT
    traceback.print_exception(error)
    print("error: this is a bug in intrasplat; please report it with the lines above", file=sys.stderr)  # noqa: T201
    return BUG


def user_sentence(error: BaseException, arguments: Iterable[str] = ()) -> str | None:
    """Return the message for a user error, or None for a bug."""
    from gsplat_core.errors import UserError
    from operators.errors import OperatorFailed, RunFailed

    where = ""
    for link in _causes(error):
        if isinstance(link, OperatorFailed):
            # OperatorFailed names the operator; its cause has the reason.
            frame = "" if link.seq is None else f" on frame {link.seq}"
            where = f"\n  in operator {link.operator}{frame}"
        elif not isinstance(link, RunFailed):  # RunFailed only states the early end; its cause has the reason
            said = str(link) if isinstance(link, UserError) else _of_the_machine(link, arguments)
            return None if said is None else sentence(said) + where
    return None


def _showed_nothing(error: BaseException) -> bool:
    from operators.errors import NothingShown

    return isinstance(error, NothingShown)


def _of_the_machine(error: BaseException, arguments: Iterable[str]) -> str | None:
    """Return a message if memory, a disk or a file of the command line caused the error, otherwise None."""
    if _is_out_of_memory(error):
        said = str(error).strip().splitlines() or ["an allocation failed"]
        return f"there is not enough memory ({said[0][:200]}); free some, or give a smaller --scale or fewer frames"
    if isinstance(error, RuntimeError) and str(error) == "can't start new thread":
        return (
            "the system refuses another thread; raise the limit of processes (`ulimit -u`) or of memory (`ulimit -v`)"
        )
    if not isinstance(error, OSError):
        return None
    named = None if error.filename is None else os.fsdecode(error.filename)
    if error.errno in _MACHINE:
        return f"{named or 'this machine'}: {error.strerror}; {_MACHINE[error.errno]}"
    if named is not None and any(_related(named, argument) for argument in arguments):
        return f"{named}: {error.strerror}; check the path and its permissions"
    return None


def _is_out_of_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError):
        return True
    # torch raises RuntimeError and OpenCV its own error; neither has an out-of-memory class on the CPU.
    kinds = {kind.__name__ for kind in type(error).__mro__}
    text = str(error).lower()
    return bool(kinds & {"RuntimeError", "error"}) and any(words in text for words in _MEMORY_WORDS)


def _related(named: str, argument: str) -> bool:
    """Return True if the path `named` equals, is inside, or is an ancestor of the path in an argument."""
    _, equals, value = argument.partition("=")
    given = os.path.abspath(value if equals and argument.startswith("-") else argument)
    named = os.path.abspath(named)
    return named == given or named.startswith(given.rstrip("/") + "/") or given.startswith(named.rstrip("/") + "/")


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


WIDEST = 60
"""Largest width of a cell of a printed table, in characters; longer texts are cut, except in the last column."""
Columns = Mapping[str, str]
"""Headings by field name; a dot selects a nested field (`figures.age_ms`)."""
KEY_COLUMNS: Columns = {
    "id": "ID", "role": "ROLE", "created_at": "CREATED", "expires_at": "EXPIRES", "expired": "EXPIRED",
    "last_used_at": "LAST USED", "streams": "STREAMS", "name": "NAME",
}  # fmt: skip
_EMPTY = {"expires_at": "never", "last_used_at": "never", "streams": "all"}


def table(columns: Columns, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format a table as lines. Columns without values are omitted, except the first.

    Args:
        columns: headings by field.
        rows: one mapping per line; missing fields give empty cells.

    Returns:
        The headings, then one line per row.
    """
    cells = [[_text(field, _value(row, field)) for field in columns] for row in rows]
    first = next(iter(columns))
    kept = [
        index for index, field in enumerate(columns) if not rows or field == first or any(line[index] for line in cells)
    ]
    lines = [[list(columns.values())[index] for index in kept], *([line[index] for index in kept] for line in cells)]
    lines = [[*(_cut(text) for text in line[:-1]), line[-1]] for line in lines]
    widths = [max(len(line[place]) for line in lines) for place in range(len(kept))]
    return ["  ".join(f"{text:{width}}" for text, width in zip(line, widths, strict=True)).rstrip() for line in lines]


def _cut(text: str) -> str:
    return text if len(text) <= WIDEST else f"{text[: WIDEST - 1]}…"


def _value(row: Mapping[str, Any], field: str) -> Any:
    found: Any = row
    for part in field.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _text(field: str, value: Any) -> str:
    """Format a cell on one line: times to the second with their zone, sizes in binary units."""
    if value is None or value == "":
        return _EMPTY.get(field, "")
    if field.endswith("_at") or field == "at":
        return _time(str(value))
    if field.endswith("_bytes") and isinstance(value, int | float):
        return size(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.1f}" if math.isfinite(value) else ""
    if isinstance(value, Mapping):
        return printable(", ".join(f"{name} {each}" for name, each in value.items()))
    if isinstance(value, list | tuple):
        return printable(", ".join(map(str, value)))
    return printable(str(value))


def _time(text: str) -> str:
    try:
        return datetime.fromisoformat(text).astimezone().strftime("%Y-%m-%d %H:%M:%S %z")
    except (ValueError, OverflowError, OSError):  # not a time: print the server's text as it is
        return printable(text)


def size(count: float) -> str:
    """Format a number of bytes in binary units."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"


ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INSISTING = (signal.SIGINT, signal.SIGTERM)
"""Signals whose repetition ends the run at once. SIGHUP is excluded, because a closing terminal may send it
repeatedly."""
GRACE_S = 2.0
"""Seconds that a run has to unwind after the second signal before the process is terminated."""


def end_on_interrupt() -> None:
    """Make Ctrl-C end the process at once. During startup nothing needs saving, and an interrupted
    import would print a traceback."""
    signal.signal(signal.SIGINT, _end)


def _end(number: int, frame: FrameType | None) -> None:
    _say("interrupted")
    end_now()


def end_now() -> None:
    """End the process with exit code 130 at once, without unfinished files. Threads that still compute in compiled code would
    abort an ordinary end.
    """
    # Absent until the module is imported, and while an interrupt ends its import. Nothing is unfinished then.
    remove_unfinished = getattr(sys.modules.get("gsplat_core.io.files"), "remove_unfinished", None)
    if remove_unfinished is not None:
        remove_unfinished()
    os._exit(INTERRUPTED)


class InterruptRequest:
    """Context manager that turns SIGINT, SIGTERM and SIGHUP into a flag, acknowledged on stderr at
    once. Calling the object returns the flag.

    A second SIGINT or SIGTERM raises KeyboardInterrupt. If a long computation blocks that for
    GRACE_S, the process is terminated.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, object] = {}
        self._wakeup_before = -1

    def __call__(self) -> bool:
        return self.requested

    def __enter__(self) -> InterruptRequest:
        # The interpreter writes signal numbers into the pipe at arrival; handlers run only when the
        # main thread returns to Python code.
        receiver, self._sender = os.pipe()
        os.set_blocking(self._sender, False)
        self._wakeup_before = signal.set_wakeup_fd(self._sender, warn_on_full_buffer=False)
        for number in ASKING:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # SIGHUP is ignored under nohup, so that the run survives its terminal
            self._before[number] = signal.signal(number, self._handle)
        threading.Thread(target=_acknowledge, args=(receiver,), name="signals", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        signal.set_wakeup_fd(self._wakeup_before)
        os.close(self._sender)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested and number in INSISTING:
            raise KeyboardInterrupt
        self.requested = True


def _acknowledge(receiver: int) -> None:
    """Acknowledge each signal at its arrival, until the write end of the pipe is closed."""
    seen = 0
    ended = threading.Event()
    with os.fdopen(receiver, "rb", buffering=0) as signals:
        while numbers := signals.read(64):
            for number in numbers:
                if number not in ASKING or (seen and number not in INSISTING):
                    continue
                seen += 1
                if seen == 1:
                    _say(
                        "interrupted: finishing the frame on its way, then writing what there is; once more ends at once"
                    )
                elif seen == 2:
                    _say("interrupted again: ending at once")
                    threading.Thread(target=_end_after, args=(ended,), name="end", daemon=True).start()
    ended.set()


def _end_after(ended: threading.Event) -> None:
    if not ended.wait(GRACE_S):
        end_now()


def _say(text: str) -> None:
    """Write a line to stderr from any thread, bypassing buffers."""
    with contextlib.suppress(OSError):  # the terminal is closed
        os.write(2, f"{text}\n".encode())


PLAIN_PERIOD_S = 5.0


class ProgressPrinter:
    """Context manager that prints `Progress` events."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._terminal = not quiet and sys.stderr.isatty()
        self._stage = ""
        self._printed_s = 0.0
        self._measured_from: tuple[float, int] | None = None
        self._bar: Bar | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> ProgressPrinter:
        if self._terminal:
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeElapsedColumn,
                TimeRemainingColumn,
            )

            self._bar = Progress(
                TextColumn("[bold]{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TextColumn("[cyan]{task.fields[quality]}"),
                TimeElapsedColumn(),
                TextColumn("eta"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, progress: Progress) -> None:
        """Update the bar on a terminal. Otherwise print a line at the start, after the first frame and at the end of a
        stage, and every `PLAIN_PERIOD_S` seconds in between. Nothing if quiet."""
        if self._quiet:
            return
        now_s = time.monotonic()
        first = progress.stage != self._stage
        if first:
            self._stage, self._printed_s, self._measured_from = progress.stage, now_s, None
        begun = self._measured_from is None and progress.done > 0
        if begun:
            # The first frame initialises the model and is far slower, so the rate excludes it.
            self._measured_from = now_s, progress.done
        rate = 0.0
        if self._measured_from and now_s > self._measured_from[0]:
            rate = (progress.done - self._measured_from[1]) / (now_s - self._measured_from[0])
        quality = _quality(progress)
        rate_text = f"{rate:.1f} {progress.unit}/s" if rate else ""
        if self._bar is not None:
            if first:
                self._task = self._bar.add_task(progress.stage, total=progress.total, rate="", quality="")
            assert self._task is not None
            self._bar.update(self._task, completed=progress.done, rate=rate_text, quality=quality)
            return
        finished = progress.done == progress.total
        if not (first or begun or finished or now_s - self._printed_s >= PLAIN_PERIOD_S):
            return
        self._printed_s = now_s
        parts = [f"{progress.stage} {progress.done}/{progress.total}"]
        if rate:
            parts.append(rate_text)
            if not finished:
                parts.append(f"eta {(progress.total - progress.done) / rate:.0f} s")
        if quality:
            parts.append(quality)
        print("  ".join(parts), file=sys.stderr, flush=True)  # noqa: T201


def _quality(progress: Progress) -> str:
    """Return the PSNR of the newest frame with its kind of error and the trivial baseline; empty without a score."""
    if progress.psnr_tissue_db is None:
        return ""
    kind = "training error" if progress.trained else "held out"
    beside = "" if progress.previous_frame_db is None else f", previous frame {progress.previous_frame_db:.2f} dB"
    return f"{progress.psnr_tissue_db:.2f} dB ({kind}{beside})"
