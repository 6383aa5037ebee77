"""Execution of one run of a graph, from its start to its outcome."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from time import perf_counter

from gsplat_core.errors import CoreError
from operators.applications.device import seeded
from operators.applications.result import RunOutcome, RunSettings, peak_memory_bytes
from operators.errors import OperatorsError, RunFailed
from operators.graph import Application, run
from operators.graph.engines import Engine
from operators.ingest import SourceResult
from operators.outcome import Contributor, OutcomeBuilder

PERCENTILES = tuple(k / 100 for k in range(101))


@dataclass(frozen=True)
class Start:
    """Start time of a run, as a date and for measuring durations."""

    at: datetime
    s: float
    """Seconds by `perf_counter`."""

    @staticmethod
    def now() -> Start:
        return Start(datetime.now(UTC), perf_counter())


class Session:
    """Runs a graph once: `start`, `run`, `end` and `outcome`, or `execute` for all four.

    The graph defines source, sinks, clock and training budget. Every operator, and the graph
    itself, may contribute to the outcome (`Contributor`). The `finish` steps add results computed
    after the graph has ended, such as a saved model or baselines. Each step is attempted even if an
    earlier one failed, so that a run that ends early keeps its results.
    """

    def __init__(
        self,
        graph: Application,
        settings: RunSettings,
        *,
        command: str,
        engine: Engine = "embedded",
        finish: Sequence[Callable[[Session], None]] = (),
        notes: Sequence[str] = (),
        stop_requested: Callable[[], bool] = lambda: False,
        started: Start | None = None,
    ) -> None:
        """Set the parameters of the run.

        Args:
            graph: the graph to run.
            settings: settings stated in the report.
            command: name of the run in reports.
            engine: engine that runs the graph.
            finish: steps that `end` calls in order.
            notes: sentences for the report.
            stop_requested: returns True after a stop request.
            started: start of the run if work began before the session; None for the call of
                `start`.
        """
        self.graph, self.settings, self.command, self.engine = graph, settings, command, engine
        self.finish, self.stop_requested = tuple(finish), stop_requested
        self.notes = list(notes)
        self.reached = OutcomeBuilder()
        """Outcome collected so far."""
        self.failure: Exception | None = None
        """First error of the run; None if there was none."""
        self.wall_s = 0.0
        self.started = started

    def execute(self) -> RunOutcome:
        """Run all four phases. Raises RunFailed, with the outcome, after all phases if one
        failed.
        """
        self.start()
        self.run()
        self.end()
        outcome = self.outcome()
        if self.failure is not None:
            raise RunFailed(f"the {self.command} ended early: {outcome.stop_reason}", outcome) from self.failure
        return outcome

    def start(self) -> None:
        """Start the timer and register a check that rejects conflicting contributions before the
        run.
        """
        self.started = self.started or Start.now()
        self.graph.checks.append(lambda: self._collect(OutcomeBuilder()))

    def run(self) -> None:
        """Run the graph to its end. Errors of this program are kept in `failure`; KeyboardInterrupt
        propagates.
        """
        assert self.started is not None, "start() comes first"
        # Preserve the state of the caller's random generators.
        with seeded(self.settings.seed, self.settings.device):
            self._attempt(lambda: run(self.graph, self.engine))
        self.wall_s = perf_counter() - self.started.s

    def end(self) -> None:
        """Collect the contributions of the operators, then perform the `finish` steps."""
        for contributor in self._contributors():
            self._attempt(lambda contributor=contributor: contributor.contribute(self.reached))  # type: ignore[misc]
        for step in self.finish:
            self._attempt(lambda step=step: step(self))  # type: ignore[misc]

    def outcome(self) -> RunOutcome:
        """Return the outcome of the run."""
        assert self.started is not None
        graph = self.graph
        tracker = graph.track()
        reason, interrupted = self._ending()
        dropped = {edge.edge: count for edge in graph.edge_stats() if (count := sum(edge.dropped.values()))}
        return RunOutcome(
            command=self.command,
            settings=self.settings,
            started_at=self.started.at,
            wall_s=self.wall_s,
            stop_reason=reason,
            interrupted=interrupted,
            dropped=sum(dropped.values()),
            dropped_by_edge=dropped,
            latency=tracker.latency(),
            latency_quantiles_ms=tracker.latency_quantiles_ms(PERCENTILES),
            operators=tracker.compute(),
            parts=self.reached.parts,
            notes=(*self.notes, *self.reached.notes),
            outputs=self.reached.outputs,
            peak_memory_bytes=peak_memory_bytes(),
        )

    def _ending(self) -> tuple[str, bool]:
        """Return the reason for the run's end, and True if it was interrupted."""
        source = self.reached.find(SourceResult)
        at_end = source is not None and source.reached_end
        interrupted = self.stop_requested() and not at_end
        if self.failure is not None:
            return str(self.failure), interrupted
        if interrupted:
            return "interrupted", True
        if source is not None and source.out_of_time:
            return "end of the time asked for", False
        finite = source is None or source.description.frame_count is not None
        return "end of recording" if finite else "end of stream", False

    def _contributors(self) -> list[Contributor]:
        return [each for each in (self.graph, *self.graph.operators) if isinstance(each, Contributor)]

    def _collect(self, outcome: OutcomeBuilder) -> None:
        for contributor in self._contributors():
            contributor.contribute(outcome)

    def _attempt(self, action: Callable[[], object]) -> None:
        """Perform one step of the run. An error is kept in `failure`, so that later steps still
        run.
        """
        try:
            action()
        except (CoreError, OperatorsError, OSError) as error:
            self.failure = self.failure or error
            self.notes.append(str(error))
