"""The `intrasplat` command. Importing this package is quick: a command imports what it needs when it runs."""

import sys


def main() -> None:
    """Entry point of the console script; exits with 0, 1 (a bug), 2 (bad input) or 130 (interrupted)."""
    from services.cli.app import run

    sys.exit(run(sys.argv[1:]))
