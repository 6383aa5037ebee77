"""Measure how long saving a 69 MB model blocks other threads, as seen by a thread that sleeps 0.2 ms at a time.

    python benchmarks/save_pauses.py [--saves 4]

Prints a line of JSON for each, and for as long without saving.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import torch

from gsplat_core import Camera, Gaussians
from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model

COUNT = 200_000
SLEEP_S = 0.0002


def pauses_during(work: Callable[[], object]) -> dict[str, float]:
    """Return the gaps that another thread observes while `work` runs."""
    gaps_s: list[float] = []
    over = threading.Event()

    def look() -> None:
        last_s = time.perf_counter()
        while not over.is_set():
            time.sleep(SLEEP_S)
            now_s = time.perf_counter()
            gaps_s.append(now_s - last_s - SLEEP_S)
            last_s = now_s

    looking = threading.Thread(target=look)
    looking.start()
    time.sleep(0.05)
    began_s, cpu_s = time.perf_counter(), time.thread_time()
    work()
    took_s, cpu_s = time.perf_counter() - began_s, time.thread_time() - cpu_s
    over.set()
    looking.join()
    return {
        "took_ms": round(took_s * 1e3, 1),
        "cpu_ms": round(cpu_s * 1e3, 1),
        "longest_pause_ms": round(max(gaps_s) * 1e3, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--saves", type=int, default=4)
    saves = parser.parse_args().saves
    quats = torch.nn.functional.normalize(torch.randn(COUNT, 4), dim=1)
    gaussians = Gaussians(
        torch.randn(COUNT, 3), quats, torch.randn(COUNT, 3), torch.randn(COUNT), torch.randn(COUNT, 25, 3)
    )
    model = Model(1, gaussians, None, Camera.from_focal(40.0, 64, 48), (0.0, 1.0))
    with tempfile.TemporaryDirectory() as folder:
        for number in range(saves):
            print(json.dumps({"part": "nothing", **pauses_during(lambda: time.sleep(0.3))}), flush=True)
            path = Path(folder) / str(number)
            print(json.dumps({"part": "save", **pauses_during(lambda path=path: save_bundle(model, path))}), flush=True)


if __name__ == "__main__":
    main()
