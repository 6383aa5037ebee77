"""Measure the latency from a source to its reader, in one process and through shared memory from a child process.

    python benchmarks/source_latency.py [RECORDING ...]

Each recording (by default two synthetic sizes) is played in real time, looped. One JSON line per case: milliseconds from the release of a frame to the return of `read`
(p50, p90, p99, worst), the time of copying the picture, processor time per frame of both processes, and dropped frames.
"""

from __future__ import annotations

import json
import resource
import sys
import time

import numpy as np

from operators.sources.address import SourceOptions
from operators.sources.registry import open_source
from operators.sources.source import FrameSource

FRAMES, SKIPPED = 240, 20
RATES = (30.0, 60.0)


def processor_s() -> float:
    """Return the processor time of this process and its terminated children."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def copy_ms(shape: tuple[int, ...]) -> float:
    """Return the time of copying a picture into new memory, in ms."""
    image = np.ones(shape, np.uint8)
    times = []
    for _ in range(50):
        began = time.perf_counter()
        image.copy()
        times.append(time.perf_counter() - began)
    return float(np.median(times)) * 1e3


def latencies_ms(source: FrameSource) -> np.ndarray:
    """Return the latency of every frame read after the skipped ones."""
    found = []
    source.open()
    while len(found) < FRAMES + SKIPPED:
        frame = source.read(1.0)
        if frame is not None and frame.arrived_ns is not None:
            found.append((time.monotonic_ns() - frame.arrived_ns) * 1e-6)
    return np.array(found[SKIPPED:])


def main() -> None:
    places = sys.argv[1:] or ["synthetic:?width=640&height=512&frames=12", "synthetic:?width=320&height=256&frames=12"]
    for place in places:
        for fps in RATES:
            for process in (False, True):
                began_s = processor_s()
                options = SourceOptions(realtime=True, loop=True, fps=fps, process=process)
                source = open_source(place, options)
                opened_s = processor_s()
                times = latencies_ms(source)
                counts = source.counts() if hasattr(source, "counts") else {}
                source.close()
                about = source.description
                p50, p90, p99 = np.percentile(times, (50, 90, 99))
                print(
                    json.dumps(
                        {
                            "source": about.name,
                            "size": [about.width_px, about.height_px],
                            "fps": about.fps,
                            "process": process,
                            "ms": {
                                "p50": round(p50, 3),
                                "p90": round(p90, 3),
                                "p99": round(p99, 3),
                                "worst": round(times.max(), 3),
                            },
                            "copy_ms": round(copy_ms((about.height_px, about.width_px, 3)), 3),
                            "processor_ms_per_frame": round(
                                (processor_s() - (began_s if process else opened_s)) / len(times) * 1e3, 2
                            ),
                            "counts": dict(counts),
                        }
                    ),
                    flush=True,
                )


if __name__ == "__main__":
    main()
