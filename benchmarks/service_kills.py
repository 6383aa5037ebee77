"""Kill the service's processes by SIGKILL while viewers watch; measure interruptions and check that stored data is intact.

    python benchmarks/service_kills.py engine --kills 20     also: capture, control

Runs `intrasplat serve` with one stream. Two viewers watch raw pictures and two the reconstruction, over WebSocket. If the control plane is killed, two subscribers watch
the pictures of capture and engine, and the clock stops when the next control plane has adopted both and shows pictures. Meanwhile a model is activated and rolled back
repeatedly. At the end every answered change must be in the audit log and in the registry, and the log must be intact. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import signal
import sys
import threading
import time
from typing import Any

import service_models
from service_server import STREAM, Server
from service_viewers import FastViewer, watch
from service_watchers import Watch, quantiles

from services.audit.reading import verify

SOURCE = "synthetic:?width=640&height=512&frames=24&fps=30"
BACK_WITHIN_S = 60.0


class Changes:
    """Thread that activates and rolls back models and records the answers."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._versions = [
            service_models.upload(server, service_models.packed_model(seed, 100, 64, 48)) for seed in (1, 2)
        ]
        service_models.activate(server, self._versions[0], None)
        self.answered = {"model.activate": 1, "model.rollback": 0}
        self.unanswered = 0
        self._stop = threading.Event()
        self._before = service_models.registered(server)["versions"]
        self._thread = threading.Thread(target=self._change, daemon=True)
        self._thread.start()

    def _change(self) -> None:
        one, other = self._versions
        while not self._stop.wait(0.2):
            try:
                if service_models.registered(self._server)["active"] == one:
                    service_models.activate(self._server, other, one)
                    self.answered["model.activate"] += 1
                else:
                    service_models.roll_back(self._server)
                    self.answered["model.rollback"] += 1
            except (OSError, RuntimeError, ValueError):  # no server is listening, or it was killed while it answered
                self.unanswered += 1

    def kept(self) -> dict[str, Any]:
        """Stop, and report which recorded changes are stored."""
        self._stop.set()
        self._thread.join()
        path = self._server.data / "audit.jsonl"
        verdict = verify(path)
        entries = [json.loads(line) for line in path.read_text().splitlines()]
        done = {event: sum(e["event"] == event and e["outcome"] == "done" for e in entries) for event in self.answered}
        now = service_models.registered(self._server)
        return {
            "audit_intact": verdict.intact,
            "audit_entries": verdict.entries,
            "changes_answered": sum(self.answered.values()),
            "changes_not_answered": self.unanswered,
            "answered_but_not_in_the_log": sum(max(0, self.answered[event] - done[event]) for event in done),
            "versions_unchanged": now["versions"] == self._before,
            "active": now["active"],
        }


async def until(what: Any, within_s: float = BACK_WITHIN_S) -> None:
    """Wait until a condition holds."""
    async with asyncio.timeout(within_s):
        while not what():
            await asyncio.sleep(0.005)


def newer(viewer: FastViewer, at_ns: int) -> bool:
    """Return true if the viewer has a picture of a frame that arrived after `at_ns`."""
    return viewer.last.get("new", True) is True and viewer.last.get("arrived_ns", 0) > at_ns


async def role_killed(server: Server, role: str, options: argparse.Namespace) -> dict[str, Any]:
    """Kill capture or engine repeatedly and measure the interruptions."""
    choose = random.Random(options.seed)
    viewers = {kind: [await watch(server.port, server.ticket(), kind) for _ in range(2)] for kind in ("raw", "shown")}
    watched = viewers["raw" if role == "capture" else "shown"][0]
    await until(lambda: all(viewer.pictures > 5 for each in viewers.values() for viewer in each))
    for viewer in (*viewers["raw"], *viewers["shown"]):
        viewer.begin()
    back_s = []
    for _ in range(options.kills):
        await asyncio.sleep(choose.uniform(*options.every))
        pid = (await asyncio.to_thread(server.pids))[role]
        if pid is None:
            continue  # it was killed while it was being started
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        await until(lambda at=killed_ns: newer(watched, at))
        back_s.append((watched.last_ns - killed_ns) * 1e-9)
        print(f"back after {back_s[-1]:.2f} s", file=sys.stderr, flush=True)
    gaps = [gap for viewer in viewers["raw"] for gap in viewer.gaps_ms]
    return {
        "kills": len(back_s),
        "back_s": quantiles(back_s),
        "over_3_s": sum(each > 3 for each in back_s),
        "raw_gap_ms": {**quantiles(gaps), "over_100": sum(gap > 100 for gap in gaps), "pictures": len(gaps)},
    }


async def control_killed(server: Server, options: argparse.Namespace) -> dict[str, Any]:
    """Kill the control plane repeatedly and measure the interruptions."""
    choose = random.Random(options.seed)
    folder = server.runtime / STREAM
    raw, shown = (Watch(f"ipc://{folder / name}") for name in ("raw", "shown"))
    await until(lambda: raw.pictures > 5 and shown.pictures > 5)
    raw.begin(), shown.begin()
    back_s, api_s, adopted = [], [], 0
    for _ in range(options.kills):
        await asyncio.sleep(choose.uniform(*options.every))
        before = await asyncio.to_thread(server.pids)
        killed_s = time.monotonic()
        await asyncio.to_thread(server.kill)
        api_s.append(await asyncio.to_thread(server.start))
        await asyncio.to_thread(server.until_live)
        viewer = await watch(server.port, server.ticket(), "shown")
        await until(lambda v=viewer: v.pictures > 0)
        back_s.append(time.monotonic() - killed_s)
        viewer.close()
        after = await asyncio.to_thread(server.pids)
        adopted += all(before[role] == after[role] for role in ("capture", "engine"))
        print(f"back after {back_s[-1]:.2f} s", file=sys.stderr, flush=True)
    result = {
        "kills": len(back_s),
        "adopted_both": adopted,
        "api_answers_after_s": quantiles(api_s),
        "pictures_over_the_api_again_after_s": quantiles(back_s),
        "engine_gap_ms": {**quantiles(shown.gaps_ms), "pictures": len(shown.gaps_ms)},
        "raw_gap_ms": {**quantiles(raw.gaps_ms), "over_100": sum(gap > 100 for gap in raw.gaps_ms)},
    }
    raw.close(), shown.close()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["engine", "capture", "control"])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument(
        "--every", type=float, nargs=2, default=(0.1, 4.0), help="seconds between recovery and the next kill"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--source", default=SOURCE)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--options", type=json.loads, default={}, help="stream options as JSON")
    options = parser.parse_args()
    sections = {"server": {"port": 0, "takeover_s": 60}}
    with Server(options.source, device=options.device, options=options.options, sections=sections) as server:
        live_s = server.until_live()
        changes = Changes(server)
        if options.what == "control":
            found = asyncio.run(control_killed(server, options))
        else:
            found = asyncio.run(role_killed(server, options.what, options))
        result = {"killed": options.what, "live_after_s": round(live_s, 2), **found, "kept": changes.kept()}
    print(json.dumps({**result, "load": round(os.getloadavg()[0], 2)}, indent=2))


if __name__ == "__main__":
    main()
