"""Run a program written for gsplat: `python -m gsplat_core.as_gsplat SCRIPT [ARGUMENTS]`."""

from __future__ import annotations

import argparse
import importlib.util
import runpy
import sys
from pathlib import Path

from gsplat_core.as_gsplat import CONSTANTS, install_for_spawned_processes


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
    if not chosen.by_name and Path(program).is_dir() and not Path(program, "__main__.py").exists():
        parser.error(f"{program} is a folder without __main__.py; give a script in it")
    sys.argv = [program, *chosen.arguments]
    if chosen.by_name:
        sys.path.insert(0, "")
        install_for_spawned_processes(chosen.constants)
        if not _is_module(program):
            parser.error(f"there is no module {program}")
        runpy.run_module(program, run_name="__main__", alter_sys=True)
    else:
        # Python does the same for a script that it runs, so that the script finds the modules in its folder.
        sys.path.insert(0, str(Path(program).resolve().parent))
        install_for_spawned_processes(chosen.constants)
        runpy.run_path(program, run_name="__main__")


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


if __name__ == "__main__":
    main()
