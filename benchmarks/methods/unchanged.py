"""Compare rendering, replay and live of this tree with those of an older one, on one machine in turn.

    git archive COMMIT --prefix=old/ | tar x -C /tmp && /tmp/old/benchmarks/gpu_build.sh
    python benchmarks/methods/unchanged.py /tmp/old --device cuda

Both trees must be built. Runs alternate between the trees. The log has medians and worst runs of both trees, and ratios
of the medians. gsplat is not compared here and slows the run down if it is installed.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import log

NEW = Path(__file__).resolve().parents[2]
RECORDINGS = {"cutting": "cutting", "heart": "heart/left.mp4"}
SCENES = ("surgical50k_640x512", "volume1m_1080p")
WORKS = (("render", ""), ("replay", "cutting"), ("live", "cutting"), ("live", "heart"))
"""Kind and recording of each comparison."""
LIVE = {
    "age, median (ms)": "live.age_p50_ms",
    "age, p99 (ms)": "live.age_p99_ms",
    "first picture (ms)": "live.first_picture_ms",
    "displayed frame, training error (dB)": "quality.live.psnr_tissue_db",
    "training steps": "live.steps",
}
REPLAY = {"time of the frames (s)": "run.wall_s", "time of the command (s)": "wall_s"}
RENDER = {"queued frame (ms)": "ours_queued_ms", "kernels (ms)": "ours_kernel_ms"}
TIMED = ("forward", "forward+backward", "forward+backward+Adam in one", "FrameRenderer, a new camera every frame")
"""Works of `gpu_splat.py` that are compared."""
HIGHER_IS_WORSE = ("(ms)", "(s)")


def lines(tree: Path, *words: str) -> list[dict[str, Any]]:
    """Run a benchmark of a tree and return its JSON lines."""
    others = [each for each in os.environ.get("PYTHONPATH", "").split(":") if each and Path(each).resolve() != NEW]
    done = subprocess.run(
        [sys.executable, *words], cwd=tree, env=os.environ | {"PYTHONPATH": ":".join([str(tree), *others])},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{tree}: {' '.join(words)} failed:\n{done.stderr[-2000:]}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def at(found: dict[str, Any], path: str) -> float:
    """Return the number at a dotted path."""
    value: Any = found
    for key in path.split("."):
        value = value[key]
    return float(value)


def measured(tree: Path, kind: str, name: str, device: str, repetitions: int) -> dict[str, float]:
    """Return the figures of one run."""
    if kind == "render":
        found = lines(tree, "benchmarks/gpu_splat.py", "--scenes", *SCENES, "--repetitions", str(repetitions))
        return {
            f"{each['work']}: {what}": at(each, path)
            for each in found
            if each["work"].split(" ", 1)[-1] in TIMED
            for what, path in RENDER.items()
        }
    recordings = Path(os.environ.get("INTRASPLAT_RECORDINGS", NEW.parent / "shared" / "recordings"))
    options = ("--fps", "30") if kind == "live" else ()
    path = str(recordings / RECORDINGS[name])
    (report,) = lines(tree, "benchmarks/plain.py", kind, path, "--device", device, *options)
    return {what: round(at(report, place), 3) for what, place in (LIVE if kind == "live" else REPLAY).items()}


def compared(runs: dict[str, list[dict[str, float]]]) -> dict[str, Any]:
    """Return medians, worst runs and the ratio of the medians of each figure."""
    result: dict[str, Any] = {}
    for what in runs["new"][0]:
        worst = max if what.endswith(HIGHER_IS_WORSE) else min
        row: dict[str, Any] = {}
        for tree, found in runs.items():
            values = [each[what] for each in found if what in each]
            if values:
                row[tree], row[f"{tree}_worst"] = round(statistics.median(values), 4), worst(values)
        if row.get("old"):
            row["ratio"] = round(row["new"] / row["old"], 3)
        result[what] = row
    return result


def main() -> None:
    """Measure and log."""
    parser = log.options((__doc__ or "").splitlines()[0])
    parser.add_argument("old", type=Path, help="built tree of the older commit")
    parser.add_argument("--old-commit", default="", help="commit of the older tree, for the log")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--repetitions", type=int, default=100, help="frames of a timing of the renderer")
    parser.add_argument(
        "--kinds", nargs="+", choices=["render", "replay", "live"], default=["render", "replay", "live"]
    )
    chosen = parser.parse_args()
    trees = {"old": chosen.old.resolve(), "new": NEW}
    figures: dict[str, Any] = {"old_commit": chosen.old_commit, "runs": chosen.runs}
    for kind, name in WORKS:
        if kind not in chosen.kinds:
            continue
        runs: dict[str, list[dict[str, float]]] = {tree: [] for tree in trees}
        for _ in range(chosen.runs):
            for tree, path in trees.items():
                runs[tree].append(measured(path, kind, name, chosen.device, chosen.repetitions))
        figures[f"{kind} {name}".strip()] = compared(runs)
        log.write("unchanged", chosen, figures)  # after each comparison, because a later one may fail


if __name__ == "__main__":
    main()
