"""Command line interface `intrasplat`. Imports are fast because each command imports its
dependencies when it runs."""

import os
import sys


def main() -> None:
    """Run the console script. Exits with 0, 1 (bug), 2 (bad input), 3 (no frame shown), 130
    (interrupted) or 141 (output closed)."""
    # Until the handler below is set, Ctrl-C during an import would print a traceback. The built-in
    # module loads at once.
    import _signal  # type: ignore[import-not-found]

    _signal.signal(_signal.SIGINT, lambda number, frame: os._exit(130))
    from services.cli.interrupt import end_on_interrupt
    from services.cli.streams import StandardStreams

    end_on_interrupt()
    streams = StandardStreams()
    # Threads of the C++ core that wait must sleep, not spin: on a busy machine spinning can make a render many times slower. Read once,
    # when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # numpy's BLAS rounds differently with another number of threads. With one, results do not depend on the machine's cores or on this
    # variable's value. Read once, when numpy is imported.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    from services.cli.app import run

    sys.exit(streams.code(run(sys.argv[1:])))
