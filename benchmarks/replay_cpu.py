"""Measure whole replays: wall time, peak memory, quality, and equality of the results of both engines.

Usage: python benchmarks/replay_cpu.py RECORDING [--fields basis hexplane] [--frames N] [--engines embedded holoscan]

Prints one JSON line per run, with the run's own report in short; the last line compares the digests of the runs of each field.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def replay(recording: Path, field: str, engine: str, frames: int | None) -> dict[str, Any]:
    """Run `intrasplat replay` once in a child process."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "services.cli", "replay", str(recording), "--out", f"{folder}/out"]
        command += ["--field", field, "--engine", engine, "--json"]
        command += [] if frames is None else ["--max-frames", str(frames)]
        start = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        wall_s = time.perf_counter() - start
    report = json.loads(done.stdout)
    return {
        "field": field,
        "engine": engine,
        "command_wall_s": round(wall_s, 1),
        "peak_memory_MiB": round(report["run"]["peak_memory_bytes"] / 2**20),
        "frames": report["frames"],
        "live": {name: round(value, 3) for name, value in report["quality"]["live"].items()},
        "baselines": {name: round(value, 2) for name, value in report["quality"]["baselines"].items() if value},
        "gaussians": report["model"]["gaussians"],
        "frames_sha256": report["frames_sha256"],
        "load_average": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    """Run the requested replays, the first one twice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--fields", nargs="+", default=["basis", "hexplane"])
    parser.add_argument("--engines", nargs="+", default=["embedded", "holoscan"])
    parser.add_argument("--frames", type=int)
    arguments = parser.parse_args()
    digests: dict[str, list[str]] = {}
    for position, field in enumerate(arguments.fields):
        engines = arguments.engines if position == 0 else arguments.engines[:1]
        for engine in [engines[0], *engines] if position == 0 else engines:
            result = replay(arguments.recording, field, engine, arguments.frames)
            digests.setdefault(field, []).append(result["frames_sha256"])
            print(json.dumps(result), flush=True)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    same = {field: len(set(seen)) == 1 for field, seen in digests.items() if len(seen) > 1}
    print(json.dumps({"same_bytes": same, "largest_process_MiB": round(children.ru_maxrss / 1024)}))


if __name__ == "__main__":
    main()
