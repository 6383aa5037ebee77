"""One run from its start to its outcome, whatever its graph is made of."""

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
    """When a run began: for people, and for measuring."""

    at: datetime
    s: float
    """By `perf_counter`."""

    @staticmethod
    def now() -> Start:
        """This moment."""
        return Start(datetime.now(UTC), perf_counter())


class Session:
    """A graph with a source and sinks, run once: `start`, `run`, `end`, `outcome`, or `execute` for all four.

    The graph brings its source, its sinks, its clock (that of its scheduler) and the budget of its training. The session knows none of
    these: whatever operator, or the graph itself, is a `Contributor` adds its part of the outcome, and `finish` adds what is made after
    the graph has ended (a saved model, baselines). Replay, offline reconstruction and live are sessions.

    Every part is attempted, whatever fails before it, so that a run that ends early leaves all that it had reached.
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
        """command: what the run is called in reports. finish: called in order by `end`. notes: sentences for the report.
        started: when work on the run began, if that was before the session's start."""
        self.graph, self.settings, self.command, self.engine = graph, settings, command, engine
        self.finish, self.stop_requested = tuple(finish), stop_requested
        self.notes = list(notes)
        self.reached = OutcomeBuilder()
        """What is known about the outcome so far."""
        self.failure: Exception | None = None
        """What went wrong first."""
        self.wall_s = 0.0
        self.started = started

    def execute(self) -> RunOutcome:
        """All four. Raises RunFailed, with the outcome, when any part failed; the other parts are done first."""
        self.start()
        self.run()
        self.end()
        outcome = self.outcome()
        if self.failure is not None:
            raise RunFailed(f"the {self.command} ended early: {outcome.stop_reason}", outcome) from self.failure
        return outcome

    def start(self) -> None:
        """Begin to measure; the graph will refuse operators whose contributions are in conflict before any of them starts."""
        self.started = self.started or Start.now()
        self.graph.checks.append(lambda: self._collect(OutcomeBuilder()))

    def run(self) -> None:
        """Run the graph to its end. An error on purpose is kept in `failure`; a KeyboardInterrupt passes."""
        assert self.started is not None, "start() comes first"
        # The caller's random numbers are not ours to move.
        with seeded(self.settings.seed, self.settings.device):
            self._attempt(lambda: run(self.graph, self.engine))
        self.wall_s = perf_counter() - self.started.s

    def end(self) -> None:
        """Collect what the operators contribute, then do what is left to be done."""
        for contributor in self._contributors():
            self._attempt(lambda contributor=contributor: contributor.contribute(self.reached))  # type: ignore[misc]
        for step in self.finish:
            self._attempt(lambda step=step: step(self))  # type: ignore[misc]

    def outcome(self) -> RunOutcome:
        """What the run has reached."""
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
        """Why the run ended, and whether it was interrupted."""
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
        """Do one part of the run; its error is kept for the end, so that the other parts are still done."""
        try:
            action()
        except (CoreError, OperatorsError, OSError) as error:
            self.failure = self.failure or error
            self.notes.append(str(error))
