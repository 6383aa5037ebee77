"""Measure the overhead of the operator graph: a saturated chain of three operators that pass an int.

Claim: at most 5 µs per compute call on the greedy scheduler. Prints JSON. With `--holoscan` the same operators also
run on the Holoscan SDK through the adapter, and as native Holoscan operators, in the same process.

    python benchmarks/graph_overhead.py [--messages 100000] [--repeats 5] [--holoscan]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import threading
import time
from typing import Any

from operators.graph import (
    Application,
    AsynchronousCondition,
    AsynchronousEventState,
    CountCondition,
    GreedyScheduler,
    MultiThreadScheduler,
    Operator,
    OperatorSpec,
    run,
)

CLAIM_US = 5.0


class Source(Operator):
    """Emits increasing numbers."""

    def setup(self, spec: OperatorSpec) -> None:
        spec.output("out")

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        op_output.emit(1, "out")


class Pass(Operator):
    """Emits what it receives."""

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("in")
        spec.output("out")

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        op_output.emit(op_input.receive("in"), "out")


class Sink(Operator):
    """Receives and discards."""

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("in")

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        op_input.receive("in")


class Chain(Application):
    """Graph: source → pass → sink."""

    messages = 1

    def compose(self) -> None:
        source = Source(self, CountCondition(self, self.messages), name="source")
        middle, sink = Pass(self, name="pass"), Sink(self, name="sink")
        self.add_flow(source, middle)
        self.add_flow(middle, sink)


def chain_us(messages: int, *, threads: bool = False, track: bool = False, engine: Any = "embedded") -> float:
    """Return the microseconds per compute call of one run."""
    app = Chain(track=track)
    app.messages = messages
    app.scheduler(MultiThreadScheduler(app) if threads else GreedyScheduler(app))
    result = run(app, engine)
    computes = sum(result.computes.values())
    assert computes == 3 * messages, result
    return result.wall_s * 1e6 / computes


class Woken(Operator):
    """Operator that waits for an event and records the delay until it runs."""

    def setup(self, spec: OperatorSpec) -> None:
        """Declare no ports."""
        self.set_at_ns = 0
        self.delays_us: list[float] = []
        self.asleep = threading.Event()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        """Record the delay and wait again."""
        if self.set_at_ns:
            self.delays_us.append((time.perf_counter_ns() - self.set_at_ns) * 1e-3)
        event = self.conditions[0]
        assert isinstance(event, AsynchronousCondition)
        event.event_state = AsynchronousEventState.EVENT_WAITING
        self.asleep.set()


class WakeApp(Application):
    """Application with one operator that waits for events."""

    def compose(self) -> None:
        self.event = AsynchronousCondition(self)
        self.woken = Woken(self, self.event)
        self.add_operator(self.woken)


def wake_us(wakes: int) -> dict[str, float]:
    """Return the microseconds from setting an event in another thread to `compute`, on the multi-threaded scheduler."""
    app = WakeApp()
    app.scheduler(MultiThreadScheduler(app))
    future = app.run_async()
    for _ in range(wakes):
        while not hasattr(app, "woken"):
            time.sleep(0.001)
        app.woken.asleep.wait()
        app.woken.asleep.clear()
        time.sleep(0.002)
        app.woken.set_at_ns = time.perf_counter_ns()
        app.event.event_state = AsynchronousEventState.EVENT_DONE
    app.woken.asleep.wait()
    app.stop_execution()
    future.result()
    delays = sorted(app.woken.delays_us)
    return {"p50": round(delays[len(delays) // 2], 1), "p95": round(delays[int(len(delays) * 0.95)], 1)}


def native_holoscan_us(messages: int) -> float:
    """Time the same chain built from native Holoscan operators on the SDK's greedy scheduler."""
    from holoscan.conditions import CountCondition as NativeCount
    from holoscan.core import Application as NativeApplication
    from holoscan.core import Operator as NativeOperator

    def native(kind: type[Operator]) -> Any:
        body = {"setup": kind.setup, "compute": kind.compute}
        return type(kind.__name__, (NativeOperator,), body)

    class NativeChain(NativeApplication):  # type: ignore[misc]
        def compose(self) -> None:
            source = native(Source)(self, NativeCount(self, messages), name="source")
            middle, sink = native(Pass)(self, name="pass"), native(Sink)(self, name="sink")
            self.add_flow(source, middle)
            self.add_flow(middle, sink)

    app = NativeChain()
    app.enable_metadata(False)
    began = time.perf_counter()
    app.run()
    return (time.perf_counter() - began) * 1e6 / (3 * messages)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--holoscan", action="store_true", help="also on the Holoscan SDK")
    options = parser.parse_args()
    many, few = options.messages, max(1, options.messages // 10)
    cases = {
        "embedded_greedy": lambda: chain_us(many),
        "embedded_greedy_tracked": lambda: chain_us(many, track=True),
        "embedded_multithread": lambda: chain_us(few, threads=True),
    }
    if options.holoscan:
        from operators.graph.sdk import load_sdk

        load_sdk()
        cases["adapter_holoscan_greedy"] = lambda: chain_us(few, engine="holoscan")
        cases["native_holoscan_greedy"] = lambda: native_holoscan_us(few)
    # One of each in turn, so that a disturbance of the machine hits all cases alike.
    taken: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(options.repeats):
        for name, case in cases.items():
            taken[name].append(case())
    report = {
        name: {
            "us_per_compute": round(statistics.median(times), 3),
            "best_us_per_compute": round(min(times), 3),
            "messages_per_s": round(1e6 / (3 * statistics.median(times))),
        }
        for name, times in taken.items()
    }
    greedy_us = report["embedded_greedy"]["us_per_compute"]
    print(
        json.dumps(
            {
                "machine": platform.processor() or platform.machine(),
                "python": platform.python_version(),
                "chain": report,
                "wake_us": wake_us(200),
                "claim_us_per_compute": CLAIM_US,
                "claim_holds": greedy_us <= CLAIM_US,
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
