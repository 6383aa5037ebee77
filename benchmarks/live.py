"""How well `intrasplat live` keeps up with a camera: quality and age of what is shown, and what was passed over.

    python benchmarks/live.py --device cuda cutting=RECORDING cutting60=RECORDING@60 sinus=RECORDING heart=RECORDING

Each entry is NAME=SOURCE, with @FPS to play a recording at another rate; each run is the whole command, in a process of its own, and one
JSON line. `--budget-ms` and `--scale` are the command's.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

FIGURES = (
    "settled_psnr_tissue_db", "worst_psnr_tissue_db", "previous_frame_db", "age_p50_ms", "age_p95_ms", "age_p99_ms",
    "age_max_ms", "first_picture_ms", "pictures", "not_on_screen", "unscored", "dropped", "withheld", "scenes", "states",
    "frames_trained", "steps", "rehearsed_steps",
)  # fmt: skip


def run_live(name: str, source: str, fps: str | None, arguments: argparse.Namespace) -> dict[str, Any]:
    """One run of the command; its figures."""
    command = [
        sys.executable, "-m", "services.cli", "live", source, "--device", arguments.device, "--json",
        "--scale", str(arguments.scale), "--budget-ms", arguments.budget_ms,
    ]  # fmt: skip
    command += ["--fps", fps] if fps else []
    command += ["--seconds", str(arguments.seconds)] if arguments.seconds else []
    command += ["--loop"] if arguments.loop else []
    command += ["--out", str(arguments.keep / name)] if arguments.keep else []
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        return {"name": name, "rc": done.returncode, "error": done.stderr[-2000:]}
    report = json.loads(done.stdout)
    figures = {figure: report["live"][figure] for figure in FIGURES}
    operators = {operator: (times["p50_ms"], times["p99_ms"]) for operator, times in report["operators"].items()}
    frames = report["frames"]["ingested"]
    return {"name": name, "ingested": frames, **figures, "operators_p50_p99_ms": operators, "notes": report["notes"]}


def main() -> None:
    """Run them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--budget-ms", default="auto")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--loop", action="store_true")
    parser.add_argument("--keep", type=Path, help="keep each run's folder in this one")
    arguments = parser.parse_args()
    for entry in arguments.runs:
        name, _, source = entry.partition("=")
        source, _, fps = source.partition("@")
        print(json.dumps(run_live(name, source, fps or None, arguments)), flush=True)


if __name__ == "__main__":
    main()
