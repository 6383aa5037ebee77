"""Groups of tests: their folders, and the exit codes of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import groups
from tests.forks import ROOT


def selected(group: str) -> set[Path]:
    """Return the test files that pytest's arguments select."""
    words = groups.tests_of(group)
    ignored = [ROOT / word.removeprefix("--ignore=") for word in words if word.startswith("--ignore=")]
    paths = [ROOT / word for word in words if not word.startswith("--")]
    assert all(path.exists() for path in [*paths, *ignored])
    files = [path for each in paths for path in ([each] if each.is_file() else each.rglob("test_*.py"))]
    return {path for path in files if not any(path.is_relative_to(each) for each in ignored)}


def test_each_test_file_belongs_to_one_group():
    chosen = {group: selected(group) for group in groups.GROUPS}
    assert set().union(*chosen.values()) == set((ROOT / "tests").rglob("test_*.py"))
    assert sum(map(len, chosen.values())) == len(set().union(*chosen.values()))


def test_only_groups_with_failed_tests_run_again(tmp_path):
    for name, code in {"ops": 0, "rest": 1, "system": 1}.items():
        (tmp_path / f"{name}.code").write_text(str(code))
    assert groups.failed_groups(["ops", "rest", "system"], tmp_path) == ["rest", "system"]


@pytest.mark.parametrize(
    ("code", "sentence"), [(None, "rest did not end"), (2, "rest ended with code 2"), (-9, "code -9")]
)
def test_a_group_that_did_not_end_with_failed_tests_is_an_error(tmp_path, code, sentence):
    (tmp_path / "ops.code").write_text("1")
    if code is not None:
        (tmp_path / "rest.code").write_text(str(code))
    with pytest.raises(SystemExit, match=sentence):
        groups.failed_groups(["ops", "rest"], tmp_path)


class Ended:
    """Stand-in for a fork that has ended."""

    made: list[str]

    def __init__(self, call, output: Path) -> None:
        self.output, self.code = output, 3 if output.stem == "rest" else 0
        output.write_text(f"output of {output.stem}")
        self.made.append(output.stem)

    def ended(self) -> bool:
        return True


def test_every_group_runs_and_a_bad_one_decides_the_exit_code(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Ended, "made", [], raising=False)
    monkeypatch.setattr(groups, "Fork", Ended)
    assert groups.run(["system", "ops"], [], 1, tmp_path) == 0
    assert groups.run(["system", "rest", "ops"], [], 2, tmp_path) == groups.FAILED
    assert Ended.made == ["system", "ops", "system", "rest", "ops"]
    assert (tmp_path / "rest.code").read_text() == "3" and (tmp_path / "ops.code").read_text() == "0"
    out = capsys.readouterr().out
    assert "output of rest" in out and out.endswith("2 of 3 groups passed; failed: rest\n")
