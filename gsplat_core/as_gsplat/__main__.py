"""Run a program written for gsplat: `python -m gsplat_core.as_gsplat SCRIPT [ARGUMENTS]`."""

from __future__ import annotations

import argparse
import runpy
import sys
from pathlib import Path

from gsplat_core.as_gsplat.finder import CONSTANTS, install


def main() -> None:
    """Run the program that the arguments name, with `import gsplat` served by this package."""
    parser = argparse.ArgumentParser(
        prog="python -m gsplat_core.as_gsplat",
        usage="%(prog)s [--constants 1.5.3] SCRIPT [ARGUMENTS]   or   %(prog)s [--constants 1.5.3] -m MODULE [ARGUMENTS]",
        description="Run a program written for gsplat with this package in place of gsplat.",
    )
    parser.add_argument("--constants", choices=CONSTANTS, default="1.6", help="gsplat version of numerical constants")
    parser.add_argument("-m", dest="by_name", action="store_true", help="the program is a module")
    parser.add_argument("program", help="path of the script, or name of the module")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="arguments of the program")
    chosen = parser.parse_args()
    program: str = chosen.program
    if not chosen.by_name and not Path(program).exists():
        parser.error(f"{program} does not exist")
    install(chosen.constants)
    sys.argv = [program, *chosen.arguments]
    if chosen.by_name:
        sys.path.insert(0, "")
        runpy.run_module(program, run_name="__main__", alter_sys=True)
    else:
        # As when Python itself runs a script, so that the script finds the modules in its folder.
        sys.path.insert(0, str(Path(program).resolve().parent))
        runpy.run_path(program, run_name="__main__")


if __name__ == "__main__":
    main()
