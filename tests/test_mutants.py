"""Reading pytest's output and choosing test files in the mutation run."""

from __future__ import annotations

import pytest

from tests import mutants


@pytest.mark.parametrize(
    ("output", "test"),
    [
        ("FAILED tests/a/test_b.py::test_c[1-2] - assert 1 == 2", "tests/a/test_b.py::test_c[1-2]"),
        ("ERROR tests/a/test_b.py - ImportError: no", "tests/a/test_b.py"),
        (
            "ERROR    services.audit:log.py:9 the disk is full\nFAILED tests/test_d.py::test_e",
            "tests/test_d.py::test_e",
        ),
        ("ERROR    services.audit:log.py:9 the disk is full\nERROR services are gone", None),
        ("FAILED to open", None),
    ],
)
def test_only_lines_that_name_a_test_file_name_the_failed_test(output: str, test: str | None) -> None:
    assert mutants.failed_test(f"F.\n{output}\n1 failed in 0.1s\n") == test


def test_the_file_that_mirrors_the_module_runs_first() -> None:
    chosen = mutants.tests_for("services/settings/load.py")

    assert chosen[0] == "tests/services/settings/test_load.py"
    assert len(set(chosen)) == len(chosen) >= mutants.PRECHECK_FILES
