"""Command line interface `intrasplat`. Imports are fast because each command imports its dependencies when it runs."""

import os
import sys


def main() -> None:
    """Run the console script. Exits with 0, 1 (bug), 2 (bad input), 3 (no frame shown), 130
    (interrupted) or 141 (output closed)."""
    # Until the handler below is set, Ctrl-C during an import would print a traceback. The built-in
    # module loads at once.
    import _signal  # type: ignore[import-not-found]

    _signal.signal(_signal.SIGINT, lambda number, frame: os._exit(130))
    from services.cli.terminal import INTERRUPTED, StandardStreams, end_now, end_on_interrupt

    end_on_interrupt()
    streams = StandardStreams()
    # Waiting threads of the C++ core must sleep, because spinning can slow down a render many times
    # on a busy machine. The variable is read once, when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # numpy's BLAS rounds differently with another number of threads. One thread makes results
    # independent of the number of cores. The variable is read once, when numpy is imported.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    from services.cli.app import run

    code = streams.code(run(sys.argv[1:]))
    if code == INTERRUPTED:
        end_now()
    sys.exit(code)
