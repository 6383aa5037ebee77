"""Fragments and applications: composing operators and running them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

from operators.errors import GraphBusy, GraphInvalid
from operators.graph.faults import Fault
from operators.graph.graph import Flow, Graph, RunResult, Scheduler
from operators.graph.greedy import GreedyScheduler
from operators.graph.queues import EdgeStats
from operators.graph.spec import QueuePolicy, queue_policy
from operators.graph.tracking import FlowTracker

if TYPE_CHECKING:
    from operators.graph.operator import Operator


class Fragment:
    """A graph of operators. Derive from Application, add operators and flows in `compose`, then `run`.

    `name` is for logs; `track` enables flow tracking from the start.
    """

    def __init__(self, *, name: str = "", track: bool = False) -> None:
        self.name = name or type(self).__name__
        self.result: RunResult | None = None
        """How the last run ended; None before and while running."""
        self.checks: list[Callable[[], None]] = []
        """Called by every run once it is composed, before any operator starts; what they raise refuses the run."""
        self._tracker = FlowTracker() if track else None
        self._scheduler: Scheduler = GreedyScheduler(self)
        self._operators: dict[str, Operator] = {}
        self._flows: list[Flow] = []
        self._graph: Graph | None = None
        self._lock = threading.Lock()
        self._running = False
        self._stop_asked = False

    def compose(self) -> None:
        """Add operators and flows; called by every run, so each run has fresh operators."""
        raise NotImplementedError(f"{type(self).__name__} has no compose method")

    def add_operator(self, operator: Operator) -> None:
        """Add an operator; add_flow does it too. Raises GraphInvalid when another one has the name."""
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
        """Connect outputs of `upstream` to inputs of `downstream`, given as {("output", "input"), ...}.

        The pairs may be left out when each side has one port. `policy` and `capacity` override what the input
        declares. Raises GraphInvalid for unknown ports.
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
        # The pairs are a set on Holoscan, whose order differs from run to run.
        for output, port in sorted(port_pairs):
            if output not in outputs:
                raise GraphInvalid(f"operator {upstream.name!r} has no output {output!r}; it has {sorted(outputs)}")
            if port not in inputs:
                raise GraphInvalid(f"operator {downstream.name!r} has no input {port!r}; it has {sorted(inputs)}")
            self._flows.append(Flow(upstream, output, downstream, port, chosen, capacity))

    def scheduler(self, scheduler: Scheduler | None = None) -> Scheduler:
        """Choose the scheduler of the next runs (a GreedyScheduler by default), or ask for it."""
        if scheduler is not None:
            self._scheduler = scheduler
        return self._scheduler

    def track(self) -> FlowTracker:
        """Enable flow tracking; the tracker can be read while running and begins anew with every run."""
        if self._tracker is None:
            self._tracker = FlowTracker()
        return self._tracker

    def run(self) -> RunResult:
        """Compose and run until every operator is done or stop_execution is called.

        Raises GraphInvalid before anything runs; OperatorFailed and GraphDeadlock once every operator is stopped.
        `result` says how it ended in every case.
        """
        self._claim()
        return self._run_claimed(self._scheduler)

    def run_on(self, scheduler: Scheduler) -> RunResult:
        """`run`, with another scheduler this once."""
        self._claim()
        return self._run_claimed(scheduler)

    def run_async(self) -> Future[RunResult]:
        """`run` in a thread of its own."""
        self._claim()
        executor = ThreadPoolExecutor(1, thread_name_prefix=self.name)
        future = executor.submit(self._run_claimed, self._scheduler)
        executor.shutdown(wait=False)
        return future

    def stop_execution(self, operator: Operator | None = None) -> None:
        """Stop the run under way (or only one operator of it); from any thread, also from compute. Else no effect."""
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
        """The operators of the run under way or of the last one, in the order of composition."""
        return tuple(self._operators.values())

    def edge_stats(self) -> tuple[EdgeStats, ...]:
        """Counts per edge of the run under way or of the last one; from any thread."""
        graph = self._graph
        return () if graph is None else graph.edge_stats()

    def compute_counts(self) -> dict[str, int]:
        """Computes per operator of the run under way or of the last one; from any thread."""
        graph = self._graph
        return {} if graph is None else {task.name: task.computes for task in graph.tasks}

    def faults(self) -> tuple[Fault, ...]:
        """The last 1000 faults of the run under way or of the last one; from any thread."""
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
    """A graph that runs by itself."""
