"""Execution of one run of a graph: device and seed, progress reports, outcome, and delivery of the results to the output folder."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path
from time import perf_counter
from typing import Protocol, TypeVar, cast

from gsplat_core.endoscope.artefacts import seen_in_recording
from gsplat_core.errors import CoreError
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.recordings import is_heldout
from gsplat_core.models import Model
from gsplat_core.scene.frames import Frame
from operators.errors import DeviceMissing, OperatorsError, RunFailed
from operators.graph import Application, DurationSummary, GreedyScheduler, ManualClock, MultiThreadScheduler, run
from operators.graph.application import Engine
from operators.ingest import POLL_S, SourceResult
from operators.outcome import Contributor, OutcomeBuilder
from operators.output_folder import OutputFolder
from operators.reconstruct import ModelResult
from operators.sources.derived import JudgedSource
from operators.sources.source import FrameSource, SourceState
from operators.storage import storage_errors

DEVICES = ("cpu", "cuda")


def check_device(device: str) -> None:
    """Raise DeviceMissing if this machine or this build cannot run on `device`."""
    import torch

    if device == "cpu":
        return
    if device != "cuda":
        raise DeviceMissing(f"device {device!r} is not known; use --device {' or '.join(DEVICES)}")
    if not torch.cuda.is_available():
        raise DeviceMissing(
            f"device cuda is not available: torch {torch.__version__} finds no GPU; use --device cpu, "
            "or let `intrasplat doctor` say what is missing"
        )
    from gsplat_core.ops.native import CUDA_MISSING

    if CUDA_MISSING is not None:
        raise DeviceMissing(f"device cuda is not available: the CUDA kernels are {CUDA_MISSING}; use --device cpu")


def scheduler_for(device: str, app: Application) -> GreedyScheduler | MultiThreadScheduler:
    """Return the scheduler for an application that processes every frame, such as a replay.

    The results do not depend on the scheduler.

    On the CPU, training occupies all cores, so one thread runs all operators in turn. With a GPU
    the host is idle during training: each operator gets a thread, and decoding, scoring and
    encoding overlap with the training on later frames.
    """
    return GreedyScheduler(app, clock=ManualClock()) if device == "cpu" else MultiThreadScheduler(app)


@contextmanager
def seeded(seed: int, device: str) -> Iterator[None]:
    """Context manager that seeds torch's random generators and restores their state on exit.

    Args:
        seed: the seed.
        device: `cuda` also covers the generators of all GPUs.
    """
    import torch

    with torch.random.fork_rng(devices=range(torch.cuda.device_count()) if device == "cuda" else []):
        torch.manual_seed(seed)
        yield


Part = TypeVar("Part")


@dataclass(frozen=True)
class RunSettings:
    """Settings that the report states. Together with the source they determine the result of a deterministic run."""

    device: str
    engine: str
    field: str
    """Deformation field in use, never `auto`."""
    renderer: str
    seed: int
    scale: float
    steps_per_frame: int | None
    """Optimiser steps per frame; None if training is not done frame by frame."""
    heldout: bool
    """True if the held-out frames (1, 9, 17, ...) are excluded from training and scored separately."""


@dataclass(frozen=True)
class RunOutcome:
    """Ending and outputs of a run, and the parts contributed by its operators (see `operators.outcome`)."""

    command: str
    settings: RunSettings
    started_at: datetime
    wall_s: float
    """Duration from the start of the run to the end of its graph, in seconds, without saving."""
    stop_reason: str
    """`end of recording`, `end of stream`, `end of the time asked for`, `interrupted`, or the error message."""
    interrupted: bool
    dropped: int
    """Total number of messages dropped by full queues between operators."""
    dropped_by_edge: dict[str, int]
    """Number of dropped messages by graph edge; edges without drops are left out."""
    latency: dict[str, DurationSummary]
    """Latency by path of operators through the graph, such as `source,depth,display`."""
    latency_quantiles_ms: dict[str, list[float]]
    operators: dict[str, DurationSummary]
    parts: Mapping[type, object]
    notes: tuple[str, ...]
    outputs: dict[str, Path]
    """Paths of written files and folders, by name."""
    peak_memory_bytes: int

    def find(self, kind: type[Part]) -> Part | None:
        """Return the part of this class; None if no operator contributed it."""
        return cast("Part | None", self.parts.get(kind))


def peak_memory_bytes() -> int:
    """Return the peak resident memory of this process, in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


PERCENTILES = tuple(k / 100 for k in range(101))


@dataclass(frozen=True)
class Start:
    """Start time of a run, as a date and as a `perf_counter` value."""

    at: datetime
    s: float
    """Start time in seconds, by `time.perf_counter`."""

    @staticmethod
    def now() -> Start:
        """Return the current time."""
        return Start(datetime.now(UTC), perf_counter())


class Session:
    """Runs a graph once: `start`, `run`, `end` and `outcome`, or `execute` for all four.

    The graph defines source, sinks, clock and training budget. Every operator, and the graph
    itself, may contribute to the outcome (`Contributor`). The `finish` steps add results computed
    after the graph has ended, such as a saved model. Each step is attempted even if an
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
            started: start of the run if work began before the session; None for the call of `start`.
        """
        self.graph, self.settings, self.command, self.engine = graph, settings, command, engine
        self.finish, self.stop_requested = tuple(finish), stop_requested
        self.notes = list(notes)
        self.reached = OutcomeBuilder()
        """Parts, outputs and notes that the operators and the functions in `finish` have contributed so far."""
        self.failure: Exception | None = None
        """First error of the run; None if there was none."""
        self.wall_s = 0.0
        self.started = started

    def execute(self) -> RunOutcome:
        """Run all four phases. Raises RunFailed, with the outcome, after all phases if one failed."""
        self.start()
        self.run()
        self.end()
        outcome = self.outcome()
        if self.failure is not None:
            raise RunFailed(f"the {self.command} ended early: {outcome.stop_reason}", outcome) from self.failure
        return outcome

    def start(self) -> None:
        """Start the timer and register a check that rejects conflicting contributions before the run."""
        self.started = self.started or Start.now()
        self.graph.checks.append(lambda: self._collect(OutcomeBuilder()))

    def run(self) -> None:
        """Run the graph to its end. Errors of this program are kept in `failure`; KeyboardInterrupt propagates."""
        assert self.started is not None, "start() comes first"
        # `seeded` restores the state of the caller's random generators after the run.
        with seeded(self.settings.seed, self.settings.device):
            self._attempt(lambda: run(self.graph, self.engine))
        self.wall_s = perf_counter() - self.started.s

    def end(self) -> None:
        """Collect the contributions of the operators, then call the functions in `finish`."""
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
        """Call `action`, one part of the run. An expected error is kept in `failure`, so that the other parts still run."""
        try:
            action()
        except (CoreError, OperatorsError, OSError) as error:
            self.failure = self.failure or error
            self.notes.append(str(error))


def saves_model(out: Path, fitted: Model | None = None) -> Callable[[Session], None]:
    """Return a function that saves the model of a finished session to `out/model`, for `Session.finish`.

    Args:
        out: output folder of the run.
        fitted: model trained before the graph ran, saved even if no frame was displayed.
    """

    def save(session: Session) -> None:
        if fitted is not None and session.reached.find(ModelResult) is None:
            session.reached.add(ModelResult(fitted))
        result = session.reached.find(ModelResult)
        if result is not None:
            folder = out / "model"
            with storage_errors(out):
                save_bundle(result.model, folder)
            session.reached.output("model", folder)

    return save


@dataclass(frozen=True)
class FirstFrames:
    """The first `count` frames of a closed source; each iteration reads from the beginning."""

    source: FrameSource
    count: int

    def __iter__(self) -> Iterator[Frame]:
        self.source.open()
        try:
            given = 0
            while given < self.count:
                frame = self.source.read(POLL_S)
                if frame is not None:
                    given += 1
                    yield frame
                elif self.source.state is SourceState.ENDED:
                    return
        finally:
            self.source.close()


def judged(source: FrameSource, stop_requested: Callable[[], bool] = lambda: False) -> JudgedSource:
    """Wrap a source for offline runs, which have no checks of a stream.

    Frames whose picture shows nothing (black, single-coloured or noise) are withheld. Pixels that the scope never saw, such
    as those outside of a round view, are excluded from the loss. To find them, all frames but the held-out ones are read
    once. If the source cannot be read again, no pixels are excluded.

    Args:
        source: closed source.
        stop_requested: polled for each frame; True ends the reading, and the pixels are those of the frames so far.

    Returns:
        The wrapped source, not open.

    Raises:
        RecordingError: a frame cannot be read.
    """
    about, bare = source.description, JudgedSource(source)
    if about.digest is None or about.frame_count is None:
        return bare
    size = about.height_px, about.width_px
    return JudgedSource(
        source,
        seen_in_recording(
            frame.image
            for frame in takewhile(lambda _: not stop_requested(), FirstFrames(bare, about.frame_count))
            if frame.unusable is None and not is_heldout(frame.seq) and frame.image.shape[:2] == size
        ),
    )


Report = Callable[[RunOutcome, Path], None]
"""Writes report files made from the outcome into a folder, next to the run's own files."""


class HasFolders(Protocol):
    """Settings of a run: a frozen dataclass with the output folder `out`."""

    @property
    def out(self) -> Path: ...

    @property
    def inputs(self) -> Sequence[Path]:
        """Return the files and folders that the run reads."""


Settings = TypeVar("Settings", bound=HasFolders)


def delivered(
    settings: Settings,
    command: str,
    run: Callable[[Settings, list[str]], RunOutcome],
    report: Report | None = None,
) -> RunOutcome:
    """Run `run` in a staging folder, add the report, and replace an earlier run's results by the new ones.

    A run that ends with RunFailed delivers its partial results. After any other exception the earlier results are
    unchanged.

    Args:
        settings: settings of the run.
        command: name of the command, for the marker of the output folder.
        run: called with the settings, whose `out` is the staging folder, and a list of notes for the report.
        report: writes the report files; None for no report.

    Returns:
        The outcome with the final paths of the outputs.

    Raises:
        OutputError: as `OutputFolder` raises it.
        RunFailed: the run ended early; carries the outcome with the final paths.
    """
    with OutputFolder(settings.out, command, settings.inputs) as output:
        notes = ["the output folder held an earlier run; this one replaces its files"] if output.earlier else []

        def deliver(outcome: RunOutcome) -> RunOutcome:
            if outcome.outputs:
                if report is not None:
                    report(outcome, output.path)
                output.publish()
            paths = {name: settings.out / path.relative_to(output.path) for name, path in outcome.outputs.items()}
            return replace(outcome, outputs=paths)

        try:
            return deliver(run(replace(settings, out=output.path), notes))  # type: ignore[type-var]
        except RunFailed as failed:
            assert isinstance(failed.result, RunOutcome)
            raise RunFailed(str(failed), deliver(failed.result)) from failed.__cause__


@dataclass(frozen=True)
class Progress:
    """Report of a running application: how far its current stage is, with the newest frame's scores (None if not
    scored).
    """

    stage: str
    """Name of the current stage as one word, such as "train"."""
    done: int
    total: int
    unit: str = "frames"
    psnr_tissue_db: float | None = None
    """Tissue PSNR of the newest displayed frame in dB; its training error if `trained`."""
    previous_frame_db: float | None = None
    """Tissue PSNR in dB of the previous raw frame (trivial baseline)."""
    next_frame_db: float | None = None
    """Tissue PSNR in dB of the newest frame's prediction, rendered before training on it."""
    trained: bool = True
    """True if the newest displayed frame was trained on before display."""


ProgressCallback = Callable[[Progress], None]
