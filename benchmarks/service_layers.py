"""Measure age, rate and PSNR of a live stream with and without layers (depth, confidence, virtual view) and snapshots.

    python benchmarks/service_layers.py --seconds 20 [--snapshots 5]

Runs a capture and an engine process as `intrasplat serve` does, with subscribers that only read. With 0 seconds only snapshots are measured. Prints one JSON line per part.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

from service_watchers import Watch, quantiles

from services.bus.runtime import LAYERS, RuntimeFolder
from services.settings import StreamSettings
from services.supervisor.stream import Stream
from services.supervisor.worker import specs_of


def cpu_s(pid: int) -> float:
    """Return the user and system time of a process in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def part(stream: Stream, what: str, layers: tuple[str, ...], seconds: float) -> None:
    """Watch the reconstruction and these layers for a while."""
    shown = Watch(stream.folder.pictures("engine"))
    beside = {layer: Watch(stream.folder.endpoint(layer)) for layer in layers}
    await asyncio.sleep(2)
    for watch in (shown, *beside.values()):
        watch.begin()
    pictures, began_s, drawn = shown.pictures, time.monotonic(), {layer: beside[layer].pictures for layer in layers}
    pid = stream.engine.state.pid
    assert pid is not None
    before_s, scores = cpu_s(pid), []
    while time.monotonic() - began_s < seconds:
        await asyncio.sleep(0.5)
        psnr_db = (stream.engine.state.figures.get("picture") or {}).get("psnr_db")
        scores += [psnr_db] if psnr_db is not None else []
    took_s = time.monotonic() - began_s
    figures = {
        "part": what,
        "pictures_per_s": round((shown.pictures - pictures) / took_s, 2),
        "age_ms": quantiles(shown.ages_ms),
        "psnr_db": round(statistics.mean(scores), 2) if scores else None,
        "engine_cpu": round((cpu_s(pid) - before_s) / took_s, 3),
        "layers": {
            layer: {
                "per_s": round((watch.pictures - drawn[layer]) / took_s, 2),
                "age_ms": quantiles(watch.ages_ms) if watch.ages_ms else None,
            }
            for layer, watch in beside.items()
        },
    }
    for watch in (shown, *beside.values()):
        watch.close()
    print(json.dumps(figures), flush=True)


async def snapshots(stream: Stream, count: int, folder: Path) -> None:
    """Take snapshots while the reconstruction is watched."""
    shown = Watch(stream.folder.pictures("engine"))
    await asyncio.sleep(2)
    shown.begin()
    said = []
    for number in range(count):
        said.append(await stream.engine.command("snapshot", timeout_s=60, folder=str(folder / str(number))))
        await asyncio.sleep(0.5)
    shown.close()
    figures = {
        "part": f"{count} snapshots",
        "pause_ms": quantiles([each["pause_ms"] for each in said]),
        "written_ms": quantiles([each["written_ms"] for each in said]),
        "gaussians": said[-1]["gaussians"],
        "age_ms": quantiles(shown.ages_ms),
        "gap_ms": quantiles(shown.gaps_ms),
    }
    print(json.dumps(figures), flush=True)


async def main() -> None:
    """Measure all parts on one stream."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", default="synthetic:?width=320&height=256&frames=90&fps=30&moving=1")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--snapshots", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        settings = StreamSettings(source=given.source, device=given.device)
        stream = Stream(settings, specs_of("a", settings), RuntimeFolder(Path(folder) / "r"))
        await stream.start()
        try:
            async with asyncio.timeout(90):
                while (stream.engine.state.figures.get("picture") or {}).get("state") != "live":
                    await asyncio.sleep(0.1)
            await asyncio.sleep(5)
            if given.seconds > 0:
                await part(stream, "nobody watches", (), given.seconds)
                for layer in LAYERS:
                    await part(stream, layer, (layer,), given.seconds)
                await part(stream, "all three", LAYERS, given.seconds)
                await part(stream, "nobody watches any more", (), given.seconds)
            await snapshots(stream, given.snapshots, Path(folder))
        finally:
            with contextlib.suppress(TimeoutError):
                await stream.stop()


if __name__ == "__main__":
    asyncio.run(main())
