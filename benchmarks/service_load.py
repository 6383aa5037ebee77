"""Measure a crowd's effect on a real `intrasplat serve`: stream rate, server memory, and other viewers and clients.

    python benchmarks/service_load.py --viewers 50 --slow 10 --requests 200

Measures without viewers, with them, and without them again: rates of capture and engine; ages of pictures at the healthy viewers, from a frame's arrival at the capture
process; response times of the API. All viewers are in this process, and nothing is decoded. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import time
from typing import Any

from service_server import Server, cpu_s, machine_busy_s, resident_mib
from service_viewers import SlowViewer, watch
from service_watchers import quantiles

SOURCE = "synthetic:?width=640&height=512&frames=24&fps=30"
ROUTES = ("/v1/streams", "/v1/version", "/v1/models")


class Marks:
    """Counters of the stream's processes at one time."""

    def __init__(self, server: Server, pids: dict[str, int]) -> None:
        processes = server.stream()["processes"]
        capture, engine = processes["capture"]["figures"], processes["engine"]["figures"]
        self.frames = capture["frames"], capture["last_frame_ns"]
        self.pictures = engine["pictures"], engine["picture"]["shown_ns"]
        self.steps = engine.get("steps", 0)
        self.cpu_s = {name: cpu_s(pid) for name, pid in pids.items()}
        self.cpu_s["this"] = time.process_time()
        self.machine_s = machine_busy_s()
        self.at_s = time.monotonic()

    def since(self, earlier: Marks) -> dict[str, Any]:
        """Return rates and processor shares since an earlier reading."""
        took_s = self.at_s - earlier.at_s
        own = {name: round((after - earlier.cpu_s[name]) / took_s, 3) for name, after in self.cpu_s.items()}
        return {
            "source_fps": round(_rate(earlier.frames, self.frames), 3),
            "engine_fps": round(_rate(earlier.pictures, self.pictures), 3),
            "engine_steps_per_s": round((self.steps - earlier.steps) / took_s, 1),
            "cpu": {**own, "others": round((self.machine_s - earlier.machine_s) / took_s - sum(own.values()), 3)},
        }


def _rate(before: tuple[int, int], after: tuple[int, int]) -> float:
    return (after[0] - before[0]) * 1e9 / max(1, after[1] - before[1])


async def phase(server: Server, pids: dict[str, int], seconds: float) -> dict[str, Any]:
    """Run for a while and return the rates."""
    before = await asyncio.to_thread(Marks, server, pids)
    await asyncio.sleep(seconds)
    return (await asyncio.to_thread(Marks, server, pids)).since(before)


async def asking(server: Server, per_s: float, took_ms: list[float]) -> None:
    """Send API requests at a fixed rate over eight connections, even if the server falls behind."""
    connections: asyncio.Queue = asyncio.Queue()
    for _ in range(8):
        connections.put_nowait(await asyncio.open_connection("127.0.0.1", server.port))
    key, count, began_s = server.key, 0, time.monotonic()

    async def one(path: str, due_s: float) -> None:
        reader, writer = await connections.get()
        writer.write(
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nAuthorization: Bearer {key}\r\n\r\n".encode()
        )
        head = await reader.readuntil(b"\r\n\r\n")
        assert b" 200 " in head[:15], head
        length = next(line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
        await reader.readexactly(int(length.split(b":")[1]))
        took_ms.append((time.monotonic() - due_s) * 1e3)
        connections.put_nowait((reader, writer))

    async with asyncio.TaskGroup() as group:
        while True:
            due_s = began_s + count / per_s
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            group.create_task(one(ROUTES[count % len(ROUTES)], due_s))
            count += 1


async def memory(pid: int, found: list[float]) -> None:
    """Sample the control plane's resident memory twice per second."""
    while True:
        found.append(resident_mib(pid))
        await asyncio.sleep(0.5)


async def measured(server: Server, options: argparse.Namespace) -> dict[str, Any]:
    pids = await asyncio.to_thread(server.pids)
    await asyncio.sleep(options.settle)
    result: dict[str, Any] = {"without": await phase(server, pids, options.seconds)}
    ticket = lambda: asyncio.to_thread(server.ticket)
    kinds = {"both": ("raw", "shown")}.get(options.kind, (options.kind,))
    healthy = [
        await watch(server.port, await ticket(), kinds[index % len(kinds)], options.quality)
        for index in range(options.viewers - options.slow)
    ]
    slow = [SlowViewer(server.port, ticket, kinds[index % len(kinds)]) for index in range(options.slow)]
    took_ms: list[float] = []
    used_mib: list[float] = []
    beside = [asyncio.create_task(asking(server, options.requests, took_ms))] if options.requests else []
    beside.append(asyncio.create_task(memory(pids["control"], used_mib)))
    await asyncio.sleep(options.settle)
    for viewer in healthy:
        viewer.begin()
    took_ms.clear()
    used_mib.clear()
    result["with"] = await phase(server, pids, options.seconds)
    result["healthy"] = {
        kind: {
            "viewers": len(
                of_kind := [viewer for viewer in healthy if f"picture={kind}" == f"picture={viewer.last['picture']}"]
            ),
            "pictures_per_s": round(sum(each.pictures for each in of_kind) / len(of_kind) / options.seconds, 2),
            "kib": round(
                sum(each.bytes for each in of_kind) / max(1, sum(each.pictures for each in of_kind)) / 1024, 1
            ),
            "age_ms": quantiles([age for each in of_kind for age in each.ages_ms]),
        }
        for kind in kinds
    }
    result["api_ms"] = {**quantiles(took_ms), "per_s": round(len(took_ms) / options.seconds, 1)} if took_ms else None
    quarter = max(1, len(used_mib) // 4)
    result["control_mib"] = {
        "first": round(sum(used_mib[:quarter]) / quarter, 1), "last": round(sum(used_mib[-quarter:]) / quarter, 1), "most": max(used_mib),
    }  # fmt: skip
    result["slow_cut_off"] = sum(viewer.cut_off for viewer in slow)
    for task in (*beside, *(viewer.task for viewer in slow)):
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    for viewer in healthy:
        viewer.close()
    await asyncio.sleep(1)
    result["after"] = await phase(server, pids, options.seconds)
    for name in ("source_fps", "engine_fps"):
        alone = (result["without"][name] + result["after"][name]) / 2
        result[f"{name}_change_percent"] = round(100 * (result["with"][name] / alone - 1), 2)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default=SOURCE)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--options", type=json.loads, default={}, help="stream options as JSON")
    parser.add_argument("--viewers", type=int, default=50)
    parser.add_argument("--slow", type=int, default=10, help="number of viewers that read one byte per second")
    parser.add_argument("--kind", choices=["raw", "shown", "both"], default="raw")
    parser.add_argument("--quality", type=int, default=75)
    parser.add_argument("--requests", type=float, default=200.0, help="API requests per second")
    parser.add_argument("--seconds", type=float, default=20.0, help="seconds per phase")
    parser.add_argument("--settle", type=float, default=3.0)
    options = parser.parse_args()
    with Server(options.source, device=options.device, options=options.options) as server:
        server.until_live()
        result = asyncio.run(measured(server, options))
    print(json.dumps({**result, "load": round(os.getloadavg()[0], 2)}, indent=2))


if __name__ == "__main__":
    main()
