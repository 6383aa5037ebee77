"""Measure for how long this machine interrupts or slows busy loops, a lower bound for the delays of live pictures.

    python benchmarks/host_pauses.py

Some processes call the kernel and read the clock without pause, first one alone, then as many as a live stream has busy threads. On an
idle machine with enough cores, none of them waits for more than a fraction of a millisecond, and all of them get on at an even pace.
A virtual core that shares its physical core with other machines is not interrupted, but slow for some time.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

SECONDS = 3.0
LEAST_MS = 0.1
"""Shortest interruption that counts, in milliseconds."""
LONG_MS = 5.0
"""Interruption from which a picture is noticeably late, in milliseconds."""
STREAM_THREADS = 6
"""Threads of a live stream that are busy at the same time: source, three for analysis, training and display."""

INTERVAL_MS = 2.0
"""Time over which the pace of a loop is measured, in milliseconds."""
SLOW = 0.5
"""Share of a loop's median pace below which an interval counts as slow."""

LOOP = """
import json, os, sys, time
seconds, least_ns, interval_ns = float(sys.argv[1]), int(float(sys.argv[2]) * 1e6), int(float(sys.argv[3]) * 1e6)
last = begun = time.perf_counter_ns()
end, pauses, paces, calls = last + int(seconds * 1e9), [], [], 0
while last < end:
    os.getppid()
    calls += 1
    now = time.perf_counter_ns()
    if now - last > least_ns:
        pauses.append((now - last) / 1e6)
    last = now
    if now - begun > interval_ns:
        paces.append(calls / (now - begun))
        begun, calls = now, 0
print(json.dumps({"pauses_ms": pauses, "paces": paces}))
"""


def interruptions(processes: int, seconds: float = SECONDS) -> dict[str, float]:
    """Return the interruptions of several busy loops at the same time.

    Returns:
        longest_ms: longest interruption in milliseconds. long_per_s: number of interruptions over `LONG_MS` per process
        and second. share: share of the time in interruptions over `LEAST_MS`. slow_share: share of the intervals in which
        a loop had less than `SLOW` of its median pace. slowest: smallest pace of an interval, as a share of the median.
    """
    words = [sys.executable, "-c", LOOP, str(seconds), str(LEAST_MS), str(INTERVAL_MS)]
    running = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    loops = [json.loads(each.communicate()[0]) for each in running]
    return summary([loop["pauses_ms"] for loop in loops], [loop["paces"] for loop in loops], seconds)


def summary(pauses_ms: Sequence[Sequence[float]], paces: Sequence[Sequence[float]], seconds: float) -> dict[str, float]:
    """Return the figures of `interruptions`.

    Args:
        pauses_ms: interruptions of each process in milliseconds.
        paces: pace of each process in its intervals, in any unit.
        seconds: duration of each process.
    """
    every = [pause for pauses in pauses_ms for pause in pauses]
    relative = [pace / statistics.median(loop) for loop in paces for pace in loop]
    whole_s = len(pauses_ms) * seconds
    return {
        "longest_ms": round(max(every, default=0.0), 2),
        "long_per_s": round(sum(pause > LONG_MS for pause in every) / whole_s, 3),
        "share": round(sum(every) / (1e3 * whole_s), 4),
        "slow_share": round(sum(pace < SLOW for pace in relative) / max(1, len(relative)), 4),
        "slowest": round(min(relative, default=1.0), 2),
    }


def host_pauses() -> dict[str, Any]:
    """Return the interruptions of one busy loop, and of as many as a live stream has busy threads and this machine has cores."""
    threads = min(STREAM_THREADS, len(os.sched_getaffinity(0)))
    return {"1": interruptions(1), str(threads): interruptions(threads)}


def pauses_text(machines: Iterable[Mapping[str, Any]]) -> str:
    """Return a clause about the largest interruptions of logged machines, one per run; empty if none are logged."""
    logged = [machine["pauses"] for machine in machines if "pauses" in machine]
    clauses = []
    for threads in dict.fromkeys(threads for pauses in logged for threads in pauses):
        each = [pauses[threads] for pauses in logged if threads in pauses]
        clauses.append(
            f"{threads} busy loop{'s' if threads != '1' else ''} for up to {_largest(each, 'longest_ms'):.0f} ms"
            f" ({_largest(each, 'long_per_s'):.1f} times per second for more than {LONG_MS:.0f} ms){_pace_text(each)}"
        )
    return f", which interrupted {' and '.join(clauses)} while it was idle" if clauses else ""


def _pace_text(figures: Iterable[Mapping[str, float]]) -> str:
    """Return a clause about slow intervals; empty if they are not logged."""
    logged = [each for each in figures if "slow_share" in each]
    if not logged:
        return ""
    return (
        f" and slowed them to less than half of their pace for {100 * _largest(logged, 'slow_share'):.1f} % of the time"
    )


def _largest(figures: Iterable[Mapping[str, float]], name: str) -> float:
    return max(each[name] for each in figures)


if __name__ == "__main__":
    print(json.dumps(host_pauses()))
