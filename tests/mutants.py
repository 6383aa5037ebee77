"""Mutation testing: change one line of the product at a time and count the changes tests notice.

    python -m tests.mutants --count 60 --seed 1            # as in `make mutants`
    python -m tests.mutants --only operators/display.py --count 10
    python -m tests.mutants --only services/audit --count 40
    python -m tests.mutants --survivors out/mutants.jsonl   # only survivors of an earlier run

A mutant is a module with one changed expression: a comparison reversed or shifted at its boundary,
an arithmetic operator or number replaced (a tiny one by 0), `and` swapped with `or`, `min` with `max`, a condition
negated, or a call removed. One pytest session collects the tests and runs each mutant in a fork of
itself. There the code of the changed function is replaced in the loaded functions. Processes that
tests start, and modules not yet imported, import the mutant in place of the module. A change outside
functions, or in one that the module itself calls, needs a session of its own. No file of the checkout is changed.

Only tests that execute the changed line run, for a minute at most; `tests/executed.py` records them.
A mutant on a line that no test executes survives. A run ends at the first failure. A test that also
fails without the mutant is flaky: it is listed and excluded, and the remaining tests decide. Mutants
are drawn at random with a seed, in equal parts from each folder. Without a GPU, what runs on one only is
left out. Log lines and examples in schemas are left out as well, because only people read them.

The boundary of a comparison (`<` to `<=`) is shifted only where an integer is compared, by its text. Of 63
boundaries drawn from all folders, the rule leaves out 44. 34 of them compare measured numbers or clock times,
where equality does not occur and the change is none; the other ten compare integers that the text does not show.
"""

from __future__ import annotations

import argparse
import ast
import copy
import gc
import json
import math
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest
import torch

from tests.executed import Executed, bring_up_to_date
from tests.forks import RAISED, ROOT, Fork, execute_everywhere, import_libraries_alone, pytest_fork

PARTS = ("training", "geometry", "depth", "poses", "endoscope", "experimental")
"""Packages of the core that are sampled, wherever they are in its tree. Kernels and data classes are left out."""
MOST_S = 60.0
"""Seconds of tests, as recorded, that run for a mutant."""
SLOWER, LEAST_LIMIT_S = 5.0, 30.0
"""A test hangs, which counts as killed, after this multiple of its recorded time and these seconds."""
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
APART = "apart"
"""Name in place of a failed test's where the loaded functions cannot be replaced."""
COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.GtE, ast.LtE), ast.LtE: (ast.Gt, ast.Lt), ast.Gt: (ast.LtE, ast.GtE), ast.GtE: (ast.Lt, ast.Gt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
}  # fmt: skip
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
}  # fmt: skip
TINY = 1e-5
"""Smaller numbers are replaced by 0, others multiplied. A floor against division by zero a hundred times as large still has no effect
on other values, so that no test could notice it; without the floor, a test of its case fails."""
EXCHANGED = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}
COUNTS = {
    "count", "counts", "frames", "bytes", "number", "seq", "size", "rows", "columns", "attempts", "characters", "points",
    "matches", "lines", "entries", "levels", "steps", "rounds", "width", "height", "length",
}  # fmt: skip
"""Last words of names of integers. Boundaries are shifted only where an integer is compared."""
UNSEEN_CALLS = {"debug", "info", "warning", "exception", "error", "log", "touch_progress", "_reached", "reached"}
"""Calls with no effect except a log line or a stop in a test of crashes, which are not mutated."""

HOOK = """
from importlib.machinery import SourceFileLoader

def get_code(loader, name, usual=SourceFileLoader.get_code):
    if loader.path != {origin!r}:
        return usual(loader, name)
    with open({mutant!r}, encoding="utf-8") as file:
        return compile(file.read(), loader.path, "exec", dont_inherit=True)

SourceFileLoader.get_code = get_code
"""
"""Code that lets this process load the mutant in place of its module, by name or by path."""


@dataclass(frozen=True)
class Mutant:
    """A changed module.

    Attributes:
        path: the module, relative to the root.
        line: line of the changed expression.
        kind: kind of the change.
        change: the expression before and after.
        tree: the changed module.
        inside: whether the change is inside a function that does not run when the module is loaded.
    """

    path: str
    line: int
    kind: str
    change: str
    tree: ast.Module
    inside: bool


@cache
def changeable(path: Path) -> tuple[ast.Module, tuple[ast.AST, ...], tuple[tuple[int, int], ...]]:
    """Return the tree of a module, its nodes, and the node index and change number of each of its mutants."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    parts = [*_only_read(tree), *(() if torch.cuda.is_available() else _on_gpu(tree))]
    unused = {id(node) for each in parts for node in ast.walk(each)}
    nodes = tuple(ast.walk(tree))
    places = (
        (index, number)
        for index, node in enumerate(nodes)
        if id(node) not in unused
        for number in range(len(_changes(node)))
    )
    return tree, nodes, tuple(places)


def _only_read(tree: ast.Module) -> Iterator[ast.AST]:
    """Return the parts of a module that only people read: the arguments of log lines, and examples in schemas."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield from (each.value for each in node.keywords if each.arg in ("examples", "json_schema_extra"))
            is_of_log = isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name)
            if is_of_log and node.func.value.id == "log" and _called(node) in UNSEEN_CALLS:
                yield from node.args


def _on_gpu(tree: ast.Module) -> Iterator[ast.AST]:
    """Return the parts of a module that run on a GPU only.

    These are classes that capture CUDA graphs, classes that only these use, and what `device.type == "cuda"` guards: the
    body of an `if`, operands of the same `and`, and statements after an early return.
    """
    of_graphs = [each for each in tree.body if isinstance(each, ast.ClassDef) and "GraphMemory" in _names(each)]
    used = set().union(*map(_names, of_graphs))
    used -= set().union(*(_names(each) for each in tree.body if each not in of_graphs))
    yield from of_graphs
    yield from (each for each in tree.body if isinstance(each, ast.ClassDef) and each.name in used)
    guards = {
        node.targets[0].id for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and _asks_for_gpu(node.value, set())
    }  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.BoolOp) and _asks_for_gpu(node, guards):
            yield from (each for each in node.values if not _asks_for_gpu(each, guards))
        if isinstance(node, ast.If | ast.IfExp) and _asks_for_gpu(node.test, guards):
            yield from node.body if isinstance(node.body, list) else [node.body]
        for block in (getattr(node, "body", None), getattr(node, "orelse", None)):
            for place, each in enumerate(block if isinstance(block, list) else ()):
                if isinstance(each, ast.If) and _excludes_gpu(each.test) and isinstance(each.body[-1], ast.Return):
                    yield from block[place + 1 :]


def _names(tree: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _asks_for_gpu(test: ast.expr, guards: set[str]) -> bool:
    """Return True if an expression is true on a GPU only; `guards` are names with such values."""
    if isinstance(test, ast.BoolOp):
        return isinstance(test.op, ast.And) and any(_asks_for_gpu(each, guards) for each in test.values)
    return (isinstance(test, ast.Name) and test.id in guards) or _compares_with_gpu(test, ast.Eq)


def _excludes_gpu(test: ast.expr) -> bool:
    if isinstance(test, ast.BoolOp):
        return isinstance(test.op, ast.Or) and any(map(_excludes_gpu, test.values))
    return _compares_with_gpu(test, ast.NotEq)


def _compares_with_gpu(test: ast.expr, kind: type[ast.cmpop]) -> bool:
    return (
        isinstance(test, ast.Compare)
        and isinstance(test.ops[0], kind)
        and isinstance(test.left, ast.Attribute)  # a setting of that value is tested without a GPU, too
        and test.left.attr == "type"
        and isinstance(test.comparators[0], ast.Constant)
        and test.comparators[0].value == "cuda"
    )


def change_at(path: Path, index: int, number: int) -> str | None:
    """Return the expression before and after a change, or None where the change leaves the text as it is."""
    node = changeable(path)[1][index]
    before = ast.unparse(node)
    changed = copy.deepcopy(node)
    _changes(changed)[number][1]()
    after = ast.unparse(changed)
    return None if after == before else f"{before}  =>  {after}"


def mutant_at(path: Path, index: int, number: int) -> Mutant | None:
    """Return one mutant of a module, or None where the change leaves the text as it is."""
    change = change_at(path, index, number)
    if change is None:
        return None
    tree = copy.deepcopy(changeable(path)[0])
    node = next(each for place, each in enumerate(ast.walk(tree)) if place == index)
    kind, apply = _changes(node)[number]
    apply()
    ast.fix_missing_locations(tree)
    line = getattr(node, "lineno", 0)
    around = {
        each.name for each in ast.walk(tree)
        if isinstance(each, FUNCTIONS) and each.body[0].lineno <= line <= (each.end_lineno or 0)
    }  # fmt: skip
    inside = bool(around) and not around & _called_on_import(tree)
    return Mutant(str(path.relative_to(ROOT)), line, kind, change, tree, inside)


def _called_on_import(tree: ast.Module) -> set[str]:
    """Return names of functions that statements outside functions and classes call, such as those that make tables."""
    outside = [each for each in tree.body if not isinstance(each, (*FUNCTIONS, ast.ClassDef))]
    calls = [node.func for each in outside for node in ast.walk(each) if isinstance(node, ast.Call)]
    return {each.id for each in calls if isinstance(each, ast.Name)}


def _changes(node: ast.AST) -> list[tuple[str, Callable[[], None]]]:
    """Return the kinds of changes to a node, each with a function that changes it in place."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        kinds = zip(
            ("comparison", "boundary")[: 1 + _of_integers(node)], COMPARISONS.get(type(node.ops[0]), ()), strict=False
        )
        return [(kind, lambda new=new: node.ops.__setitem__(0, new())) for kind, new in kinds]
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS and not _is_text(node):
        return [("arithmetic", lambda: setattr(node, "op", OPERATORS[type(node.op)]()))]
    if isinstance(node, ast.BoolOp):
        return [("and/or", lambda: setattr(node, "op", ast.Or() if isinstance(node.op, ast.And) else ast.And()))]
    if isinstance(node, ast.If | ast.IfExp) and not _only_types(node.test):
        return [("condition", lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test)))]
    if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in (0, 1, -1, 2):
        factor = 2 if isinstance(node.value, int) else 0 if abs(node.value) < TINY else 100
        return [("number", lambda: setattr(node, "value", node.value * factor))]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in EXCHANGED:
        return [("min/max", lambda: setattr(node.func, "id", EXCHANGED[node.func.id]))]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in EXCHANGED:
        return [("min/max", lambda: setattr(node.func, "attr", EXCHANGED[node.func.attr]))]
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and _called(node.value) not in UNSEEN_CALLS:
        return [("call", lambda: setattr(node, "value", ast.Constant(None)))]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        return [("sign", lambda: setattr(node, "op", ast.UAdd()))]
    return []


def _of_integers(node: ast.Compare) -> bool:
    sides = [side.operand if isinstance(side, ast.UnaryOp) else side for side in (node.left, *node.comparators)]
    names = [getattr(side, "id", "") or getattr(side, "attr", "") for side in sides]
    return (
        any(isinstance(side, ast.Call) and _called(side) == "len" for side in sides)
        or any(isinstance(side, ast.Constant) and type(side.value) is int and side.value != 0 for side in sides)
        or any(name.lower().split("_")[-1] in COUNTS for name in names)
    )


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


def tests_for(mutant: Mutant, executed: Executed) -> dict[str, float]:
    """Return the tests that execute a mutant's line with their seconds as recorded, up to `MOST_S`.

    Tests of files named after the module come first, then those of the mirrored folder. Quick tests come before slow ones.
    """
    mirror, stem = f"tests/{Path(mutant.path).parent}/", f"test_{Path(mutant.path).stem}"

    def rank(test: int) -> int:
        file = Path(executed.tests[test].split("::")[0])
        return 0 if file.stem.startswith(stem) else 1 if str(file).startswith(mirror) else 2

    chosen, total = {}, 0.0
    for test in sorted(executed.tests_of(ROOT / mutant.path, mutant.line), key=rank):
        total += executed.seconds[test]
        if total > MOST_S and chosen:
            break
        chosen[executed.tests[test]] = executed.seconds[test]
    return chosen


def replace_code(mutant: Mutant) -> bool:
    """Replace the code of changed functions in all loaded functions. Return False if the mutant must be imported instead."""
    path = str(ROOT / mutant.path)
    before = dict(_codes(compile(changeable(ROOT / mutant.path)[0], path, "exec", dont_inherit=True)))
    after = dict(_codes(compile(mutant.tree, path, "exec", dont_inherit=True)))
    gc.unfreeze()  # `get_objects` does not return frozen objects
    changed = {key: new for key, new in after.items() if before.get(key) != new}
    found = [each for each in gc.get_objects() if type(each) is FunctionType and each.__code__.co_filename == path]
    if not found:
        return module_name(mutant.path) not in sys.modules
    replaced = False
    for function in found:
        new = changed.get((function.__code__.co_qualname, function.__code__.co_firstlineno))
        if new is not None:
            if len(new.co_freevars) != len(function.__code__.co_freevars):
                return False
            function.__code__ = new
            replaced = True
    return replaced


def _codes(code: CodeType) -> Iterator[tuple[tuple[str, int], CodeType]]:
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield (each.co_qualname, each.co_firstlineno), each
            yield from _codes(each)


class Chosen:
    """Plugin of pytest that runs some of the collected tests up to the first failure.

    Args:
        tests: ids of the tests, or files of which all tests run.
        result: file for the id of the failed test; empty if all pass.
        seconds: recorded time of each test. A test that takes much longer ends the process by SIGALRM.
    """

    def __init__(self, tests: Container[str], result: Path, seconds: Mapping[str, float]) -> None:
        self.tests, self.result, self.seconds = tests, result, seconds
        self.failed: list[str] = []

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self.tests or item.nodeid.split("::")[0] in self.tests]

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.run(session.items)
        return True

    def pytest_sessionfinish(self) -> None:
        self.result.write_text("".join(self.failed[:1]), encoding="utf-8")

    def run(self, items: list[pytest.Item]) -> None:
        """Run tests up to the first failure and write its id to `result`."""
        for item, following in zip(items, [*items[1:], None], strict=True):
            if self.failed:
                break
            signal.alarm(math.ceil(LEAST_LIMIT_S + SLOWER * self.seconds.get(item.nodeid, MOST_S)))
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        signal.alarm(0)
        self.pytest_sessionfinish()


@dataclass
class Run:
    """Tests of a mutant, and their outcome.

    Attributes:
        tests: ids of the tests, quick and near ones first, with their seconds as recorded; or files of tests.
        number: number of the mutant.
        killed_by: the first test that fails only with the mutant, `time` where the tests do not end, `pytest itself` where
            it dies, None where the mutant survives.
        flaky: tests that also fail without the mutant.
        apart: whether the mutant must be imported by a session of its own.
    """

    mutant: Mutant
    tests: dict[str, float]
    number: int
    killed_by: str | None = None
    flaky: list[str] = field(default_factory=list)
    seconds: float = 0.0
    apart: bool = False


Start = Callable[[Run, "Mutant | None", list[str], Path], Fork]
"""Starts tests with a mutant or without one; the fork writes the id of the first failed test to a file `failed` in a folder."""


def judged(run: Run, folder: Path, start: Start) -> Iterator[Fork]:
    """Run the tests of a mutant up to the first failure that it causes. Yields each fork, and continues when it has ended."""
    begin = time.perf_counter()
    folder.mkdir()
    while run.tests:
        yield from _in_fork(fork := start(run, run.mutant, list(run.tests), folder))
        failed = _failed(fork, folder)
        run.apart = failed == APART
        if failed in run.tests:
            yield from _in_fork(fork := start(run, None, [failed], folder))
            if _failed(fork, folder):
                run.flaky.append(failed)
                run.tests.pop(failed)
                continue
        run.killed_by = failed or None
        break
    run.seconds = time.perf_counter() - begin
    shutil.rmtree(folder, ignore_errors=True)


def _in_fork(fork: Fork) -> Iterator[Fork]:
    while not fork.ended():
        yield fork


def _failed(fork: Fork, folder: Path) -> str:
    result = folder / "failed"
    if fork.code == RAISED:
        sys.exit(f"the session failed:\n{fork.output.read_text(encoding='utf-8', errors='replace')[-4000:]}")
    name = result.read_text(encoding="utf-8") if result.exists() else ""
    if fork.timed_out or fork.code == -signal.SIGALRM:
        name = "time"
    elif not name and (not result.exists() or fork.code == pytest.ExitCode.INTERNAL_ERROR):
        name = "pytest itself"  # it died, or a module ended the process while it was imported
    result.unlink(missing_ok=True)
    return name


def judge_all(runs: list[Run], jobs: int, folder: Path, start: Start, ended: Callable[[Run], None]) -> None:
    """Judge mutants, some at a time."""
    waiting = [(run, judged(run, folder / str(run.number), start)) for run in reversed(runs)]
    active: list[tuple[Run, Iterator[Fork]]] = []
    while waiting or active:
        active += [waiting.pop() for _ in range(min(len(waiting), jobs - len(active)))]
        left = []
        for run, steps in active:
            if next(steps, None) is None:
                ended(run)
            else:
                left.append((run, steps))
        active = left
        time.sleep(0.005)


class Collected:
    """Plugin of pytest that judges mutants with the tests it has collected. A fork of the session runs each mutant."""

    def __init__(self, runs: list[Run], jobs: int, folder: Path, ended: Callable[[Run], None]) -> None:
        self.runs, self.jobs, self.folder, self.ended = runs, jobs, folder, ended

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = {item.nodeid: item for item in session.items}
        for run in self.runs:
            whole = {name: 1.0 for name in items if name.split("::")[0] in run.tests}
            run.tests = whole | {name: seconds for name, seconds in run.tests.items() if name in items}

        def start(run: Run, mutant: Mutant | None, tests: list[str], folder: Path) -> Fork:
            def execute() -> int:
                os.environ["PYTEST_DEBUG_TEMPROOT"] = str(folder)
                if mutant is not None:
                    execute_everywhere(hook_of(mutant, folder), folder)
                    if not replace_code(mutant):
                        (folder / "failed").write_text(APART, encoding="utf-8")
                        return 0
                chosen = Chosen((), folder / "failed", run.tests)
                session.config.pluginmanager.register(chosen)
                chosen.run([items[name] for name in tests])
                return 0

            return Fork(execute, folder / "output.txt", limit_of(run))

        judge_all(self.runs, self.jobs, self.folder, start, self.ended)
        return True


def judge_apart(runs: list[Run], jobs: int, folder: Path, ended: Callable[[Run], None]) -> None:
    """Judge mutants with a session of pytest for each, which imports the mutant."""

    def start(run: Run, mutant: Mutant | None, tests: list[str], folder: Path) -> Fork:
        files = list(dict.fromkeys(test.split("::")[0] for test in tests))
        hook = "" if mutant is None else hook_of(mutant, folder)
        return pytest_fork(
            files, folder, Chosen(frozenset(tests), folder / "failed", run.tests), hook, limit_of(run) + LEAST_LIMIT_S
        )

    judge_all(runs, jobs, folder, start, ended)


def limit_of(run: Run) -> float:
    """Return the time limit of a mutant's tests in seconds."""
    return LEAST_LIMIT_S + SLOWER * sum(run.tests.values())


def hook_of(mutant: Mutant, folder: Path) -> str:
    """Write the module and return code that lets Python import it in place of the product's."""
    source = folder / "mutant.py"
    source.write_text(ast.unparse(mutant.tree), encoding="utf-8")
    return HOOK.format(mutant=str(source), origin=str(ROOT / mutant.path))


def folders() -> list[Path]:
    """Return the folders that are sampled in equal parts."""
    core = [
        path
        for path in sorted((ROOT / "gsplat_core").rglob("*"))
        if path.name in PARTS and (path / "__init__.py").exists()
    ]
    return [ROOT / "operators", ROOT / "services", *core]


def chosen_mutants(only: list[str] | None, count: int, seed: int) -> list[Mutant]:
    """Draw random mutants, in equal parts from each folder, in random order: the first ones are a sample, too."""
    rng = random.Random(seed)
    groups = (
        [
            [
                path
                for each in only
                for path in ([ROOT / each] if each.endswith(".py") else sorted((ROOT / each).rglob("*.py")))
            ]
        ]
        if only
        else [sorted(folder.rglob("*.py")) for folder in folders()]
    )
    chosen: list[Mutant] = []
    for number, files in enumerate(groups):
        share = count * (number + 1) // len(groups) - count * number // len(groups)
        weights = [max(1, len(file.read_text(encoding="utf-8"))) for file in files]
        seen: set[tuple[str, str]] = set()
        for _ in range(share * 20):
            if share == 0:
                break
            file = rng.choices(files, weights)[0]
            places = changeable(file)[2]
            mutant = mutant_at(file, *rng.choice(places)) if places else None
            if mutant is not None and (mutant.path, mutant.change) not in seen:
                seen.add((mutant.path, mutant.change))
                chosen.append(mutant)
                share -= 1
    rng.shuffle(chosen)
    return chosen


def lines_of(log: Path) -> list[dict[str, Any]]:
    """Return the results in a log."""
    return [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]


def survivors_of(log: Path) -> list[Mutant]:
    """Return the survivors of an earlier run whose expressions still exist."""
    wanted = {(line["path"], line["change"]) for line in lines_of(log) if line["killed_by"] is None}
    files = [ROOT / path for path in sorted({path for path, _ in wanted}) if (ROOT / path).exists()]
    places = [
        (file, place)
        for file in files
        for place in changeable(file)[2]
        if (str(file.relative_to(ROOT)), change_at(file, *place)) in wanted
    ]
    return [mutant for file, place in places if (mutant := mutant_at(file, *place)) is not None]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="modules or folders to change")
    parser.add_argument("--survivors", type=Path, help="log of an earlier run; only mutants that survived it")
    parser.add_argument("--tests", nargs="*", help="test files to run in place of those that execute the line")
    parser.add_argument("--stored", action="store_true", help="do not record changed test files again first")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "mutants.jsonl")
    parser.add_argument("--least", type=float, default=0.85, help="exit code 1 where a smaller share is killed")
    options = parser.parse_args()
    import_libraries_alone()
    if options.survivors:
        chosen = survivors_of(options.survivors)
    else:
        chosen = chosen_mutants(options.only, options.count, options.seed)
    if options.tests is None:
        if not options.stored:
            bring_up_to_date(options.jobs)
        executed = Executed()
        runs = [Run(mutant, tests_for(mutant, executed), number) for number, mutant in enumerate(chosen)]
        files = sorted({test.split("::")[0] for run in runs for test in run.tests})
    else:
        runs = [Run(mutant, dict.fromkeys(options.tests, 30.0), number) for number, mutant in enumerate(chosen)]
        files = options.tests
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("", encoding="utf-8")

    progress = os.fdopen(os.dup(1), "w")  # forks of pytest write elsewhere

    def ended(run: Run) -> None:
        if run.apart:
            return
        mutant, by = run.mutant, run.killed_by
        line = {"path": mutant.path, "line": mutant.line, "kind": mutant.kind, "change": mutant.change, "killed_by": by}
        with options.out.open("a", encoding="utf-8") as log:
            log.write(
                json.dumps(line | {"flaky": run.flaky, "seconds": round(run.seconds, 1), "number": run.number}) + "\n"
            )
        print(
            f"{'killed  ' if by else 'SURVIVED'} {mutant.path}:{mutant.line} {mutant.change[:120]!r}",
            file=progress,
            flush=True,
        )

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plugin = Collected([run for run in runs if run.mutant.inside], options.jobs, folder, ended)
        if files and pytest_fork(files, folder, plugin).wait():
            sys.exit((folder / "output.txt").read_text(encoding="utf-8", errors="replace")[-8000:])
        done = {line["number"] for line in lines_of(options.out)}
        judge_apart([run for run in runs if run.number not in done], options.jobs, folder, ended)
    lines = lines_of(options.out)
    for kind in sorted({line["kind"] for line in lines}):
        of_kind = [line["killed_by"] is None for line in lines if line["kind"] == kind]
        print(f"{kind}: {sum(of_kind)} of {len(of_kind)} survive")
    for test in sorted({test for line in lines for test in line["flaky"]}):
        print(f"flaky: {test} fails without a mutant, too")
    killed = sum(line["killed_by"] is not None for line in lines)
    share = killed / max(1, len(lines))
    print(f"{killed} of {len(lines)} mutants killed ({share:.0%}); {options.out}")
    return 0 if share >= options.least else 1


if __name__ == "__main__":
    sys.exit(main())
