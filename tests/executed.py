"""Record which tests execute which statements of the product, for `tests/mutants.py`.

    python -m tests.executed                  # record the test files that changed since they were recorded
    python -m tests.executed --fresh          # record all of them again

Tests run with modules of the product compiled from sources with a mark before each statement of a function. A mark is a byte
in a file that all processes share, so that statements executed by processes and threads of a test count, too. A statement is
identified by its text, its function and the name of its module: a record stays valid when the module moves or its other
functions change. Each test file has one record in `out/executed`.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import marshal
import mmap
import multiprocessing
import os
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
import pytest

from tests.forks import PACKAGES, ROOT, import_libraries_alone, pytest_fork

RECORDS = ROOT / "out" / "executed"
ALL = -1
"""Number in place of a test's for statements executed during the set-up of any test of the file."""
FILES_TOGETHER = 8
"""Test files of one folder in one run of pytest. It imports the product once for all of them."""
LIMIT_S = 1800.0
"""Time limit in seconds for these files."""
BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)

HOOK = """
import builtins, json, marshal, mmap
from importlib.machinery import SourceFileLoader

def get_code(loader, name, usual=SourceFileLoader.get_code):
    if loader.path not in CODES:
        return usual(loader, name)
    with open(CODES[loader.path], "rb") as file:
        return marshal.load(file)

with open({codes!r}) as file:
    CODES = json.load(file)
with open({marks!r}, "r+b") as file:
    builtins.__marks__ = mmap.mmap(file.fileno(), 0)
SourceFileLoader.get_code = get_code
"""
"""Code that lets this process load marked modules, by name or by path."""


def number_of(text: str) -> int:
    """Return a 64-bit number that identifies a text."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


@dataclass(frozen=True)
class Statement:
    """A statement of a module.

    Attributes:
        node: its node.
        function: number of the outermost function or method that contains it, None outside functions.
        key: number of the statement.
    """

    node: ast.stmt
    function: int | None
    key: int


def statements_of(tree: ast.Module, stem: str) -> list[Statement]:
    """Return the statements of a module in the order of its text."""
    found: list[Statement] = []
    seen: Counter[str] = Counter()

    def visit(node: ast.AST, scope: str, function: int | None) -> None:
        if isinstance(node, ast.stmt):
            head = [
                ast.dump(child)
                for child in ast.iter_child_nodes(node)
                if not isinstance(child, ast.stmt | ast.match_case | ast.ExceptHandler)
            ]
            text = f"{scope}|{type(node).__name__}|{head}"
            seen[text] += 1
            found.append(Statement(node, function, number_of(f"{text}|{seen[text]}")))
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            scope = f"{scope}.{node.name}"
            if function is None and isinstance(node, FUNCTIONS):
                function = number_of(scope)
        for block in BLOCKS:
            for child in getattr(node, block, None) or ():
                if isinstance(child, ast.AST):
                    visit(child, scope, function)

    visit(tree, stem, None)
    return found


@cache
def parsed(path: Path) -> tuple[ast.Module, list[Statement]]:
    """Return the tree of a module and its statements."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return tree, statements_of(tree, path.parent.name if path.stem == "__init__" else path.stem)


def marked(path: Path, first: int) -> CodeType:
    """Compile a module with a mark before each statement of a function; `first` is the number of the first mark."""
    statements = parsed(path)[1]
    numbers = {id(each.node): first + number for number, each in enumerate(statements) if each.function is not None}

    class Marks(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> Any:
            self.generic_visit(node)
            number = numbers.get(id(node))
            if number is None or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
                return node
            mark = ast.parse(f"__marks__[{number}] = 1").body[0]
            for each in ast.walk(mark):
                ast.copy_location(each, node)
            return [mark, node]

    return compile(Marks().visit(parsed(path)[0]), str(path), "exec", dont_inherit=True)


def product_files() -> list[Path]:
    """Return the modules of the product."""
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


class Recorder:
    """Plugin of pytest that reads and clears the marks after the set-up and after the end of each test."""

    def __init__(self, marks: mmap.mmap) -> None:
        self.marks = np.frombuffer(marks, np.uint8)
        self.marks[:] = 0
        self.tests: dict[str, list[str]] = defaultdict(list)
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.executed: dict[str, list[tuple[np.ndarray, int]]] = defaultdict(list)
        self.failed: list[str] = []

    def take(self, file: str, test: int) -> None:
        places = np.flatnonzero(self.marks.copy())  # a thread or process that a test left running may still set marks
        self.marks[places] = 0
        self.executed[file].append((places, test))

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        file, test = item.nodeid.split("::", 1)
        start = sum(os.times()[:4])  # processor time, with ended processes: it depends less on other load
        result = yield
        self.take(file, len(self.tests[file]))
        self.tests[file].append(test)
        self.seconds[file].append(sum(os.times()[:4]) - start)
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        try:
            return (yield)
        finally:
            self.take(item.nodeid.split("::", 1)[0], ALL)


def digest_of(file: str) -> str:
    return hashlib.sha256((ROOT / file).read_bytes()).hexdigest()[:16]


def record_path(file: str) -> Path:
    return RECORDS / (file.removesuffix(".py").replace("/", "+") + ".npz")


class Marked:
    """All modules of the product, compiled with marks.

    Attributes:
        keys: number of the statement of each mark.
        functions: number of the function of each mark, 0 outside functions.
        version: identifies the set of statements.
        codes: file that maps each module's path to its compiled code.
    """

    def __init__(self, folder: Path) -> None:
        codes: dict[str, str] = {}
        statements: list[Statement] = []
        for number, path in enumerate(product_files()):
            own = parsed(path)[1]
            code = folder / f"{number}.code"
            code.write_bytes(marshal.dumps(marked(path, len(statements))))
            codes[str(path)] = str(code)
            statements += own
        parsed.cache_clear()  # the trees contain marks now
        self.keys = np.array([each.key for each in statements], np.uint64)
        self.functions = np.array([each.function or 0 for each in statements], np.uint64)
        known = np.unique(self.keys)
        self.version = hashlib.sha256(known.tobytes()).hexdigest()[:16]
        np.save(RECORDS / f"known-{self.version}.npy", known)
        self.codes = folder / "codes.json"
        self.codes.write_text(json.dumps(codes), encoding="utf-8")

    def record(self, files: list[str]) -> str:
        """Run test files and write their records, unless one cannot be imported. Return pytest's exit code and the failed
        tests."""

        def write(recorder: Recorder, code: int) -> None:
            print("\nfailed:", *recorder.failed)  # what they would execute later is not recorded
            if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED):
                return  # a file that cannot be imported ends the session before its first test
            for file in files:
                pairs = [(places, np.full(len(places), test, np.int32)) for places, test in recorder.executed[file]]
                places = np.concatenate([np.zeros(0, np.int64), *(each for each, _ in pairs)])
                tests = np.concatenate([np.zeros(0, np.int32), *(each for _, each in pairs)])
                both = np.concatenate([self.keys[places], self.functions[places]]), np.concatenate([tests, tests])
                pair = np.unique(np.rec.fromarrays(both, names="key,test"))
                np.savez_compressed(
                    record_path(file), key=pair["key"], test=pair["test"], known=np.array(self.version),
                    tests=np.array(recorder.tests[file], str), seconds=np.array(recorder.seconds[file]),
                    digest=np.array(digest_of(file)),
                )  # fmt: skip

        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            marks = folder / "marks"
            marks.write_bytes(bytes(len(self.keys)))
            hook = HOOK.format(codes=str(self.codes), marks=str(marks))
            with marks.open("r+b") as opened:
                recorder = Recorder(mmap.mmap(opened.fileno(), 0))
            fork = pytest_fork(files, folder, recorder, hook, LIMIT_S, lambda code: write(recorder, code))
            code, output = fork.wait(), fork.output.read_text(encoding="utf-8", errors="replace")
        return f"{code}: {(output.strip().splitlines() or [''])[-1]}"


def outdated(folders: Sequence[str]) -> list[list[str]]:
    """Return the test files of some folders without a record of their present text, in groups of one folder each."""
    groups: dict[Path, list[str]] = defaultdict(list)
    named = [ROOT / name for name in folders]
    if missing := [str(each) for each in named if not each.exists()]:
        sys.exit(f"{', '.join(missing)}: no such folder or file of tests")
    for path in (path for each in named for path in (sorted(each.rglob("test_*.py")) if each.is_dir() else [each])):
        file = str(path.relative_to(ROOT))
        try:
            with np.load(record_path(file)) as stored:
                if str(stored["digest"]) == digest_of(file):
                    continue
        except (OSError, ValueError, KeyError):
            pass
        groups[path.parent].append(file)
    return [
        files[start : start + FILES_TOGETHER]
        for files in groups.values()
        for start in range(0, len(files), FILES_TOGETHER)
    ]


class Executed:
    """All records, for look-ups of tests by statement."""

    def __init__(self) -> None:
        self.tests: list[str] = []
        self.seconds: list[float] = []
        keys, tests = [np.zeros(0, np.uint64)], [np.zeros(0, np.int64)]
        versions: list[str] = []
        for path in sorted(RECORDS.glob("*.npz")):
            file = path.stem.replace("+", "/") + ".py"
            if not (ROOT / file).exists():
                continue
            with np.load(path) as stored:
                first, count = len(self.tests), len(stored["tests"])
                self.tests += [f"{file}::{test}" for test in stored["tests"]]
                self.seconds += stored["seconds"].tolist()
                versions += [str(stored["known"])] * count
                every = stored["test"] == ALL
                keys += [stored["key"][~every], np.repeat(stored["key"][every], count)]
                tests += [stored["test"][~every] + first, np.tile(np.arange(first, first + count), int(every.sum()))]
        self.known = {version: np.load(RECORDS / f"known-{version}.npy") for version in set(versions)}
        self.versions = np.array(versions, str)
        joined = np.concatenate(keys)
        order = np.argsort(joined, kind="stable")
        self.keys, self.numbers = joined[order], np.concatenate(tests)[order]

    def executing(self, key: int) -> np.ndarray:
        """Return the numbers of the tests that execute a statement or function."""
        low, high = (int(np.searchsorted(self.keys, np.uint64(key), side)) for side in ("left", "right"))
        return np.unique(self.numbers[low:high])

    def of_statement(self, statement: Statement) -> set[int]:
        """Return the tests that execute a statement of a function. Tests recorded before it existed count where they execute its function."""
        exact, near = self.executing(statement.key), self.executing(statement.function or 0)
        found: set[int] = set()
        for version, known in self.known.items():
            place = int(np.searchsorted(known, np.uint64(statement.key)))
            there = place < len(known) and int(known[place]) == statement.key
            tests = exact if there else near
            found |= set(tests[self.versions[tests] == version].tolist())
        return found

    def tests_of(self, path: Path, line: int) -> list[int]:
        """Return the tests that execute a line of a module, quickest first.

        A default value counts as executed by the tests of its function, and a constant outside functions by the tests of statements that contain its
        name. Any other line outside functions counts as executed by all tests of its module's functions.
        """
        statements = parsed(path)[1]
        inside = [each for each in statements if each.node.lineno <= line <= (each.node.end_lineno or 0)]
        node = inside[-1].node if inside else None
        if inside and inside[-1].function is not None:
            found = self.of_statement(inside[-1])
        elif isinstance(node, FUNCTIONS):
            body = next(each for each in statements if each.node is node.body[0])
            found = set(self.executing(body.function or 0).tolist())
        else:
            name = _assigned(node)
            found = set().union(*(self.of_statement(each) for each in users().get(name, ())))
            if not found:
                functions = {each.function for each in statements if each.function is not None}
                found = set().union(*(self.executing(each).tolist() for each in functions))
        return sorted(found, key=lambda test: self.seconds[test])


def _walk_head(node: ast.stmt) -> Iterator[ast.AST]:
    """Return the nodes of a statement without those of the statements that it contains."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.stmt | ast.match_case | ast.ExceptHandler):
            yield from ast.walk(child)


def _assigned(node: ast.stmt | None) -> str:
    target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
    return target.id if isinstance(target, ast.Name) else ""


@cache
def users() -> dict[str, list[Statement]]:
    """Return the statements of functions that contain a name, for each name."""
    found: dict[str, list[Statement]] = defaultdict(list)
    for path in product_files():
        for each in parsed(path)[1]:
            if each.function is None:
                continue
            names = {getattr(child, "id", None) or getattr(child, "attr", None) for child in _walk_head(each.node)}
            for name in names - {None, ""}:
                found[name].append(each)
    return found


def bring_up_to_date(jobs: int, folders: Sequence[str] = ("tests",)) -> None:
    """Record the test files that changed, in `jobs` processes forked from this one."""
    RECORDS.mkdir(parents=True, exist_ok=True)
    groups = outdated(folders)
    if not groups:
        return
    with tempfile.TemporaryDirectory() as name:
        product = Marked(Path(name))
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
            runs = {pool.submit(product.record, group): group for group in groups}
            for count, run in enumerate(as_completed(runs), 1):
                print(f"recorded {count}/{len(groups)} {runs[run][0]} …: {run.result()}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", default=["tests"], help="folders or files of tests")
    parser.add_argument("--fresh", action="store_true", help="forget earlier records")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    if options.fresh:
        for path in RECORDS.glob("*.npz"):
            path.unlink()
    import_libraries_alone()
    bring_up_to_date(options.jobs, options.folders)


if __name__ == "__main__":
    sys.exit(main())
