"""Run several live streams at once on one GPU, as one server does for several operating rooms.

    python benchmarks/rooms.py RECORDING --rooms 4 --device cuda --mps

Each room is an `intrasplat live` of its own, which loops the recording. Prints one JSON line: the figures of every room. With --mps, NVIDIA's
Multi-Process Service lets the rooms use the GPU at the same time; without it, they take turns. It runs for the duration of the benchmark.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

PLAIN = Path(__file__).resolve().parent / "plain.py"


def room(figures: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of one room from the line of `plain.py`."""
    live = figures["live"]
    return {
        "displayed_db": live["settled_psnr_tissue_db"],
        "worst_db": live["worst_psnr_tissue_db"],
        "previous_frame_db": live["previous_frame_db"],
        "age_p99_ms": live["settled_age_p99_ms"],
        "late": live["not_on_screen"],
        "frames": figures["frames"]["ingested"],
    }


@contextmanager
def multi_process_service() -> Iterator[Mapping[str, str]]:
    """Run NVIDIA's Multi-Process Service with folders of its own. Yields the environment of the processes that use it."""
    with tempfile.TemporaryDirectory(prefix="mps-", ignore_cleanup_errors=True) as folder:
        environment = {**os.environ, "CUDA_MPS_PIPE_DIRECTORY": folder, "CUDA_MPS_LOG_DIRECTORY": folder}
        # The rooms' CUDA_VISIBLE_DEVICES counts the daemon's GPUs, which must therefore be all.
        of_daemon = {name: value for name, value in environment.items() if name != "CUDA_VISIBLE_DEVICES"}
        control = "nvidia-cuda-mps-control"
        subprocess.run([control, "-d"], env=of_daemon, check=True, stdout=subprocess.DEVNULL)
        try:
            yield environment
        finally:
            subprocess.run([control], input="quit\n", text=True, env=environment, check=True, stdout=subprocess.DEVNULL)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--rooms", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=15.0, help="duration of each stream")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--mps", action="store_true", help="use NVIDIA's Multi-Process Service")
    options = parser.parse_args()
    with multi_process_service() if options.mps else nullcontext(os.environ) as environment:
        return measure(options, environment)


def measure(options: argparse.Namespace, environment: Mapping[str, str]) -> int:
    """Run the rooms and print their figures; return the exit code."""
    words = [sys.executable, str(PLAIN), "live", options.recording, "--device", options.device, "--fps", "30", "--loop"]
    words += ["--seconds", str(options.seconds)]
    running = [
        subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(options.rooms)
    ]
    ended = [(each, *each.communicate()) for each in running]
    for process, _, errors in ended:
        if process.returncode != 0:
            print(errors[-2000:], file=sys.stderr)
            return int(process.returncode)
    rooms = [room(json.loads(text)) for _, text, _ in ended]
    summary = {
        "rooms": len(rooms),
        "mps": options.mps,
        "displayed_db": min(each["displayed_db"] for each in rooms),
        "previous_frame_db": rooms[0]["previous_frame_db"],
        "age_p99_ms": max(each["age_p99_ms"] for each in rooms),
        "late": max(each["late"] for each in rooms),
        "frames": rooms[0]["frames"],
        "each": rooms,
    }
    print(json.dumps(summary))
    return 0


if __name__ == "__main__":
    sys.exit(main())
