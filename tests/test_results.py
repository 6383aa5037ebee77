"""Published figures are the ones in the logs."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


def script(name: str) -> ModuleType:
    """Import a script of benchmarks/, which is not a package."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


publish, suite = script("publish"), script("suite")

LINE = {
    "benchmark": "x", "run": 1, "commit": "abc", "date": "2026-01-01", "command": "python x.py", "seconds": 1.0,
    "machine": {"cpu": "A", "cores": 2, "instruction_set": "avx2", "torch": "2"},
}  # fmt: skip
TABLE = publish.Table(
    "Title", "Text.", "recording", (publish.db("shown", "live.db"), publish.ms("age", "live.ms", digits=0)), (publish.Row("one", "cpu/x"),)
)  # fmt: skip


def written(folder: Path, *results: dict) -> Path:
    (folder / "cpu").mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(LINE | {"run": run, "result": result}) for run, result in enumerate(results, 1)]
    (folder / "cpu" / "x.jsonl").write_text("\n".join(lines), encoding="utf-8")
    return folder


def test_the_committed_documents_are_what_the_logs_say():
    assert publish.RESULTS.read_text(encoding="utf-8") == publish.results_text()
    readme = publish.README.read_text(encoding="utf-8")
    assert publish.BLOCK.search(readme)
    assert readme == publish.with_figures(readme)


def test_the_readme_states_no_quality_or_speed_outside_of_its_generated_block():
    text = publish.BLOCK.sub("", publish.README.read_text(encoding="utf-8"))
    assert not re.findall(r"\d[\d.]* ?(?:dB|frames/s|fps)\b", text)


def test_a_figure_is_the_median_with_the_worst_run_and_their_number(tmp_path):
    folder = written(tmp_path, *({"live": {"db": db, "ms": ms}} for db, ms in [(40.0, 9), (30.04, 20), (41.0, 11)]))
    assert publish.table_text(TABLE, folder).splitlines()[-1] == "| one | 40.0 (30.0; 3) dB | 11 (20; 3) ms |"


def test_another_value_in_a_log_changes_the_table(tmp_path):
    before = publish.table_text(TABLE, written(tmp_path, {"live": {"db": 40.0}}))
    assert "40.0" in before
    assert publish.table_text(TABLE, written(tmp_path, {"live": {"db": 39.0}})) != before


def test_a_row_without_a_log_is_not_published(tmp_path):
    assert publish.table_text(TABLE, tmp_path) == ""
    assert "Title" not in publish.results_text(tmp_path)


def test_a_line_without_its_commit_is_refused(tmp_path):
    folder = written(tmp_path, {"live": {"db": 40.0}})
    log = folder / "cpu" / "x.jsonl"
    log.write_text(json.dumps({key: value for key, value in LINE.items() if key != "commit"}), encoding="utf-8")
    with pytest.raises(ValueError, match="lacks commit"):
        publish.log_lines("cpu/x", folder)


def test_every_row_is_read_from_a_log_that_the_suite_writes():
    known = {f"{each.device}/{each.name}" for each in suite.BENCHMARKS}
    named = {row.log for table in publish.TABLES for row in table.rows}
    assert named <= known


def test_the_scripts_that_the_suite_runs_exist():
    for each in suite.BENCHMARKS:
        assert (ROOT / each.arguments()[0]).is_file(), each.command
        assert len([other for other in suite.BENCHMARKS if (other.name, other.device) == (each.name, each.device)]) == 1


def test_logs_state_commits_of_this_history_and_no_place_of_a_machine():
    asked = ["git", "rev-parse", "--is-shallow-repository"]
    whole = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip() == "false"
    logs = [path for device in ("cpu", "cuda") for path in (ROOT / "benchmarks" / "logs" / device).glob("*.jsonl")]
    lines = [(path, line) for path in logs for line in publish.log_lines(f"{path.parent.name}/{path.stem}")]
    lines += [
        (path, json.loads(path.read_text())) for path in (ROOT / "benchmarks" / "logs" / "methods").glob("*.json")
    ]
    for path, line in lines:
        # results/methods.md states the `+` of a log that was measured on files that were not committed.
        assert path.parent.name == "methods" or not line["commit"].endswith("+"), f"{path.name}: {line['commit']}"
        assert not re.search(r"(?<![\w.$])/(?:home|root|work|tmp)/", line["command"])
        if whole:  # an archive and a shallow clone do not have the history
            asked = ["git", "merge-base", "--is-ancestor", line["commit"].rstrip("+"), "HEAD"]
            assert subprocess.run(asked, cwd=ROOT, check=False).returncode == 0, f"{path.name}: {line['commit']}"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('noise\n{"a": 1}\n{"a": 2}\n', [{"a": 1}, {"a": 2}]),
        ('{\n "a": 1\n}\n', [{"a": 1}]),
        ('[\n {"a": 1}\n]\n', [{"a": 1}]),
    ],
)
def test_results_are_read_from_lines_and_from_a_whole_output(text, found):
    assert suite.results(text) == found
