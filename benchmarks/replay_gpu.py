"""A whole replay of a real recording on an NVIDIA GPU: frames per second, what start-up and report cost, quality, and same bytes twice.

Usage: python benchmarks/replay_gpu.py RECORDING [--device cuda] [--runs 2] [--frames N] [--field basis] [--steps-per-frame N]

Each run is a process of its own and one JSON line. `streaming_fps` is over the time between the first and the last frame that were shown:
decoding, training, rendering, scoring, video, everything but the start. The last line says whether all runs gave the same bytes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from operators.applications.progress import Progress


def replay_once(arguments: argparse.Namespace) -> dict[str, Any]:
    """One replay in this process, with its reports."""
    marks = [("imports", time.perf_counter())]
    from operators.applications.replay import ReplaySettings, replay
    from services.reports.build import write_reports

    marks.append(("until_first_frame", time.perf_counter()))
    shown_s: list[float] = []

    def on_progress(progress: Progress) -> None:
        if progress.done:
            shown_s.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        settings = ReplaySettings(
            arguments.recording,
            Path(folder) / "out",
            device=arguments.device,
            field=arguments.field,
            steps_per_frame=arguments.steps_per_frame,
            max_frames=arguments.frames,
        )
        outcome = replay(settings, on_progress)
        marks += [("streaming", shown_s[0]), ("save_and_baselines", shown_s[-1]), ("reports", time.perf_counter())]
        report = write_reports(outcome, settings.out)
    marks.append(("end", time.perf_counter()))
    parts = {name: round(until - since, 2) for (name, since), (_, until) in pairwise(marks)}
    live = report.quality.live
    assert live is not None and report.model is not None
    return {
        "device": arguments.device,
        "field": report.run.field,
        "frames": len(shown_s),
        "steps_per_frame": report.run.steps_per_frame,
        "streaming_fps": round((len(shown_s) - 1) / (shown_s[-1] - shown_s[0]), 2),
        "seconds": parts,
        "operators_p50_ms": {name: times.p50_ms for name, times in report.operators.items()},
        "psnr_tissue_db": None if live.psnr_tissue_db is None else round(live.psnr_tissue_db, 3),
        "ssim": None if live.ssim is None else round(live.ssim, 4),
        "gaussians": report.model.gaussians,
        "dropped": report.frames.dropped,
        "frames_sha256": report.frames_sha256,
        "model_sha256": report.model.sha256,
    }


def main() -> None:
    """Run the replays, each in a fresh process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--field", default="auto")
    parser.add_argument("--steps-per-frame", type=int)
    parser.add_argument("--in-this-process", action="store_true", help="one run, here")
    arguments = parser.parse_args()
    if arguments.in_this_process:
        print(json.dumps(replay_once(arguments)), flush=True)
        return
    digests = set()
    for _ in range(arguments.runs):
        command = [sys.executable, __file__, *sys.argv[1:], "--in-this-process"]
        line = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout.strip().splitlines()[-1]
        print(line, flush=True)
        digests.add(json.loads(line)["frames_sha256"])
    print(json.dumps({"runs": arguments.runs, "same_bytes": len(digests) == 1}))


if __name__ == "__main__":
    main()
