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


publish, suite, generality = script("publish"), script("suite"), script("generality")

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
    assert publish.BLOCK.search(publish.README.read_text(encoding="utf-8"))
    for path, text in publish.documents().items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name} differs from the logs; run benchmarks/publish.py"


def test_the_readme_states_no_quality_or_speed_outside_of_its_generated_block():
    text = publish.BLOCK.sub("", publish.README.read_text(encoding="utf-8"))
    assert not re.findall(r"\d[\d.]* ?(?:dB|frames/s|fps)\b", text)


def test_a_figure_is_the_median_with_the_worst_run_and_their_number(tmp_path):
    folder = written(tmp_path, *({"live": {"db": db, "ms": ms}} for db, ms in [(40.0, 9), (30.04, 20), (41.0, 11)]))
    assert publish.table_text(TABLE, folder).splitlines()[-1] == "| one | 40.0 (30.0; 3) dB | 11 (20; 3) ms |"


def test_a_row_takes_the_lines_of_its_command_alone(tmp_path):
    (tmp_path / "generality").mkdir()
    lines = [
        json.dumps(LINE | {"part": part, "recording": recording, "result": {"live": {"db": db}}})
        for part, recording, db in (("live", "a", 31.0), ("live", "b", 32.0), ("offline", "a", 33.0))
    ]
    (tmp_path / "generality" / "cpu.jsonl").write_text("\n".join(lines), encoding="utf-8")
    row = publish.every_recording("one", "cpu", "live", "a")
    assert publish.results_of(row, tmp_path) == [{"live": {"db": 31.0}}]
    assert publish.results_of(publish.every_recording("one", "cpu", "live", "c"), tmp_path) == []


@pytest.mark.parametrize("fails", [False, True])
def test_recording_of_which_a_run_failed_meets_no_requirement(tmp_path, fails):
    def line(part: str, run: int, **outcome) -> str:
        return json.dumps(LINE | {"part": part, "recording": "a", "run": run, **outcome})

    live = {
        "live": {
            "settled_psnr_tissue_db": 40.0,
            "previous_frame_db": 30.0,
            "not_on_screen": 0,
            "settled_age_p99_ms": 20.0,
        },
        "frames": {"ingested": 90},
    }
    offline = {
        "quality": {"heldout_between": {"psnr_tissue_db": 40.0}, "baselines": {"heldout_neighbour_mean_db": 30.0}}
    }
    error = "Traceback\n  File x\nIndexError: it is empty\nerror: this is a bug in intrasplat; please report it\n"
    lines = [line("live", 1, result=live), line("offline", 1, result=offline)]
    if fails:
        lines += [line(part, 2, error=error) for part in ("live", "offline")]
    (tmp_path / "cpu.jsonl").write_text("\n".join(lines), encoding="utf-8")
    text = generality.generality_text(tmp_path)
    rows = [row for row in text.splitlines() if row.startswith("| `a`")]
    assert [row.endswith("| missed |") for row in rows] == [fails, fails]
    assert [row.count("| met |") for row in rows] == ([0, 0] if fails else [1, 1])
    assert text.count("- `a`, run 2: IndexError: it is empty\n") == (2 if fails else 0)


def test_interruptions_of_the_machine_are_stated_with_its_figures(tmp_path):
    folder = written(tmp_path, {"live": {"db": 40.0}})
    assert "interrupted" not in publish.provenance(TABLE, folder)
    pauses = {
        "1": {"longest_ms": 2.4, "long_per_s": 0.0, "share": 0.001},
        "6": {"longest_ms": 31.6, "long_per_s": 1.52, "share": 0.1, "slow_share": 0.016, "slowest": 0.2},
    }
    line = LINE | {"machine": LINE["machine"] | {"pauses": pauses}, "result": {"live": {"db": 40.0}}}
    (folder / "cpu" / "x.jsonl").write_text(json.dumps(line), encoding="utf-8")
    assert (
        "which interrupted 1 busy loop for up to 2 ms (0.0 times per second for more than 5 ms)"
        " and 6 busy loops for up to 32 ms (1.5 times per second for more than 5 ms) and slowed them to less than half of their pace for 1.6 % of the time"
    ) in publish.provenance(TABLE, folder)


def test_interruptions_are_shares_of_the_time():
    pauses = script("host_pauses")
    found = pauses.summary([[1.0, 6.0], [20.0, 5.0, 0.5]], [[8.0, 10.0, 10.0], [3.0, 1.4, 3.0]], 4.0)
    assert found == {"longest_ms": 20.0, "long_per_s": 0.25, "share": 0.0041, "slow_share": 0.1667, "slowest": 0.47}
    still = {"longest_ms": 0.0, "long_per_s": 0.0, "share": 0.0, "slow_share": 0.0, "slowest": 1.0}
    assert pauses.summary([[], []], [[], []], 1.0) == still
    assert pauses.interruptions(2, 0.05).keys() == found.keys()


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
    known = {f"{each.device}/{each.name}" for each in suite.BENCHMARKS} | {"generality/cpu", "generality/cuda"}
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
    lines += [
        (path, line)
        for path in (ROOT / "benchmarks" / "logs" / "generality").glob("*.jsonl")
        for line in publish.log_lines(f"generality/{path.stem}")
    ]
    for path, line in lines:
        # results/methods.md states the `+` of a log that was measured on files that were not committed.
        assert path.parent.name == "methods" or not line["commit"].endswith("+"), f"{path.name}: {line['commit']}"
        assert not re.search(r"(?<![\w.$])/(?:home|root|work|tmp)/", line["command"])
    files = {line["commit"].rstrip("+"): path.name for path, line in lines}
    for commit, name in files.items() if whole else ():  # an archive and a shallow clone do not have the history
        asked = ["git", "merge-base", "--is-ancestor", commit, "HEAD"]
        assert subprocess.run(asked, cwd=ROOT, check=False).returncode == 0, f"{name}: {commit}"


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


def test_recordings_are_found_by_their_files(tmp_path):
    for made in (
        "a/images/000000.png",
        "b/video.mp4",
        "c/poses_bounds.npy",
        "d/e/left.mp4",
        "d/e/right.mp4",
        "loose/000.jpg",
    ):
        path = tmp_path / made
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    found = {name: path.name for name, path in generality.recordings(tmp_path).items()}
    assert found == {"a": "a", "b": "video.mp4", "c": "c", "d/e": "left.mp4"}


def test_a_live_row_is_met_only_if_every_run_is_above_the_previous_frame(tmp_path):
    def lines(*runs: tuple[float, int]) -> str:
        results = [
            {
                "live": {"settled_psnr_tissue_db": db, "previous_frame_db": 20.0, "withheld": {"blur": 2}},
                "margins": {"far_below": far},
            }
            for db, far in runs
        ]
        return "".join(
            json.dumps(LINE | {"run": run, "result": result, "part": "live", "recording": "r"}) + "\n"
            for run, result in enumerate(results, 1)
        )

    for runs, row in (
        (
            ((24.0, 0), (23.5, 0)),
            "| `r` | – | 23.8 (23.5) | 20.0 (20.0) | – | – | 0 (0) | – | – | – | – | – of – | blur 2 | met |",
        ),
        (((24.0, 0), (22.5, 0)), "missed"),
        (((24.0, 0), (23.5, 1)), "missed"),
    ):
        (tmp_path / "cpu.jsonl").write_text(lines(*runs), encoding="utf-8")
        assert row in generality.generality_text(tmp_path)


def test_running_one_part_keeps_the_lines_of_others(tmp_path, monkeypatch):
    out = tmp_path / "cpu.jsonl"
    out.write_text("".join(json.dumps(LINE | {"part": part}) + "\n" for part in ("live", "gates", "tools")))
    ran = []

    def measured(benchmark, number, about):
        ran.append((benchmark.command, number))
        yield LINE | about | {"result": {"outside": "x", "evidence": "straight"}}

    monkeypatch.setattr(generality.suite, "measured", measured)
    monkeypatch.setattr(generality.suite, "machine", lambda device: LINE["machine"])
    monkeypatch.setattr(generality.suite, "commit", lambda: "def")
    generality.run(tmp_path / "of", ["gates", "blind"], "cpu", 3, out)
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(line["part"], line["commit"]) for line in lines] == [
        ("live", "abc"),
        ("tools", "abc"),
        ("gates", "def"),
        ("blind", "def"),
    ]
    assert ran == [
        (f"benchmarks/gates.py {tmp_path}/of --change unchanged --outside", 1),
        ("benchmarks/geometry_random.py blind", 1),
    ], "nothing in a check is random, so it is run once"


def check_text(tmp_path: Path, part: str, *results: dict[str, object]) -> str:
    """Return results/generality.md of a log with these results of one check."""
    lines = [json.dumps(LINE | {"part": part, "recording": "all", "result": result}) + "\n" for result in results]
    (tmp_path / "cpu.jsonl").write_text("".join(lines), encoding="utf-8")
    return str(generality.generality_text(tmp_path))


def test_a_recording_without_an_estimate_counts_as_the_worst(tmp_path):
    found = [{"seed": 1, "ate": 0.01}, {"seed": 2, "ate": None}, {"seed": 3, "ate": 0.02}, {"summary": {"ate": 0}}]
    row = check_text(tmp_path, "blind", *found)
    assert "error of the path | 3 | 2 | 2.00; none | – | – | 2; 5: missed |" in row
    row = check_text(tmp_path, "blind", found[0], found[2])
    assert "error of the path | 2 | 2 | 1.50; 2.00 | – | – | 2; 5: met |" in row
    stereo = [{"seed": k, "depth": depth, "plane": 0.01} for k, depth in enumerate((0.004, 0.008, 0.021))]
    assert "| 3 | 3 | 0.80; 2.10 | 1.00; 1.00 | 2 | 1; 2: missed |" in check_text(tmp_path, "stereo", *stereo)


def test_held_out_frames_are_compared_over_the_frames_that_have_both_neighbours(tmp_path):
    quality = {
        "heldout": {"psnr_tissue_db": 25.0},
        "heldout_between": {"psnr_tissue_db": 31.0},
        "baselines": {"heldout_neighbour_mean_db": 26.5},
    }
    assert "| 25.0 | 31.0 | 26.5 | – | – | – | met |" in check_text(tmp_path, "offline", {"quality": quality})


def test_tool_masks_and_gates_are_met_by_their_figures(tmp_path):
    masks = [
        {"recording": "a", "frames": 2, "iou": 0.54, "iou_min": 0.1, "large": 3, "missed": 1, "false_share": 0.012}
    ]
    text = check_text(tmp_path, "tools", *masks, {"recording": "mean of recordings", "iou": 0.71, "iou_min": 0.54})
    assert "| `a` | 2 | 0.54 | 0.10 | 3 | 1 | 1.2 | 0.55: missed |" in text and "0.70: met" in text
    held = {"recording": "a", "frames": 9, "withheld": {"out of body: cold light": 2, "blur": 3}}
    drawn = {"outside": "drawn: wall", "pictures": 3, "evidence": {"straight": 1, "none": 2}}
    text = check_text(tmp_path, "gates", held, {"outside": "0008", "evidence": "straight"}, drawn)
    assert "| `a` | 9 | 2 | blur 3 | 0: missed |" in text
    assert "Of 4 pictures from outside of a body" in text and "2 show no evidence" in text
