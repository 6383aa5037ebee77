"""Choice of tests and reading of pytest's output in the mutation run."""

from __future__ import annotations

import ast
import mmap
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests import executed, mutants
from tests.forks import pytest_fork
from tests.mutants import changeable, mutant_at

MODULE = """
LIMIT = 3


def clipped(value, most=LIMIT):
    if value > most:
        return most
    return value


class Scale:
    def apply(self, value):
        for _ in range(2):
            value = value * LIMIT
        return value
"""


GPU_MODULE = """
class Buffers:
    size = 3


class Captured:
    def __init__(self, device):
        self.memory, self.buffers = GraphMemory(device), Buffers()


def quick(device, count, memory=None):
    captures = device.type == "cuda" and count > 4
    if captures and count < 8:
        return 2 * count
    if device.type == "cuda":
        return 3 * count
    if count > 16:
        return count
    if count > 32 or device.type != "cuda":
        return memory
    if count > 64:
        return 3 * count
    return 5


def chosen(device, count):
    return min(count, 64) if device == "cuda" else 0
"""


def executed_lines(path: Path, call: str) -> set[int]:
    """Return the lines that a call executes, by the marks of the compiled module."""
    marks = bytearray(1000)
    names: dict[str, Any] = {"__marks__": marks, "__name__": "sample"}
    exec(executed.marked(path, 100), names)
    assert not any(marks)  # statements outside functions have none
    eval(call, names)
    executed.parsed.cache_clear()
    statements = executed.parsed(path)[1]
    return {statements[number - 100].node.lineno for number, mark in enumerate(marks) if mark}


@pytest.mark.parametrize(
    ("call", "lines"), [("clipped(2)", {6, 8}), ("clipped(4)", {6, 7}), ("Scale().apply(1)", {13, 14, 15})]
)
def test_marks_are_the_statements_of_functions_that_ran(tmp_path: Path, call: str, lines: set[int]) -> None:
    path = tmp_path / "sample.py"
    path.write_text(MODULE, encoding="utf-8")

    assert executed_lines(path, call) == lines


@pytest.mark.skipif(torch.cuda.is_available(), reason="mutants of what runs on a GPU are drawn as well")
def test_without_a_gpu_what_runs_on_one_only_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "sample.py"
    path.write_text(GPU_MODULE, encoding="utf-8")
    _, nodes, places = changeable(path)
    assert sorted({getattr(nodes[index], "lineno", 0) for index, _ in places}) == [12, 13, 15, 17, 19, 27]


def test_what_only_people_read_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "sample.py"
    path.write_text(
        "count = Field(default=5, examples=[7], json_schema_extra={'examples': [{'count': 8}]})\n"
        "def clipped(value, log, parser):\n"
        "    log.warning('%d of %d', value + 3, len(value) // 4)\n"
        "    parser.error(value + 5)\n"
        "    return log.error\n",
        encoding="utf-8",
    )
    _, nodes, places = changeable(path)
    assert sorted(ast.unparse(nodes[index]) for index, _ in places) == ["5", "5", "value + 5"]


def test_only_functions_that_loading_the_module_does_not_run_are_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "module.py"
    path.write_text(MODULE + "\n\ndef table():\n    return LIMIT + 5\n\n\nTABLE = [table()]\n", encoding="utf-8")
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    found = [mutant for place in changeable(path)[2] if (mutant := mutant_at(path, *place)) is not None]
    apart = {mutant.change.split("  =>  ")[0] for mutant in found if not mutant.inside}
    assert apart == {"3", "5", "LIMIT + 5"}
    assert any(mutant.change == "value * LIMIT  =>  value / LIMIT" for mutant in found if mutant.inside)


def test_a_statement_keeps_its_key_when_other_functions_change_and_the_module_moves(tmp_path: Path) -> None:
    first, second = tmp_path / "sample.py", tmp_path / "elsewhere" / "sample.py"
    second.parent.mkdir()
    first.write_text(MODULE, encoding="utf-8")
    second.write_text(
        MODULE.replace("def clipped", "def new():\n    return 1\n\n\ndef clipped").replace(
            "value > most", "value >= most"
        ),
        encoding="utf-8",
    )
    keys = [{ast.unparse(each.node): each.key for each in executed.parsed(path)[1]} for path in (first, second)]

    same = {text for text in keys[0] if keys[1].get(text) == keys[0][text]}

    assert {text.split("\n")[0] for text in keys[0].keys() - same} == {
        "if value > most:",
        "def clipped(value, most=LIMIT):",
    }


def recorded(folder: Path, path: Path, tests: dict[str, tuple[float, set[int]]]) -> None:
    """Write a record in which each test takes some seconds and executes some lines of a module."""
    statements = executed.parsed(path)[1]
    pairs = sorted(
        (key, number)
        for number, (_, lines) in enumerate(tests.values())
        for each in statements
        if each.node.lineno in lines
        for key in (each.key, each.function or 0)
    )
    known = np.unique(np.array([each.key for each in statements], np.uint64))
    np.save(folder / "known-1.npy", known)
    np.savez(
        folder / "tests+test_mutants.npz", key=np.array([key for key, _ in pairs], np.uint64), known=np.array("1"),
        test=np.array([number for _, number in pairs], np.int32), tests=np.array(list(tests)), digest=np.array(""),
        seconds=np.array([seconds for seconds, _ in tests.values()]),
    )  # fmt: skip


@pytest.mark.parametrize(("other", "is_recorded"), [("import nothing_like_this", False), ("assert True", True)])
def test_a_session_that_cannot_import_a_file_records_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str, is_recorded: bool
) -> None:
    """Otherwise the files of the session would count as recorded without tests until they change."""
    files = ["test_sound.py", "test_other.py"]
    for file, text in zip(files, ("assert True", other), strict=True):
        (tmp_path / file).write_text(f"{text}\n\ndef test():\n    assert True\n", encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  slow: not run\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(executed, "ROOT", tmp_path)
    monkeypatch.setattr(executed, "RECORDS", tmp_path / "records")
    (tmp_path / "records").mkdir()
    product = object.__new__(executed.Marked)
    product.keys = product.functions = np.ones(1, np.uint64)
    product.version, product.codes = "0", tmp_path / "codes.json"
    product.codes.write_text("{}", encoding="utf-8")
    product.record(files)
    records = [np.load(each)["tests"].tolist() for each in (tmp_path / "records").iterdir()]
    assert records == ([["test"], ["test"]] if is_recorded else [])


def test_tests_that_execute_a_line_run_quickest_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sample.py"
    path.write_text(MODULE, encoding="utf-8")
    recorded(
        tmp_path, path, {"test_large": (3.0, {6, 7}), "test_small": (1.0, {6, 8}), "test_scale": (2.0, {13, 14, 15})}
    )
    monkeypatch.setattr(executed, "RECORDS", tmp_path)
    monkeypatch.setattr(executed, "product_files", lambda: [path])
    executed.users.cache_clear()
    found = executed.Executed()

    def names(line: int) -> list[str]:
        return [found.tests[test].split("::")[1] for test in found.tests_of(path, line)]

    assert names(6) == ["test_small", "test_large"]
    assert names(7) == ["test_large"]
    assert names(5) == ["test_small", "test_large"]  # a default value
    assert names(2) == ["test_scale"]  # a constant
    executed.users.cache_clear()

    path.write_text(MODULE.replace("return value\n\n\nclass", "return value + 0\n\n\nclass"), encoding="utf-8")
    executed.parsed.cache_clear()
    assert names(8) == ["test_small", "test_large"]  # newer than the record: tests of its function


@pytest.mark.parametrize(
    ("line", "failed"),
    [
        ("import sys; sys.exit(2)", "pytest itself"),
        ("import os; os._exit(0)", "pytest itself"),
        ("raise ValueError", "test_product.py"),
        ("VALUE = 1", ""),
        ("VALUE = 2", "test_product.py::test"),
    ],
)
def test_a_module_that_ends_the_process_when_it_is_imported_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, failed: str
) -> None:
    """Otherwise a change that makes each import of a module end would count as not noticed."""
    (tmp_path / "product.py").write_text(f"{line}\n", encoding="utf-8")
    (tmp_path / "test_product.py").write_text(
        "from product import VALUE\n\ndef test():\n    assert VALUE == 1\n", encoding="utf-8"
    )
    (tmp_path / "pytest.ini").write_text("[pytest]\npythonpath = .\nmarkers =\n  slow: not run\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    chosen = mutants.Chosen(("test_product.py",), tmp_path / "failed", {})
    fork = pytest_fork(["test_product.py"], tmp_path, chosen)
    fork.wait()
    assert mutants._failed(fork, tmp_path) == failed


def test_marks_are_read_while_another_thread_sets_them() -> None:
    """A thread that a test left running must not end the session, which would leave its files without records."""
    marks = mmap.mmap(-1, 1_000_000)
    recorder = executed.Recorder(marks)
    places = np.random.default_rng(0).integers(len(marks), size=1000)

    def work() -> None:
        for _ in range(2000):
            recorder.marks[places] = 1
            time.sleep(0)  # the other thread continues

    thread = threading.Thread(target=work)
    thread.start()
    try:
        while thread.is_alive():
            recorder.take("file", 0)
    finally:
        thread.join()
    recorder.take("file", 0)
    assert set(np.concatenate([found for found, _ in recorder.executed["file"]])) == set(places)
