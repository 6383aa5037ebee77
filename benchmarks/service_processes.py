"""How the service's processes take being killed, and what they cost.

    python benchmarks/service_processes.py engine --kills 20     kill -9 of the engine while four subscribers watch
    python benchmarks/service_processes.py capture --kills 5     the same of the capture process

Each prints one JSON object. The stream is the synthetic endoscope unless `--source` says otherwise.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from service_watchers import Watch, quantiles

from services.bus.runtime import Role, RuntimeFolder
from services.supervisor.launching import ByLauncher
from services.supervisor.specs import EngineSpec, SourceSpec, StreamSpec
from services.supervisor.stream import StreamSupervisor

SOURCE = "synthetic:?width=160&height=128&frames=12&fps=30"
BACK_WITHIN_S = 30.0


async def until(what, within_s: float = 120.0) -> float:
    """Wait until `what` holds; the seconds that it took."""
    began_s = time.monotonic()
    while not what():
        if time.monotonic() - began_s > within_s:
            raise TimeoutError("it did not come about")
        await asyncio.sleep(0.01)
    return time.monotonic() - began_s


async def killed(options: argparse.Namespace, role: Role) -> dict[str, object]:
    """Kill a process again and again, and measure what others see of it."""
    choose = random.Random(options.seed)
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        runtime = RuntimeFolder(Path(folder))
        launcher = ByLauncher(runtime)
        launcher.open()
        stream = StreamSupervisor(
            StreamSpec(
                name="bench", source=SourceSpec(address=options.source), engine=EngineSpec(device=options.device)
            ),
            runtime,
            start=launcher,
        )
        await stream.start()
        raw = [Watch(stream.folder.pictures("capture")) for _ in range(2)]
        shown = [Watch(stream.folder.pictures("engine")) for _ in range(2)]
        try:
            first_s = await until(lambda: shown[0].pictures > 5 and launcher.ready.is_set())
            back_s, watched = [], {"capture": raw, "engine": shown}[role][0]
            for watch in (*raw, *shown):
                watch.begin()
            for _ in range(options.kills):
                await asyncio.sleep(choose.uniform(0.3, 2.5))
                pid = getattr(stream.state(), role).pid
                if pid is None:
                    continue
                os.kill(pid, signal.SIGKILL)
                killed_ns = time.monotonic_ns()
                await until(lambda at=killed_ns: watched.last_from_after(at), BACK_WITHIN_S)
                back_s.append((watched.last_ns - killed_ns) * 1e-9)
                print(f"back after {back_s[-1]:.2f} s", file=sys.stderr, flush=True)
            gaps = [gap for watch in raw for gap in watch.gaps_ms]
            return {
                "killed": role,
                "kills": len(back_s),
                "first_picture_s": round(first_s, 2),
                "back_s": quantiles(back_s),
                "raw_gap_ms": {**quantiles(gaps), "over_100": sum(gap > 100 for gap in gaps), "pictures": len(gaps)},
                "raw_gap_at_capture_ms": quantiles([gap for watch in raw for gap in watch.sent_gaps_ms]),
                "load": os.getloadavg()[0],
            }
        finally:
            for watch in (*raw, *shown):
                watch.close()
            await stream.stop()
            await launcher.close(stop=True)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["engine", "capture"])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--source", default=SOURCE)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    print(json.dumps(asyncio.run(killed(options, options.what)), indent=2))


if __name__ == "__main__":
    main()
