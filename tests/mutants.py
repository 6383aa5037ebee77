"""Mutation testing: change one line of the product at a time and count the changes tests notice.

    python -m tests.mutants --count 60 --seed 1            # as in `make mutants`
    python -m tests.mutants --only operators/display.py --count 10
    python -m tests.mutants --survivors out/mutants.jsonl   # only survivors of an earlier run

A mutant is a module with one changed expression: a comparison reversed or shifted at its boundary,
an arithmetic operator or number replaced, `and` swapped with `or`, `min` with `max`, a condition
negated, or a call removed. Tests run with the mutant in place of the module, in all processes that
they start. Each run is a fork of one process that has imported the large libraries. No file of the
checkout is changed. Test files named after the module run first, then those that import it, then
those that import it indirectly. A run ends at the first failure. A test that also fails without the
mutant is flaky: it is listed and excluded, and the remaining tests decide. A mutant survives if all
of them pass. Mutants are drawn at random with a seed, in equal parts from each folder.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = (
    "operators",
    "services",
    "gsplat_core/training",
    "gsplat_core/geometry",
    "gsplat_core/depth",
    "gsplat_core/poses",
    "gsplat_core/endoscope",
)
PACKAGES = ("gsplat_core", "operators", "services")
MOST_TEST_FILES = 24
"""Maximum number of test files in addition to those that import the module itself."""
LIMIT_S = 300.0
"""Time limit in seconds for one run of pytest. A mutant that exceeds it hangs and
counts as killed.
"""
NO_TESTS = 5
"""Exit code of pytest when every collected test is deselected."""
PRECHECK_FILES = 3
"""Number of test files in the first, short pytest run.

Most mutants are killed there without collecting the remaining files.
"""
COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.GtE, ast.LtE), ast.LtE: (ast.Gt, ast.Lt), ast.Gt: (ast.LtE, ast.GtE), ast.GtE: (ast.Lt, ast.Gt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
}  # fmt: skip
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
}  # fmt: skip
EXCHANGED = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}
UNSEEN_CALLS = {"debug", "info", "warning", "exception", "error", "log", "touch_progress"}
"""Calls with no effect except a log line, which are not mutated."""

LIBRARIES = ("torch", "numpy", "cv2", "pydantic", "fastapi", "uvicorn", "zmq", "httpx", "typer", "onnx")
"""Libraries that take long to import. None of them imports the project."""
SINGLE = ("PYTHONDONTWRITEBYTECODE", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables that are 1 for all tests: no bytecode of a mutant is kept, and two runs share two cores."""
NO_RESULT = 70
"""Exit code of a fork in which pytest itself raised an exception."""

HOOK = """
import importlib.abc, importlib.machinery, importlib.util, os, sys

class Mutant(importlib.abc.MetaPathFinder):
    name, path, origin = {replaced}

    def find_spec(self, fullname, path, target=None):
        if fullname != self.name:
            return None
        locations = [os.path.dirname(self.origin)] if self.origin.endswith("__init__.py") else None
        loader = importlib.machinery.SourceFileLoader(fullname, self.path)
        return importlib.util.spec_from_file_location(fullname, self.path, loader=loader, submodule_search_locations=locations)

sys.meta_path.insert(0, Mutant())
"""


@dataclass(frozen=True)
class Mutant:
    """A changed module.

    Attributes:
        path: the module, relative to the root.
        line: line of the changed expression.
        change: the expression before and after.
        source: text of the changed module.
    """

    path: str
    line: int
    change: str
    source: str


@cache
def changeable(path: Path) -> tuple[ast.Module, tuple[tuple[int, int], ...]]:
    """Return the tree of a module, and the node index and change number of each of its mutants."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    places = ((index, number) for index, node in enumerate(ast.walk(tree)) for number in range(len(_changes(node))))
    return tree, tuple(places)


def mutant_at(path: Path, index: int, number: int) -> Mutant | None:
    """Return one mutant of a module, or None where the change leaves the text as it is."""
    tree = copy.deepcopy(changeable(path)[0])
    node = next(each for place, each in enumerate(ast.walk(tree)) if place == index)
    before = ast.unparse(node)
    _changes(node)[number]()
    after = ast.unparse(node)
    if after == before:
        return None
    return Mutant(str(path.relative_to(ROOT)), getattr(node, "lineno", 0), f"{before}  =>  {after}", ast.unparse(tree))


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Return every mutant of a module."""
    return filter(None, (mutant_at(path, *place) for place in changeable(path)[1]))


def _changes(node: ast.AST) -> list[Callable[[], None]]:
    """Return functions that each change the node in place in one way."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        return [lambda new=new: node.ops.__setitem__(0, new()) for new in COMPARISONS.get(type(node.ops[0]), ())]
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS and not _is_text(node):
        return [lambda: setattr(node, "op", OPERATORS[type(node.op)]())]
    if isinstance(node, ast.BoolOp):
        return [lambda: setattr(node, "op", ast.Or() if isinstance(node.op, ast.And) else ast.And())]
    if isinstance(node, ast.If | ast.IfExp) and not _only_types(node.test):
        return [lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test))]
    if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in (0, 1, -1, 2):
        return [lambda: setattr(node, "value", node.value * (100 if isinstance(node.value, float) else 2))]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in EXCHANGED:
        return [lambda: setattr(node.func, "id", EXCHANGED[node.func.id])]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in EXCHANGED:
        return [lambda: setattr(node.func, "attr", EXCHANGED[node.func.attr])]
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and _called(node.value) not in UNSEEN_CALLS:
        return [lambda: setattr(node, "value", ast.Constant(None))]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        return [lambda: setattr(node, "op", ast.UAdd())]
    return []


def _called(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def _is_text(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    return any(
        isinstance(side, ast.JoinedStr) or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in sides
    )


def _only_types(test: ast.expr) -> bool:
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def module_name(path: str) -> str:
    """Import name of a module's path relative to the root."""
    name = path.removesuffix(".py").replace("/", ".")
    return name.removesuffix(".__init__")


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Return the project modules that a file imports, including imports inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(name for name in found if name.split(".")[0] in PACKAGES)


@cache
def importers() -> dict[str, frozenset[Path]]:
    """Return the product and test files that import each module."""
    found = defaultdict(set)
    for folder in (*PACKAGES, "tests"):
        for path in (ROOT / folder).rglob("*.py"):
            for name in imports_of(path):
                found[name].add(path)
    return {name: frozenset(paths) for name, paths in found.items()}


def tests_for(path: str) -> list[str]:
    """Return the test files for a mutant of a module, nearest first.

    Files named after the module in the mirrored folder come first, then other files of that name, then files that import the module, those in the
    mirrored folder before others. Files that import the module through other modules follow, breadth first.
    """
    name, stem = module_name(path), Path(path).stem
    mirror = ROOT / "tests" / Path(path).parent
    named = [each for each in sorted((ROOT / "tests").rglob("test_*.py")) if each.stem.startswith(f"test_{stem}")]
    direct = [each for each in sorted(importers().get(name, ())) if each.name.startswith("test_")]
    near = sorted(named, key=lambda each: each.parent != mirror)
    near += sorted(direct, key=lambda each: (each.parent != mirror, len(imports_of(each))))
    chosen = list(dict.fromkeys(near))
    seen, level = {name}, {name}
    while level and len(chosen) < MOST_TEST_FILES:
        above = {each for one in level for each in importers().get(one, ())}
        further = sorted(
            (each for each in above if each.name.startswith("test_")),
            key=lambda each: (each.parent != mirror, len(imports_of(each)), each),
        )
        chosen = list(dict.fromkeys([*chosen, *further]))
        level = {
            module_name(str(each.relative_to(ROOT))) for each in above if each.parts[len(ROOT.parts)] in PACKAGES
        } - seen
        seen |= level
    return [str(each.relative_to(ROOT)) for each in chosen[: max(MOST_TEST_FILES, len(near))]]


@dataclass(frozen=True)
class Outcome:
    """Result of the tests of a mutant.

    Attributes:
        killed_by: the first test that fails only with the mutant, `time` where the tests do not end, `pytest itself` where
            it dies or cannot load a conftest, None where the mutant survives.
        flaky: tests that also fail without the mutant.
    """

    killed_by: str | None
    flaky: tuple[str, ...] = ()


def failed_test(output: str) -> str | None:
    """Return the id of the first failed test in pytest's output, or None. Captured log lines may begin with ERROR, too."""
    for line in output.splitlines():
        if line.startswith(("FAILED tests/", "ERROR tests/")):
            return line.split(" - ")[0].split(" ", 1)[1].strip()
    return None


def import_libraries() -> None:
    """Import the large libraries once. Every run of pytest is a fork of this process and does not import them again."""
    for name in LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(name)
    loaded = [name for name in sys.modules if name.split(".")[0] in PACKAGES]
    if loaded:
        sys.exit(f"the libraries imported {loaded[0]}: a mutant of it would not be loaded")


def run_pytest(arguments: list[str], folder: Path, hooked: bool) -> tuple[int | None, str]:
    """Run pytest in a fork of this process.

    Args:
        arguments: options and test files.
        folder: folder with `sitecustomize.py` and the changed module; receives the output.
        hooked: whether the mutant replaces its module, here and in the processes that tests start.

    Returns:
        The exit code, negative where a signal ended pytest, None after `LIMIT_S`; and the output.
    """
    output = folder / "output.txt"
    child = os.fork()
    if child == 0:
        code = NO_RESULT
        try:
            os.setsid()
            file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(file, 1)
            os.dup2(file, 2)
            if hooked:
                os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
                exec(compile((folder / "sitecustomize.py").read_text(encoding="utf-8"), "sitecustomize.py", "exec"), {})
            code = int(pytest.main(arguments))
        finally:
            if sys.exc_info()[0] is not None:
                traceback.print_exc()
            sys.stdout.flush()
            os._exit(code)
    deadline = time.monotonic() + LIMIT_S
    status = None
    while status is None and time.monotonic() < deadline:
        ended, waited = os.waitpid(child, os.WNOHANG)
        status = waited if ended else None
        if status is None:
            time.sleep(0.02)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # processes that its tests started and left running
    if status is None:
        os.waitpid(child, 0)
    text = output.read_text(encoding="utf-8", errors="replace") if output.exists() else ""
    return None if status is None else os.waitstatus_to_exitcode(status), text


def outcome_of(mutant: Mutant, folder: Path) -> Outcome:
    """Run the tests of a mutant, nearest files first, up to the first failure that the mutant causes."""
    files = tests_for(mutant.path)
    source = folder / "mutant.py"
    source.write_text(mutant.source, encoding="utf-8")
    replaced = (module_name(mutant.path), str(source), str(ROOT / mutant.path))
    (folder / "sitecustomize.py").write_text(HOOK.format(replaced=replaced), encoding="utf-8")
    options = ["-x", "-q", "--no-header", "-p", "no:cacheprovider", "-m", "not slow"]
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # plugins that the libraries imported before pytest
    flaky: list[str] = []
    for group in filter(None, (files[:PRECHECK_FILES], files[PRECHECK_FILES:])):
        while True:
            arguments = [*options, *(f"--deselect={each}" for each in flaky), *group]
            code, output = run_pytest(arguments, folder, hooked=True)
            if code is None:
                return Outcome("time", tuple(flaky))
            if code in (0, NO_TESTS):
                break
            test = failed_test(output)
            if test is None and run_pytest([*arguments, "--collect-only"], folder, hooked=False)[0] == 0:
                return Outcome("pytest itself", tuple(flaky))
            if test is None or test in flaky:
                sys.exit(f"pytest ended with {code} and names no new failed test:\n{output[-4000:]}")
            if run_pytest([*options, test], folder, hooked=False)[0] == 0:
                return Outcome(test, tuple(flaky))
            flaky.append(test)
    return Outcome(None, tuple(flaky))


def chosen_mutants(only: list[str] | None, count: int, seed: int) -> list[Mutant]:
    """Draw random mutants, in equal parts from each folder, in random order: the first ones are a sample, too."""
    rng = random.Random(seed)
    groups = [[ROOT / each for each in only]] if only else [sorted((ROOT / folder).rglob("*.py")) for folder in FOLDERS]
    chosen: list[Mutant] = []
    for number, files in enumerate(groups):
        share = count * (number + 1) // len(groups) - count * number // len(groups)
        weights = [max(1, len(file.read_text(encoding="utf-8"))) for file in files]
        seen: set[tuple[str, str]] = set()
        for _ in range(share * 20):
            if share == 0:
                break
            file = rng.choices(files, weights)[0]
            places = changeable(file)[1]
            mutant = mutant_at(file, *rng.choice(places)) if places else None
            if mutant is not None and (mutant.path, mutant.change) not in seen:
                seen.add((mutant.path, mutant.change))
                chosen.append(mutant)
                share -= 1
    rng.shuffle(chosen)
    return chosen


def timed_outcome(run: tuple[Mutant, Path]) -> tuple[Mutant, Outcome, float]:
    """Return a mutant with its outcome and the seconds that took; the folder is created."""
    mutant, folder = run
    folder.mkdir()
    start = time.perf_counter()
    return mutant, outcome_of(mutant, folder), time.perf_counter() - start


def survivors_of(log: Path) -> list[Mutant]:
    """Return the survivors of an earlier run whose expressions still exist."""
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    wanted = {(line["path"], line["change"]) for line in lines if "path" in line and line["killed_by"] is None}
    return [
        each
        for path in sorted({path for path, _ in wanted})
        for each in mutants_of(ROOT / path)
        if (path, each.change) in wanted
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="modules to change")
    parser.add_argument("--survivors", type=Path, help="log of an earlier run; only mutants that survived it")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "mutants.jsonl")
    parser.add_argument("--least", type=float, default=0.85, help="exit code 1 where a smaller share is killed")
    options = parser.parse_args()
    os.environ.update({name: "1" for name in SINGLE})
    sys.dont_write_bytecode = True
    chosen = (
        survivors_of(options.survivors)
        if options.survivors
        else chosen_mutants(options.only, options.count, options.seed)
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    killed, flaky = 0, set[str]()
    with tempfile.TemporaryDirectory() as folder, options.out.open("w", encoding="utf-8") as log:
        import_libraries()
        runs = [(mutant, Path(folder) / str(number)) for number, mutant in enumerate(chosen)]
        with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("fork")) as pool:
            for finished in as_completed(pool.submit(timed_outcome, run) for run in runs):
                mutant, outcome, seconds = finished.result()
                by = outcome.killed_by
                killed += by is not None
                flaky.update(outcome.flaky)
                result = {"path": mutant.path, "line": mutant.line, "change": mutant.change, "killed_by": by}
                log.write(json.dumps(result | {"flaky": outcome.flaky, "seconds": round(seconds, 1)}) + "\n")
                log.flush()
                print(
                    f"{'killed  ' if by else 'SURVIVED'} {mutant.path}:{mutant.line} {mutant.change[:120]!r}",
                    flush=True,
                )
    for test in sorted(flaky):
        print(f"flaky: {test} fails without a mutant, too")
    share = killed / max(1, len(chosen))
    print(f"{killed} of {len(chosen)} mutants killed ({share:.0%}); {options.out}")
    return 0 if share >= options.least else 1


if __name__ == "__main__":
    sys.exit(main())
