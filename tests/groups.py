"""Run the tests in groups, several at a time, each in a fork of a process that has imported the large libraries.

    python -m tests.groups [--fast | --again] [--jobs JOBS] [GROUP ...]

The output of a group is printed when the group has ended. It stays in `build/tests`, with the group's exit code and failed tests.
"""

from __future__ import annotations

import argparse
import atexit
import gc
import importlib
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.forks import ROOT, THREADS, Fork, import_libraries

GROUPS: dict[str, tuple[str, ...]] = {
    "system": ("tests/system",),
    "registry": tuple(
        f"tests/services/{name}" for name in ("registry", "jobs", "exports", "audit", "supervisor", "recordings")
    ),
    "rest": ("tests",),
    "training": ("tests/gsplat_core/training", "tests/gsplat_core/experimental", "tests/gsplat_core/evaluation"),
    "operators": ("tests/operators",),
    "services": ("tests/services",),
    "ops": ("tests/gsplat_core/ops", "tests/gsplat_core/rendering", "tests/gsplat_core/deformation"),
    "programs": ("tests/attacks", "tests/test_examples.py", "tests/recipes", "tests/deploy"),
    "geometry": ("tests/gsplat_core/geometry",),
}
"""Folders and files of each group, without those that another group names. Groups that take long come first, those with most of the slow tests before others."""
PROJECT = ("operators.applications.replay", "services.cli.app", "services.api.app")
"""Modules of the project that most groups import, with what these import."""
RESULTS = ROOT / "build" / "tests"
FAILED = 1
"""Exit code of pytest if tests failed."""
INTERRUPTED = 130


def tests_of(group: str) -> list[str]:
    """Return pytest's arguments that select the tests of a group."""
    own = GROUPS[group]
    others = [path for name, paths in GROUPS.items() if name != group for path in paths]
    inside = [path for path in others if any(Path(folder) in Path(path).parents for folder in own)]
    return [*own, *(f"--ignore={path}" for path in inside)]


def failed_groups(groups: Sequence[str], results: Path) -> list[str]:
    """Return the groups whose tests failed in the last run.

    Raises:
        SystemExit: if a group did not end, or ended with another error.
    """
    codes = {}
    for group in groups:
        try:
            codes[group] = int((results / f"{group}.code").read_text())
        except FileNotFoundError:
            sys.exit(f"the tests of {group} did not end: run them again")
    for group, code in codes.items():
        if code not in (0, FAILED):
            sys.exit(f"the tests of {group} ended with code {code}: see {results / group}.txt")
    return [group for group, code in codes.items() if code]


def run(groups: Sequence[str], options: Sequence[str], jobs: int, results: Path) -> int:
    """Run groups in forks of this process and return the exit code.

    Args:
        groups: names of groups.
        options: options for pytest.
        jobs: number of groups that run at the same time.
        results: folder for output, exit codes and failed tests.
    """
    results.mkdir(parents=True, exist_ok=True)
    for group in groups:
        (results / f"{group}.code").unlink(missing_ok=True)
    gc.collect()
    gc.freeze()  # so that collections in forks do not copy the memory of this process

    def tests(group: str) -> Fork:
        def call() -> int:
            code = int(pytest.main([*options, "-o", f"cache_dir={results / group}", *tests_of(group)]))
            atexit._run_exitfuncs()  # pytest removes old temporary folders
            return code

        return Fork(call, results / f"{group}.txt")

    waiting, running, codes = list(groups), {}, {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                group = waiting.pop(0)
                running[group] = tests(group)
            time.sleep(0.05)
            for group in [name for name, fork in running.items() if fork.ended()]:
                fork = running.pop(group)
                codes[group] = fork.code
                (results / f"{group}.code").write_text(str(fork.code))
                print(f"== {group}: code {fork.code}\n{fork.output.read_text(errors='replace')}", flush=True)
    except KeyboardInterrupt:
        for fork in running.values():
            fork.interrupt()
        for group, fork in running.items():
            fork.wait()
            print(f"== {group}: interrupted\n{fork.output.read_text(errors='replace')}", flush=True)
        return INTERRUPTED
    bad = [group for group, code in codes.items() if code]
    print(f"== {len(codes) - len(bad)} of {len(codes)} groups passed{'; failed: ' if bad else ''}{', '.join(bad)}")
    return FAILED if bad else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=", ".join(GROUPS))
    parser.add_argument("--fast", action="store_true", help="leave out the tests marked as slow")
    parser.add_argument(
        "--again", action="store_true", help="run the tests that failed in the last run, one group at a time"
    )
    # More than cores, because many tests wait for processes.
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)) + 2, help="groups at a time (default: %(default)s)"
    )
    chosen = parser.parse_args()
    unknown = set(chosen.groups) - set(GROUPS)
    if unknown:
        parser.error(f"there is no group {', '.join(sorted(unknown))}; the groups are {', '.join(GROUPS)}")
    groups, options, jobs = chosen.groups or list(GROUPS), [], chosen.jobs
    if chosen.fast:
        options += ["-m", "not slow"]
    if chosen.again:
        groups, jobs = failed_groups(groups, RESULTS), 1
        options += ["--last-failed", "--last-failed-no-failures=none"]
    if not groups:
        return 0
    os.chdir(ROOT)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    import_libraries()
    for name in PROJECT:
        importlib.import_module(name)
    threads = len(os.listdir("/proc/self/task"))
    if threads > 1:
        sys.exit(
            f"the imports started {threads - 1} threads, which a fork would not have: set {', '.join(THREADS)} to 1"
        )
    # The libraries imported plugins of pytest, whose assertions are therefore not rewritten.
    return run(groups, ["-W", "ignore::pytest.PytestAssertRewriteWarning", *options], jobs, RESULTS)


if __name__ == "__main__":
    sys.exit(main())
