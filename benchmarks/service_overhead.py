"""Compare a served stream with bare `live` on the same source and settings: processor time per frame and picture age.

    python benchmarks/service_overhead.py --seconds 15 --rounds 2

Bare and served runs alternate. The served stream runs without a viewer, then with one viewer of the reconstruction, one of the raw picture, and a subscriber that reads
the ages. Processor time is user and system time of all processes, including the control plane. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from service_server import STREAM, Server, cpu_s
from service_viewers import watch
from service_watchers import Watch, quantiles

SOURCE = "synthetic:?width=320&height=256&frames=24&fps=30"


def bare(options: argparse.Namespace) -> dict[str, Any]:
    """Run `live` in this process and measure it."""
    from operators.applications.live import live
    from services.supervisor.engine import live_settings
    from services.supervisor.worker import EngineSpec

    shown: list[tuple[float, int]] = []
    steps: list[int] = []

    def on_shown(picture: Any) -> None:
        if picture.new:
            shown.append((time.monotonic(), picture.age_ns))
            steps.append(picture.rendered.steps)

    with tempfile.TemporaryDirectory() as folder:
        spec = EngineSpec(device=options.device, budget_ms=options.budget_ms)
        settings = replace(live_settings(spec, Path(folder) / "out", options.source), loop=True)
        over = threading.Event()
        running = threading.Thread(
            target=lambda: live(settings, stop_requested=over.is_set, on_shown=on_shown), daemon=True
        )
        running.start()
        while len(shown) < 5:
            time.sleep(0.05)
        time.sleep(options.settle)
        shown.clear()
        steps.clear()
        used_s, began_s = tree_cpu_s(), time.monotonic()
        time.sleep(options.seconds)
        used_s, took_s = tree_cpu_s() - used_s, time.monotonic() - began_s
        ages_ms = [age * 1e-6 for _, age in shown]
        result = {
            "cpu_ms_per_frame": round(1e3 * used_s / (options.fps * took_s), 3),
            "pictures_per_s": round(len(ages_ms) / took_s, 2),
            "age_ms": quantiles(ages_ms),
            "steps_per_picture": round(sum(steps) / max(1, len(steps)), 2),
        }
        over.set()
        running.join(20)
    return result


def tree_cpu_s() -> float:
    """Return the processor time of this process and its descendants."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue  # it has ended meanwhile
    own, found = {os.getpid()}, 0
    while len(own) != found:
        found = len(own)
        own |= {pid for pid, parent in parents.items() if parent in own}
    return sum(cpu_s(pid) for pid in own)


def served(options: argparse.Namespace) -> dict[str, Any]:
    """Run the source through the service and measure it."""
    wanted = {"engine_scale": 1.0}  # bare `live` reconstructs the whole picture
    if options.budget_ms is not None:
        wanted["budget_ms"] = options.budget_ms
    with Server(options.source, device=options.device, options=wanted) as server:
        server.until_live()
        time.sleep(options.settle)
        pids = server.pids()
        result = {"no_viewer": _window(server, pids, options)}
        engine = Watch(f"ipc://{server.runtime / STREAM / 'shown'}")
        result["viewers"] = asyncio.run(_watched(server, pids, options, engine))
        engine.close()
    return result


def _window(server: Server, pids: dict[str, int], options: argparse.Namespace, engine: Watch | None = None) -> dict:
    """Measure one time window. With `engine`, ages are measured too, which costs some time."""
    if engine is not None:
        engine.begin()
    before, began_s, pictures = {name: cpu_s(pid) for name, pid in pids.items()}, time.monotonic(), shown_so_far(server)
    time.sleep(options.seconds)
    took_s = time.monotonic() - began_s
    used = {name: cpu_s(pid) - before[name] for name, pid in pids.items()}
    result = {
        "cpu_ms_per_frame": round(1e3 * sum(used.values()) / (options.fps * took_s), 3),
        "of_it": {name: round(1e3 * value / (options.fps * took_s), 3) for name, value in used.items()},
        "pictures_per_s": round((shown_so_far(server) - pictures) / took_s, 2),
    }
    if engine is not None:
        result["age_ms"] = quantiles(engine.shown_ms)
        result["steps_per_picture"] = round(sum(engine.steps) / max(1, len(engine.steps)), 2)
    return result


def shown_so_far(server: Server) -> int:
    """Return the number of new pictures of the engine."""
    return server.stream()["processes"]["engine"]["figures"]["pictures"]


async def _watched(server: Server, pids: dict[str, int], options: argparse.Namespace, engine: Watch) -> dict[str, Any]:
    viewers = {kind: await watch(server.port, server.ticket(), kind) for kind in ("shown", "raw")}
    await asyncio.sleep(1)
    for viewer in viewers.values():
        viewer.begin()
    result = await asyncio.to_thread(_window, server, pids, options, engine)
    return {**result, "age_at_client_ms": {kind: quantiles(viewer.ages_ms) for kind, viewer in viewers.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default=SOURCE)
    parser.add_argument("--fps", type=float, default=30.0, help="frame rate of the source")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--budget-ms", type=float)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--settle", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--bare", action="store_true", help="measure only `live`, in this process")
    options = parser.parse_args()
    if options.bare:
        print(json.dumps(bare(options)))
        return
    runs: dict[str, list[Any]] = {"bare": [], "served": []}
    for _ in range(options.rounds):
        done = subprocess.run([sys.executable, __file__, *sys.argv[1:], "--bare"], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr[-2000:])
        runs["bare"].append(json.loads(done.stdout.splitlines()[-1]))
        runs["served"].append(served(options))
    mean = lambda values: sum(values) / len(values)
    alone_ms = mean([run["cpu_ms_per_frame"] for run in runs["bare"]])
    age_ms = mean([run["age_ms"]["p50"] for run in runs["bare"]])
    summary: dict[str, Any] = {
        name: {
            "cpu_percent_more": round(
                100 * (mean([r[name]["cpu_ms_per_frame"] for r in runs["served"]]) / alone_ms - 1), 2
            )
        }
        for name in ("no_viewer", "viewers")
    }
    summary["viewers"]["age_p50_ms_more"] = round(
        mean([run["viewers"]["age_ms"]["p50"] for run in runs["served"]]) - age_ms, 2
    )
    print(json.dumps({**summary, **runs}, indent=2))


if __name__ == "__main__":
    main()
