"""Measure several streams of one service on one GPU, without and with NVIDIA's Multi-Process Service (`gpu.mps`).

    python benchmarks/service_rooms.py --source "realtime:RECORDING?loop=1&fps=30" --device cuda --rooms 4 --seconds 15 --rounds 2

Services without and with the setting alternate; each has the streams started together. One JSON line per service: ages as the pictures' headers say, new
pictures per second and the mean PSNR of each stream (training error), and the processes that the Multi-Process Service reports as its clients.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import time
from typing import Any

from run_facts import run_facts
from service_server import Server
from service_watchers import Watch, quantiles

from services.supervisor.gpu_sharing import CONTROL, FOLDER, variables

SOURCE = "synthetic:?width=320&height=256&frames=24&fps=30"
LIVE_WITHIN_S = 120.0


def measured(options: argparse.Namespace, mps: bool) -> dict[str, Any]:
    """Run one service with all streams and measure them."""
    names = [f"room-{number}" for number in range(1, options.rooms + 1)]
    stream = {"source": options.source, "device": options.device, "show": "live", "options": {"engine_scale": 1.0}}
    sections = {"streams": dict.fromkeys(names, stream), "gpu": {"mps": mps}}
    with Server(options.source, device=options.device, sections=sections) as server:
        until_live(server, names)
        watches = {name: Watch(f"ipc://{server.runtime / name / 'shown'}") for name in names}
        time.sleep(options.settle)
        scores: dict[str, list[float]] = {name: [] for name in names}
        began_s = time.monotonic()
        for watch in watches.values():
            watch.begin()
        while time.monotonic() - began_s < options.seconds:
            time.sleep(0.5)
            for name in names:
                picture = process_of(server, name, "engine")["figures"].get("picture") or {}
                scores[name] += [picture["psnr_db"]] if picture.get("psnr_db") is not None else []
        took_s = time.monotonic() - began_s
        rooms = [
            {
                "age_ms": quantiles(list(watches[name].shown_ms)),
                "pictures_per_s": round(len(watches[name].shown_ms) / took_s, 2),
                "displayed_db": round(statistics.mean(scores[name]), 2) if scores[name] else None,
            }
            for name in names
        ]
        engines = {process_of(server, name, "engine")["pid"] for name in names}
        found = clients(server) if mps else set()
        for watch in watches.values():
            watch.close()
    return {"mps": mps, "engines": len(engines), "engines_with_mps": len(engines & found), "rooms": rooms}


def process_of(server: Server, name: str, role: str) -> dict[str, Any]:
    """Return the state of a stream's process from the API."""
    return server.ask(f"/v1/streams/{name}")["processes"][role]


def until_live(server: Server, names: list[str]) -> None:
    """Wait until all streams show pictures as live.

    Raises:
        TimeoutError: with the logs, if one does not.
    """
    began_s = time.monotonic()
    while waiting := [name for name in names if server.ask(f"/v1/streams/{name}")["state"] != "live"]:
        if time.monotonic() - began_s > LIVE_WITHIN_S:
            files = [server.path / "serve.log", *server.runtime.glob("*/*.log")]
            said = "\n".join(f"{file}: {file.read_text(errors='replace')[-1500:]}" for file in files if file.exists())
            raise TimeoutError(f"not live after {LIVE_WITHIN_S:g} s: {', '.join(waiting)}\n{said}")
        time.sleep(0.1)


def clients(server: Server) -> set[int]:
    """Return the process ids of the clients of the service's Multi-Process Service."""
    environment = {**os.environ, **variables(server.runtime / FOLDER)}

    def ask(command: str) -> list[int]:
        said = subprocess.run(
            [CONTROL], input=f"{command}\n", env=environment, capture_output=True, text=True, check=True
        )
        return [int(word) for word in said.stdout.split() if word.isdigit()]

    return {client for daemon in ask("get_server_list") for client in ask(f"get_client_list {daemon}")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default=SOURCE)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--rooms", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--settle", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--without-mps", action="store_true", help="only measure services without the setting")
    options = parser.parse_args()
    for round_ in range(1, options.rounds + 1):
        for mps in (False,) if options.without_mps else (False, True):
            print(json.dumps({"round": round_, **measured(options, mps), **run_facts()}), flush=True)


if __name__ == "__main__":
    main()
