"""Generate RESULTS.md, the generated pages of `results` and the figures in README.md from the logs in `benchmarks/logs`.

    python benchmarks/publish.py            # writes
    python benchmarks/publish.py --check    # exit code 1 where a written figure and its log differ

Each table below names the logs of its rows and the values of its columns. A figure is the median
over the runs in the log. With several runs, the worst run and their number follow. A row without a
log is not printed. `suite.py` writes the logs; each line has command, commit, machine and date.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parent / "methods"))
sys.path.insert(0, str(Path(__file__).resolve().parent / "gsplat"))

from accepted import methods_text
from generality import generality_text
from host_pauses import pauses_text
from results import gsplat_text

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "benchmarks" / "logs"
RESULTS = ROOT / "benchmarks" / "RESULTS.md"
METHODS = ROOT / "benchmarks" / "results" / "methods.md"
GSPLAT = ROOT / "benchmarks" / "results" / "gsplat.md"
GENERALITY = ROOT / "benchmarks" / "results" / "generality.md"
README = ROOT / "README.md"
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end of results -->)", re.DOTALL)
ENVELOPE = ("benchmark", "run", "commit", "date", "machine", "command", "seconds")
"""Fields of every log line in addition to its result."""


@dataclass(frozen=True)
class Column:
    """A value of each result.

    Attributes:
        title: heading of the column.
        path: keys of the value in a result, joined by dots. Alternatives are tried in order.
        digits: digits after the point.
        unit: printed after the figure.
        scale: the printed figure is the value times this.
        better: `more` or `less`; the worst run is printed accordingly. None: no worst run is printed.
    """

    title: str
    path: str | tuple[str, ...]
    digits: int = 1
    unit: str = ""
    scale: float = 1.0
    better: str | None = None

    def of(self, result: Mapping[str, Any]) -> float | None:
        """Return the value in a result, or None if the result lacks it."""
        for path in [self.path] if isinstance(self.path, str) else self.path:
            value: Any = result
            for key in path.split("."):
                value = value.get(key) if isinstance(value, Mapping) else None
            if isinstance(value, int | float):
                return self.scale * float(value)
        return None

    def cell(self, results: Iterable[Mapping[str, Any]]) -> str:
        """Return the median over the runs as text; with several runs also the worst one and their number."""
        values = [value for result in results if (value := self.of(result)) is not None]
        if not values:
            return "–"
        text = f"{statistics.median(values):.{self.digits}f}"
        if len(values) > 1 and self.better:
            worst = min(values) if self.better == "more" else max(values)
            text += f" ({worst:.{self.digits}f}; {len(values)})"
        return text + (f" {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        what: first cell.
        log: `DEVICE/NAME` of the log, or `generality/DEVICE`.
        where: values that a result must have to be this row's; needed where a log holds results of several kinds.
        line: values that the log line must have to be this row's; needed where a log holds several commands.
        asked: the requirement in words; empty if there is none.
        front: part of the README's table.
    """

    what: str
    log: str
    where: Mapping[str, Any] = field(default_factory=dict)
    line: Mapping[str, Any] = field(default_factory=dict)
    asked: str = ""
    front: bool = False


@dataclass(frozen=True)
class Table:
    """A table of RESULTS.md."""

    title: str
    text: str
    first: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    readme: tuple[str, ...] = ()
    """Titles of the columns that the README shows, for the rows marked as `front`."""


def db(title: str, *paths: str, better: str | None = "more") -> Column:
    return Column(title, paths, 1, "dB", better=better)


def ms(title: str, *paths: str, digits: int = 1, better: str | None = "less") -> Column:
    return Column(title, paths, digits, "ms", better=better)


LIVE_COLUMNS = (
    db("displayed frame (training error)", "live.settled_psnr_tissue_db"),
    db("worst frame", "live.worst_psnr_tissue_db"),
    db("previous frame", "live.previous_frame_db", better=None),
    db("next frame, before it is seen", "quality.next_frame.psnr_tissue_db"),
    db("previous frame, the same frames", "quality.next_frame.previous_frame_db", better=None),
    ms("age p50", "live.age_p50_ms"),
    ms("age p99", "live.age_p99_ms"),
    Column("frames in", "frames.ingested", 0),
    Column("shown", "live.pictures", 0, better="more"),
    Column("width", "recording.width_px", 0),
)
REPLAY_COLUMNS = (
    db("displayed frame (training error)", "quality.live.psnr_tissue_db"),
    db("next frame, before it is seen", "quality.next_frame.psnr_tissue_db"),
    db("previous frame", "quality.baselines.previous_frame_db", better=None),
    Column("whole command", "wall_s", 1, "s", better="less"),
    Column("peak memory", "run.peak_memory_bytes", 0, "MiB", 1 / 2**20, better="less"),
    Column("in", "frames.ingested", 0),
    Column("shown", "frames.displayed", 0, better="more"),
)
OFFLINE_COLUMNS = (
    db("held-out frames", "quality.heldout.psnr_tissue_db"),
    db("neighbours' mean", "quality.baselines.heldout_neighbour_mean_db", better=None),
    db("previous frame", "quality.baselines.heldout_previous_frame_db", better=None),
    db("training frames (training error)", "quality.training.psnr_tissue_db"),
    Column("whole command", "wall_s", 1, "s", better="less"),
)
KERNEL_COLUMNS = (
    ms("ours", "ours_ms", digits=3),
    ms("gsplat 1.5.3", "gsplat_fused_adam_ms", "gsplat_ms", digits=3),
    ms("plain PyTorch", "plain_on_gsplat_ms", "plain_ms", digits=3),
)
DEPTH_COLUMNS = (
    Column("depth, RMS error", "rms_percent", 2, "%", better="less"),
    Column("level plane", "level_percent", 2, "%"),
    Column("best-fit plane", "plane_percent", 2, "%"),
)
STREAM_COLUMNS = (
    db("last 5 s, shown again at the end", "retention_db"),
    db("worst of these frames", "retention_worst_db"),
    db("previous frame", "previous_frame_db", better=None),
)
ROOM_COLUMNS = (
    db("displayed frame (training error)", "displayed_db"),
    db("previous frame", "previous_frame_db", better=None),
    ms("age p99 after the first second", "age_p99_ms"),
    Column("late frames", "late", 0, better="less"),
    Column("frames", "frames", 0),
)


LIVE_FRONT = (
    "width",
    "displayed frame (training error)",
    "previous frame",
    "next frame, before it is seen",
    "age p50",
    "age p99",
)


SCENES = {
    "surgical50k_640x512": "50,000 splats on a surface, 640x512,",
    "volume1m_1080p": "1,000,000 splats in a volume, 1920x1080,",
    "volume4m_4k": "4,000,000 splats in a volume, 3840x2160,",
}
"""Words of the README and RESULTS.md for the scenes of `gpu_scenes.py`."""


def kernel(log: str, work: str, asked: str = "", front: bool = False) -> Row:
    scene, _, rest = work.partition(" ")
    what = f"{SCENES[scene]} {rest}" if scene in SCENES else work
    return Row(what, f"cuda/{log}", {"work": work}, asked=asked, front=front)


def every_recording(what: str, device: str, part: str, recording: str, asked: str = "", front: bool = False) -> Row:
    """Return the row of a recording that `generality.py` measured with the default command."""
    return Row(what, f"generality/{device}", line={"part": part, "recording": recording}, asked=asked, front=front)


TABLES = (
    Table(
        "Live, one GPU",
        "`intrasplat live RECORDING --device cuda`, the whole command. PSNR is over tissue pixels. The displayed frame has been trained on "
        "before it is shown, so its PSNR is a training error. *Next frame* is what was predicted for a frame before the frame was seen, "
        "which is comparable with the previous frame shown again. Age runs from a frame's arrival to its picture on the screen.",
        "recording",
        LIVE_COLUMNS,
        (
            every_recording("`cutting`, 30 frames/s", "cuda", "live", "cutting", "42.5 dB, worst 37, p99 33 ms", True),
            Row("`cutting`, 60 frames/s", "cuda/live_cutting_60", asked="40 dB, p99 25 ms"),
            every_recording("`heart`, left eye, 30 frames/s", "cuda", "live", "heart", "37 dB, worst 30", True),
            every_recording("`sinus`, 30 frames/s", "cuda", "live", "sinus", "38 dB"),
            every_recording("`resting_bowel`, 30 frames/s", "cuda", "live", "others/resting_bowel", "32 dB"),
            every_recording("`laparoscopy`, 30 frames/s", "cuda", "live", "others/laparoscopy", "33 dB", True),
            Row("`laparoscopy`, 60 frames/s", "cuda/live_laparoscopy_60"),
            every_recording("`stereomis_like`, 30 frames/s", "cuda", "live", "others/stereomis_like", "36 dB, worst 25"),
            Row("`cutting`, HexPlane field", "cuda/live_cutting_hexplane"),
        ),
        LIVE_FRONT,
    ),
    Table(
        "Live, two CPU cores",
        "`intrasplat live RECORDING` at normal priority on an idle machine. The command measures at which picture size the machine keeps up.",
        "recording",
        LIVE_COLUMNS,
        (
            every_recording("`cutting`, 30 frames/s", "cpu", "live", "cutting", "34 dB, p99 150 ms", True),
            every_recording("`heart`, left eye, 30 frames/s", "cpu", "live", "heart"),
            every_recording("`resting_bowel`, 30 frames/s", "cpu", "live", "others/resting_bowel"),
        ),
        LIVE_FRONT,
    ),
    Table(
        "What a live model keeps, one GPU",
        "A recording that does not repeat, played once in real time with as many steps as live has time for (`endless.py --clock --once`). At its end the frames of the last 5 s are rendered from the final model and compared with the recorded frames.",
        "recording",
        STREAM_COLUMNS,
        tuple(
            Row(f"`{name}`", f"cuda/stream_{name}", asked="36 dB") for name in ("cutting", "heart", "resting_bowel")
        ),
    ),
    Table(
        "Several rooms, one GPU",
        "Several `intrasplat live RECORDING --fps 30 --loop` at once, for 15 s (`rooms.py`). Each figure is that of the worst room of a run.",
        "recording",
        ROOM_COLUMNS,
        (
            Row("`cutting`, four rooms", "cuda/rooms_cutting", asked="43 dB, p99 33 ms, 1 late"),
            Row("the same with MPS (`rooms.py --mps`)", "cuda/rooms_cutting_mps", asked="43 dB, p99 33 ms, 1 late"),
        ),
    ),
    Table(
        "Replay",
        "`intrasplat replay RECORDING`, the whole command with its report, 10 optimiser steps a frame.",
        "recording",
        REPLAY_COLUMNS,
        (
            Row("`cutting`, one GPU", "cuda/replay_cutting"),
            Row("`sinus`, one GPU", "cuda/replay_sinus"),
            Row("`sinus`, one GPU, `--depth none`", "cuda/replay_sinus_no_depth"),
            Row("`resting_bowel`, one GPU", "cuda/replay_resting_bowel"),
            Row("`cutting`, two CPU cores", "cpu/replay_cutting", asked="33 dB, 150 s, 3 GB"),
            Row("`cutting`, two CPU cores, HexPlane", "cpu/replay_cutting_hexplane"),
            Row("`sinus`, two CPU cores", "cpu/replay_sinus"),
        ),
    ),
    Table(
        "Offline reconstruction, one GPU",
        "`intrasplat reconstruct RECORDING --device cuda`, default settings. Every eighth frame is held out. The neighbours' mean sees the frame after the held-out one.",
        "recording",
        OFFLINE_COLUMNS,
        (
            every_recording("`cutting`", "cuda", "offline", "cutting", front=True),
            every_recording("`heart`, left eye", "cuda", "offline", "heart", front=True),
            every_recording("`sinus`", "cuda", "offline", "sinus", "33 dB", True),
            every_recording("`organ_still`, eight equal stereo frames", "cuda", "offline", "others/organ_still", "48 dB"),
        ),
        ("held-out frames", "neighbours' mean", "whole command"),
    ),
    Table(
        "Depth of breathing tissue before a moving scope with given poses",
        "Synthetic recordings, 5 s at 320x256, seeds 0 and 1 (median, worst). Both planes are fitted to the true depth. The estimator searches for a periodic motion; breathing is a sine unless the row says otherwise.",
        "breathing",
        DEPTH_COLUMNS,
        (
            Row("equal and steady", "cpu/breathing_steady", asked="1.5 %"),
            Row("inspiration to expiration 1:2", "cpu/breathing_ratio"),
            Row("rate wanders by 15 %", "cpu/breathing_wander"),
            Row("both, and a scope path of each seed's own", "cpu/breathing_path"),
        ),
    ),
    Table(
        "Kernels, one GPU",
        "Time of one call, next to gsplat 1.5.3 and plain PyTorch in the same process ([scenes](results/README.md#recordings-and-scenes)).",
        "work",
        KERNEL_COLUMNS,
        (
            kernel("render", "surgical50k_640x512 forward", "0.06 ms", front=True),
            kernel("render", "surgical50k_640x512 forward+backward", "0.30 ms", front=True),
            kernel("render", "volume1m_1080p forward", "0.40 ms", front=True),
            kernel("render", "volume1m_1080p forward, fp16", "0.30 ms"),
            kernel("render", "volume1m_1080p forward+backward", "1.8 ms", front=True),
            kernel("render", "volume4m_4k forward", "1.5 ms"),
            kernel("render", "volume4m_4k forward+backward", "7 ms"),
            Row("`rasterization()`, surgical50k_640x512 forward", "cuda/rasterization", {"work": "surgical50k_640x512 forward"}, asked="0.35 ms"),
            Row("`rasterization()`, surgical50k_640x512 forward+backward", "cuda/rasterization", {"work": "surgical50k_640x512 forward+backward"}, asked="1.2 ms"),
            Row("`rasterization()`, volume1m_1080p forward", "cuda/rasterization", {"work": "volume1m_1080p forward"}, asked="0.9 ms"),
            Row("`rasterization()`, volume1m_1080p forward+backward", "cuda/rasterization", {"work": "volume1m_1080p forward+backward"}, asked="2.8 ms"),
            kernel("training", "training step, basis, 40000 Gaussians of degree 0, 640x512", "0.4 ms", front=True),
            kernel("training", "training step, small, 50000 Gaussians of degree 0, 640x512", "0.6 ms"),
            kernel("deformation", "deform, hexplane 85M, fp32, 50000 Gaussians"),
            kernel("deformation", "deform and render, hexplane 85M, fp32, 50000 Gaussians, 640x512", "0.10 ms"),
        ),
        ("ours", "gsplat 1.5.3"),
    ),
)  # fmt: skip


def log_lines(log: str, logs: Path = LOGS) -> list[dict[str, Any]]:
    """Return the lines of a log; empty if the file does not exist.

    Raises:
        ValueError: if a line lacks a part of its envelope.
    """
    path = logs / f"{log}.jsonl"
    if not path.exists():
        return []
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
    for number, line in enumerate(lines, 1):
        if lacking := [part for part in ENVELOPE if part not in line]:
            raise ValueError(
                f"{path.name} line {number} lacks {', '.join(lacking)}; write logs with benchmarks/suite.py"
            )
    return lines


def lines_of(row: Row, logs: Path = LOGS) -> list[dict[str, Any]]:
    """Return the lines of the row's log that have the values in `row.line`."""
    return [line for line in log_lines(row.log, logs) if all(line.get(key) == value for key, value in row.line.items())]


def results_of(row: Row, logs: Path = LOGS) -> list[dict[str, Any]]:
    """Return the results of the row's lines that have the values in `row.where`."""
    found = [line["result"] for line in lines_of(row, logs) if "result" in line]
    return [result for result in found if all(result.get(key) == value for key, value in row.where.items())]


def table_text(table: Table, logs: Path = LOGS, front: bool = False) -> str:
    """Return the table in Markdown, or the README's part of it; empty if none of its rows has a log."""
    columns = table.readme if front else ()
    rows = [(row, found) for row in table.rows if (row.front or not front) and (found := results_of(row, logs))]
    shown = [
        column
        for column in table.columns
        if (not columns or column.title in columns)
        and any(column.of(each) is not None for _, found in rows for each in found)
    ]
    if not rows:
        return ""
    asked = not columns and any(row.asked for row, _ in rows)
    head = [table.first, *(column.title for column in shown), *(["required"] if asked else [])]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row, results in rows:
        cells = [row.what, *(column.cell(results) for column in shown), *([row.asked] if asked else [])]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def provenance(table: Table, logs: Path = LOGS) -> str:
    """Return a sentence for each machine and commit at which the table's figures were measured."""
    measured: dict[str, set[str]] = {}
    machines: dict[str, list[Mapping[str, Any]]] = {}
    for line in (line for row in table.rows for line in lines_of(row, logs)):
        about = line["machine"]
        gpu = f"{about['gpu']}, " if "gpu" in about else ""
        name = f"{gpu}{about['cores']} cores of {about['cpu']}, {about['instruction_set']}, torch {about['torch']}"
        what = f"commit {line['commit']}, {line['date']}, {name}"
        measured.setdefault(what, set()).add(line["benchmark"])
        machines.setdefault(what, []).append(about)
    stated = [(f"{what}{pauses_text(machines[what])}", names) for what, names in sorted(measured.items())]
    if len(stated) == 1:
        return f"Measured at {stated[0][0]}."
    return " ".join(f"{', '.join(sorted(names))}: measured at {what}." for what, names in stated)


def front_gpus(table: Table, logs: Path = LOGS) -> str:
    """Return the names of the GPUs on which the README's rows of a table were measured; empty for none."""
    machines = [line["machine"] for row in table.rows if row.front for line in lines_of(row, logs)]
    return ", ".join(sorted({machine["gpu"] for machine in machines if "gpu" in machine}))


def failures(logs: Path = LOGS) -> list[str]:
    """Return a Markdown line for each logged command that ended with an error."""
    found = []
    for row in (row for table in TABLES for row in table.rows):
        found += [
            f"- {row.log}, run {line['run']}: exit code {line['exit_code']}"
            for line in lines_of(row, logs)
            if "exit_code" in line
        ]
    return sorted(set(found))


def results_text(logs: Path = LOGS) -> str:
    """Return the text of RESULTS.md."""
    parts = [
        "# Results",
        "Generated by `python benchmarks/publish.py` from the logs in [logs](logs); do not edit. `python benchmarks/suite.py --device cpu` "
        "and `--device cuda` measure again ([suite.py](suite.py) has the commands). Figures are medians; where a figure has several runs, "
        "the worst run and the number of runs follow in brackets. Notes on experiments of earlier commits are in [results](results/README.md); their "
        "figures are not comparable with these.",
    ]
    for table in TABLES:
        if text := table_text(table, logs):
            parts += [f"## {table.title}", table.text, text, provenance(table, logs)]
    if failed := failures(logs):
        parts += ["## Commands that failed", "\n".join(failed)]
    return "\n\n".join(parts) + "\n"


def readme_block(name: str, logs: Path = LOGS) -> str:
    """Return the tables of one block of the README."""
    if name != "figures":
        raise ValueError(f"unknown block of results {name!r} in README.md; there is 'figures'")
    parts = []
    for table in TABLES:
        if table.readme and (text := table_text(table, logs, front=True)):
            gpus = front_gpus(table, logs)
            parts.append(f"**{table.title}{f' ({gpus})' if gpus else ''}**\n\n{text}")
    return "\n\n".join(parts) + "\n" if parts else ""


def with_figures(text: str, logs: Path = LOGS) -> str:
    """Return a document with its blocks of figures generated from the logs."""
    return BLOCK.sub(lambda found: found.group(1) + readme_block(found.group(2), logs) + found.group(3), text)


def documents() -> dict[Path, str]:
    """Return the text of each generated document."""
    return {
        RESULTS: results_text(),
        METHODS: methods_text(),
        GSPLAT: gsplat_text(),
        GENERALITY: generality_text(),
        README: with_figures(README.read_text(encoding="utf-8")),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 where a file would change")
    options = parser.parse_args()
    wanted = documents()
    stale = [path for path, text in wanted.items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    if options.check:
        for path in stale:
            print(f"{path.relative_to(ROOT)} differs from the logs; run python benchmarks/publish.py")
        return 1 if stale else 0
    for path in stale:
        path.write_text(wanted[path], encoding="utf-8")
        print(f"wrote {path.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
