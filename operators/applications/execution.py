"""Running an application to its end, whichever end that is, and saving all that it reached."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

from gsplat_core.errors import CoreError
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.recordings import Recording
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.training.baselines import Baselines, measure_baselines
from operators.applications.device import seeded
from operators.applications.result import RunOutcome, peak_memory_bytes
from operators.errors import OperatorsError, RunFailed
from operators.graph import run
from operators.storage import storage_errors

if TYPE_CHECKING:
    from operators.applications.replay import ReplayApplication

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


class Execution:
    """One run of a composed application, from start to outcome.

    `command` is what the run is called in reports. `fitted` is a model that was there before the graph ran, and is saved whether or not
    a frame is shown with it. The run's wall time begins at `start`.
    """

    def __init__(
        self,
        app: ReplayApplication,
        notes: list[str],
        stop_requested: Callable[[], bool],
        *,
        command: Literal["replay", "reconstruct"] = "replay",
        fitted: Model | None = None,
        start: Start | None = None,
    ) -> None:
        self.app, self.notes, self.stop_requested, self.command = app, notes, stop_requested, command
        self.recording, self.settings = app.recording, app.settings
        self.fitted = fitted
        self.start = start or Start.now()
        self.outputs: dict[str, Path] = {}
        self.failure: Exception | None = None

    def execute(self) -> RunOutcome:
        """Run the graph, save the model, measure the baselines.

        Raises RunFailed, with the outcome, when any part failed; the other parts are saved first.
        """
        self.app.announce()
        # The caller's random numbers are not ours to move.
        with seeded(self.settings.seed, self.settings.device):
            self._attempt(lambda: run(self.app, self.settings.engine))
        wall_s = perf_counter() - self.start.s
        if self.app.video.displayed and self.app.video_path.exists():
            self.outputs["video"] = self.app.video_path
        self._attempt(self._save_model)
        baselines = self._attempt(self._baselines)
        outcome = self._outcome(wall_s, baselines)
        if self.failure is not None:
            raise RunFailed(f"the {self.command} ended early: {outcome.stop_reason}", outcome) from self.failure
        return outcome

    def _attempt(self, action: Callable[[], Any]) -> Any:
        """Do one part of the run; its error is kept for the end, so that the other parts are still saved."""
        try:
            return action()
        except (CoreError, OperatorsError, OSError) as error:
            self.failure = self.failure or error
            self.notes.append(str(error))
            return None

    def _save_model(self) -> None:
        model = self.fitted or self.app.reconstruct.model
        if model is not None:
            folder = self.settings.out / "model"
            with storage_errors(self.settings.out):
                save_bundle(model, folder)
            self.outputs["model"] = folder

    def _baselines(self) -> Baselines | None:
        shown = len(self.app.metrics.series)
        if self.stop_requested() or self.failure is not None:
            self.notes.append(
                "the run ended early: baselines that need a second reading of the recording were left out"
            )
            return None
        return measure_baselines(_Beginning(self.recording, shown))

    def _outcome(self, wall_s: float, baselines: Baselines | None) -> RunOutcome:
        app, settings = self.app, self.settings
        metrics = app.metrics
        interrupted = self.stop_requested() and app.source.emitted < self.recording.frame_count
        reason = "interrupted" if interrupted else "end of recording"
        if self.failure is not None:
            reason = str(self.failure)
        tracker = app.track()
        dropped = sum(sum(edge.dropped.values()) for edge in app.edge_stats())
        return RunOutcome(
            command=self.command,
            recording=self.recording,
            device=settings.device,
            engine=settings.engine,
            field=settings.reconstructor_config().chosen_field,
            seed=settings.seed,
            scale=settings.scale,
            steps_per_frame=settings.reconstructor_config().steps_per_frame if self.command == "replay" else None,
            started_at=self.start.at,
            wall_s=wall_s,
            stop_reason=reason,
            interrupted=interrupted,
            ingested=app.source.emitted,
            displayed=app.video.displayed,
            dropped=dropped,
            latency=tracker.latency(),
            latency_quantiles_ms=tracker.latency_quantiles_ms(PERCENTILES),
            operators=tracker.compute(),
            live=metrics.live if self.command == "replay" else None,
            training=metrics.live if self.command == "reconstruct" else None,
            held_out=metrics.held_out if settings.heldout else None,
            baselines=baselines,
            series=tuple(metrics.series),
            keyframes=tuple(app.keyframes.keyframes),
            worst_seq=app.keyframes.worst_seq,
            model=self.fitted or app.reconstruct.model,
            frames_sha256=metrics.frames_sha256,
            notes=(*self.notes, *app.source.notes, *app.tool_mask.notes),
            outputs=self.outputs,
            peak_memory_bytes=peak_memory_bytes(),
        )


@dataclass(frozen=True)
class _Beginning:
    """The first frames of a recording; can be read more than once."""

    recording: Recording
    count: int

    def __iter__(self) -> Iterator[Frame]:
        return islice(iter(self.recording), self.count)
