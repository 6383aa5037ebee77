"""The one place where errors become exit codes and sentences."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator

OK = 0
BUG = 1
BAD_INPUT = 2
INTERRUPTED = 130


def exit_code_of(error: BaseException) -> int:
    """Print what went wrong to stderr and return the exit code.

    An error on purpose whose cause the user can change (a file, an option, a disk) is one sentence and 2. Everything else is a bug
    in this program: traceback and 1.
    """
    if isinstance(error, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)  # noqa: T201
        return INTERRUPTED
    sentence = user_sentence(error)
    if sentence is not None:
        print(f"error: {sentence}", file=sys.stderr)  # noqa: T201
        return BAD_INPUT
    traceback.print_exception(error)
    print("error: this is a bug in intrasplat; please report it with the lines above", file=sys.stderr)  # noqa: T201
    return BUG


def user_sentence(error: BaseException) -> str | None:
    """What happened, the value, what to do; None for a bug."""
    from gsplat_core.errors import CoreError
    from operators.errors import EngineError, OperatorFailed, OutputError, RunError, RunFailed

    where = ""
    for link in _causes(error):
        if isinstance(link, OperatorFailed):
            # The operator is where it happened; its cause is what happened.
            frame = "" if link.seq is None else f" on frame {link.seq}"
            where = f"\n  in operator {link.operator}{frame}"
        elif isinstance(link, RunFailed):
            continue  # says that a run ended early; what it is raised from says why
        elif isinstance(link, CoreError | EngineError | OutputError | RunError):
            return f"{link}{where}"
        elif isinstance(link, OSError) and link.filename is not None:
            return f"{link.filename}: {link.strerror}; check the path and its permissions{where}"
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__
