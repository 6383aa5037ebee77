"""Steps that a session performs after its graph has ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.evaluation.baselines import measure_baselines
from gsplat_core.io.bundle import save_bundle
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from operators.applications.session import Session
from operators.ingest import LOOK_S
from operators.metrics import QualityResult
from operators.reconstruct import ModelResult
from operators.sources.source import FrameSource, SourceState
from operators.storage import storage_errors


def saves_model(out: Path, fitted: Model | None = None) -> Callable[[Session], None]:
    """Return a step that saves the run's model to `out/model`.

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


def measures_baselines(source: FrameSource) -> Callable[[Session], None]:
    """Return a step that measures trivial baselines on the displayed frames, by reading the source
    twice more.
    """

    def measure(session: Session) -> None:
        if session.stop_requested() or session.failure is not None:
            session.notes.append(
                "the run ended early: baselines that need a second reading of the recording were left out"
            )
        elif source.description.digest is None:
            session.notes.append(
                f"{source.description.name} can be read only once: baselines that need a second reading were left out"
            )
        else:
            quality = session.reached.find(QualityResult)
            session.reached.add(measure_baselines(FirstFrames(source, 0 if quality is None else quality.frames)))

    return measure


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
                frame = self.source.read(LOOK_S)
                if frame is not None:
                    given += 1
                    yield frame
                elif self.source.state is SourceState.ENDED:
                    return
        finally:
            self.source.close()
