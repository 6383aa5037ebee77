"""Conversion of errors to exit codes and messages."""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Iterable, Iterator

from services.cli.terminal import INTERRUPTED as INTERRUPTED
from services.cli.terminal import sentence

OK = 0
BUG = 1
BAD_INPUT = 2
NOTHING_SHOWN = 3
"""Exit code of a regular run that showed no frame."""

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
"""System errors that are independent of the file, with their remedies."""
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
