"""CONTRIBUTING's recipe "An application", followed by a test alone: how sharp a recording is, without any reconstruction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import pytest

from gsplat_core.io.recordings import synthesize
from gsplat_core.scene.frames import Frame
from operators.applications.session import Progress, ProgressCallback, RunOutcome, RunSettings, Session, scheduler_for
from operators.errors import RunFailed, StorageFull
from operators.graph import Application, Operator, OperatorSpec
from operators.ingest import SourceOp, SourceResult
from operators.outcome import OutcomeBuilder
from operators.sinks.sink import CallbackSinkOp
from operators.sources.registry import open_source
from operators.sources.source import FrameSource
from operators.storage import write_whole


@dataclass(frozen=True)
class SharpnessResult:
    """Result of the sharpness application."""

    frames: int
    least: float
    """Variance of the Laplacian of the least sharp frame."""


class SharpnessOp(Operator):
    """Measures each frame; keeps the least only.

    Inputs:
        frame: `Frame`.

    Outputs:
        sharpness: float.
    """

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("sharpness", type=float)
        self.frames, self.least = 0, math.inf

    def start(self) -> None:
        self.frames, self.least = 0, math.inf

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        sharpness = float(cv2.Laplacian(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())
        self.frames, self.least = self.frames + 1, min(self.least, sharpness)
        op_output.emit(sharpness, "sharpness")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        outcome.add(SharpnessResult(self.frames, self.least))


class SharpnessApplication(Application):
    """source → sharpness → progress."""

    def __init__(
        self, source: FrameSource, report: Callable[[float], None], stop_requested: Callable[[], bool]
    ) -> None:
        super().__init__(name="sharpness", track=True)
        self.scheduler(scheduler_for("cpu", self))
        self.given, self.report, self.stop_requested = source, report, stop_requested

    def compose(self) -> None:
        source = SourceOp(self, name="source", source=self.given, stop_requested=self.stop_requested)
        sharpness = SharpnessOp(self, name="sharpness")
        self.add_flow(source, sharpness)
        self.add_flow(sharpness, CallbackSinkOp(self, name="progress", callback=self.report))


def measure_sharpness(
    recording: Path,
    out: Path,
    progress: ProgressCallback,
    stop_requested: Callable[[], bool] = lambda: False,
) -> RunOutcome:
    source = open_source(recording)
    done = 0

    def report(sharpness: float) -> None:
        nonlocal done
        done += 1
        progress(Progress("sharpness", done, source.description.frame_count or done))

    def save(session: Session) -> None:
        result = session.reached.find(SharpnessResult)
        assert result is not None
        write_whole(out / "least.txt", f"{result.least}\n".encode())
        session.reached.output("least", out / "least.txt")

    settings = RunSettings("cpu", "embedded", "none", "none", 0, 1.0, None, heldout=False)
    graph = SharpnessApplication(source, report, stop_requested)
    return Session(graph, settings, command="sharpness", finish=[save], stop_requested=stop_requested).execute()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=4, width_px=64, height_px=48, stereo=False)


def test_it_runs_and_its_outcome_has_its_own_part(tiny, tmp_path):
    events = []
    outcome = measure_sharpness(tiny, tmp_path, events.append)
    result = outcome.find(SharpnessResult)
    assert result.frames == 4 == outcome.find(SourceResult).frames and 0 < result.least < math.inf
    assert [event.done for event in events] == [1, 2, 3, 4]
    assert float((tmp_path / "least.txt").read_text()) == result.least
    assert outcome.outputs == {"least": tmp_path / "least.txt"} and outcome.stop_reason == "end of recording"
    assert outcome.operators["sharpness"].count == 4 and set(outcome.latency) == {"source,sharpness,progress"}


def test_a_stop_and_a_failure_leave_what_was_reached(tiny, tmp_path):
    events = []
    outcome = measure_sharpness(tiny, tmp_path, events.append, lambda: len(events) == 2)
    assert outcome.interrupted and outcome.find(SharpnessResult).frames == 2

    def fail(event):
        raise StorageFull("no room to say so")

    with pytest.raises(RunFailed, match="the sharpness ended early: operator 'progress' failed") as caught:
        measure_sharpness(tiny, tmp_path, fail)
    assert caught.value.result.find(SharpnessResult).frames == 1 and set(caught.value.result.outputs) == {"least"}
