"""Fragments and applications, which compose operators, and the engines that run them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Literal

from operators.errors import GraphBusy, GraphInvalid
from operators.graph.graph import Flow, Graph, RunResult, Scheduler
from operators.graph.operator import Fault, Operator
from operators.graph.ports import EdgeStats, QueuePolicy, queue_policy
from operators.graph.schedulers import GreedyScheduler
from operators.graph.tracking import FlowTracker

Engine = Literal["embedded", "holoscan"]


class Fragment:
    """A graph of operators. Derive from Application, add operators and flows in `compose`, then call `run`.

    Args:
        name: name for logs.
        track: enable flow tracking from the start.
    """

    def __init__(self, *, name: str = "", track: bool = False) -> None:
        self.name = name or type(self).__name__
        self.result: RunResult | None = None
        """Result of the last run; None before the first run and during a run."""
        self.checks: list[Callable[[], None]] = []
        """Functions called after composition and before any operator starts. An exception cancels the run."""
        self._tracker = FlowTracker() if track else None
        self._scheduler: Scheduler = GreedyScheduler(self)
        self._operators: dict[str, Operator] = {}
        self._flows: list[Flow] = []
        self._graph: Graph | None = None
        self._lock = threading.Lock()
        self._running = False
        self._stop_asked = False

    def compose(self) -> None:
        """Add operators and flows. Called by every run, so that each run has new operators."""
        raise NotImplementedError(f"{type(self).__name__} has no compose method")

    def add_operator(self, operator: Operator) -> None:
        """Add an operator; `add_flow` does so implicitly. Raises GraphInvalid if another operator has the name."""
        if self._operators.setdefault(operator.name, operator) is not operator:
            raise GraphInvalid(f"two operators are named {operator.name!r}; taken are {sorted(self._operators)}")

    def add_flow(
        self,
        upstream: Operator,
        downstream: Operator,
        port_pairs: Iterable[tuple[str, str]] | None = None,
        *,
        policy: QueuePolicy | str | None = None,
        capacity: int | None = None,
    ) -> None:
        """Connect outputs of `upstream` to inputs of `downstream`.

        Args:
            upstream: producing operator.
            downstream: consuming operator.
            port_pairs: {("output", "input"), ...}; optional if each side has one port.
            policy: queue policy; None for that of the input port.
            capacity: queue capacity in messages; None for that of the input port.

        Raises:
            GraphInvalid: unknown or ambiguous ports, or an invalid capacity.
        """
        self.add_operator(upstream)
        self.add_operator(downstream)
        outputs, inputs = upstream.spec.outputs, downstream.spec.inputs
        if port_pairs is None:
            if len(outputs) != 1 or len(inputs) != 1:
                raise GraphInvalid(
                    f"say which ports to connect: {upstream.name!r} has outputs {sorted(outputs)}, "
                    f"{downstream.name!r} has inputs {sorted(inputs)}"
                )
            port_pairs = [(next(iter(outputs)), next(iter(inputs)))]
        if capacity is not None and capacity < 1:
            raise GraphInvalid(
                f"add_flow({upstream.name}, {downstream.name}): capacity must be at least 1, got {capacity}"
            )
        chosen = None if policy is None else queue_policy(policy)
        # Holoscan's interface takes a set of pairs. Sorting makes the order equal in every run.
        for output, port in sorted(port_pairs):
            if output not in outputs:
                raise GraphInvalid(f"operator {upstream.name!r} has no output {output!r}; it has {sorted(outputs)}")
            if port not in inputs:
                raise GraphInvalid(f"operator {downstream.name!r} has no input {port!r}; it has {sorted(inputs)}")
            self._flows.append(Flow(upstream, output, downstream, port, chosen, capacity))

    def scheduler(self, scheduler: Scheduler | None = None) -> Scheduler:
        """Set the scheduler of the next runs, if given, and return the current one (default: GreedyScheduler)."""
        if scheduler is not None:
            self._scheduler = scheduler
        return self._scheduler

    def track(self) -> FlowTracker:
        """Enable flow tracking and return the tracker. It is readable during a run and reset by every run."""
        if self._tracker is None:
            self._tracker = FlowTracker()
        return self._tracker

    def run(self) -> RunResult:
        """Compose the graph and run it until all operators have finished or `stop_execution` is called.

        `result` holds the ending in every case.

        Raises:
            GraphInvalid: before any operator starts.
            OperatorFailed, GraphDeadlock: after all operators have stopped.
        """
        self._claim()
        return self._run_claimed(self._scheduler)

    def run_on(self, scheduler: Scheduler) -> RunResult:
        """Run once with another scheduler instead of the one set by `scheduler`; otherwise as `run`."""
        self._claim()
        return self._run_claimed(scheduler)

    def run_async(self) -> Future[RunResult]:
        """Run in a new thread; otherwise as `run`."""
        self._claim()
        executor = ThreadPoolExecutor(1, thread_name_prefix=self.name)
        future = executor.submit(self._run_claimed, self._scheduler)
        executor.shutdown(wait=False)
        return future

    def stop_execution(self, operator: Operator | None = None) -> None:
        """Stop the current run, or only one operator. Thread-safe, also within compute; no effect without a run."""
        if operator is not None:
            operator.stop_execution()
            return
        with self._lock:
            self._stop_asked = self._running
            graph = self._graph
        if graph is not None:
            graph.stop()

    @property
    def operators(self) -> tuple[Operator, ...]:
        """Operators of the current or last run, in the order of composition."""
        return tuple(self._operators.values())

    def edge_stats(self) -> tuple[EdgeStats, ...]:
        """Return the message counts of each edge in the current or last run. Thread-safe."""
        graph = self._graph
        return () if graph is None else graph.edge_stats()

    def faults(self) -> tuple[Fault, ...]:
        """Return the last 1000 faults of the current or last run. Thread-safe."""
        graph = self._graph
        return () if graph is None else tuple(graph.faults)

    def _claim(self) -> None:
        with self._lock:
            if self._running:
                raise GraphBusy(f"{self.name} already runs; wait for it or call stop_execution")
            self._running, self._stop_asked, self._graph, self.result = True, False, None, None

    def _run_claimed(self, scheduler: Scheduler) -> RunResult:
        try:
            self._operators, self._flows = {}, []
            self.compose()
            for check in self.checks:
                check()
            if self._tracker is not None:
                self._tracker.reset()
            graph = Graph(self._operators.values(), self._flows, scheduler, self._tracker)
            with self._lock:
                self._graph = graph
                if self._stop_asked:
                    graph.stopping = True
            self.result = graph.run()
        finally:
            with self._lock:
                self._running = False
        if self.result.error is not None:
            raise self.result.error
        return self.result


class Application(Fragment):
    """Complete operator graph, the base class of runnable graphs."""


def run(app: Fragment, engine: Engine = "embedded") -> RunResult:
    """Run an application on the embedded schedulers or on the Holoscan SDK. Results and counts are the same.

    Args:
        app: the application.
        engine: `embedded` or `holoscan`.

    Raises:
        EngineMissing: the SDK is not installed or cannot be loaded.
        EngineUnsupported: the SDK cannot run the graph faithfully.
        GraphError: as `Fragment.run` raises it.
        ValueError: the name of the engine is unknown.
    """
    if engine == "embedded":
        return app.run()
    if engine == "holoscan":
        from operators.graph.holoscan import HoloscanScheduler

        return app.run_on(HoloscanScheduler(app.scheduler()))
    raise ValueError(f"unknown engine {engine!r}; choose embedded or holoscan")
