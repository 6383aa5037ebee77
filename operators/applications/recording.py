"""What a live run needs to be recorded: the recorder, and the lines that say how the model was trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from gsplat_core.io.sessions import SessionInfo
from gsplat_core.io.sessions.schedule import Observed, ReconstructorMade, Rehearsed, SceneBegun, ScheduleLine
from gsplat_core.io.sessions.session_file import camera_record
from gsplat_core.training.live import LiveReconstructor
from operators.graph import Application, Operator
from operators.output_folder import RECORDINGS
from operators.schedule import ScheduleEvent, ScheduleListener
from operators.sinks.recorder import RecordFramesOp, RecordPicturesOp, RecordPreparationOp
from operators.sinks.session_recorder import SessionRecorder
from operators.sources.source import SourceDescription
from operators.storage import StorageReserve

if TYPE_CHECKING:
    from operators.applications.live import LiveSettings

GATE = "out_of_body"
"""The operator behind which frames may be recorded."""
RECORDING_RESERVE_BYTES = 64 * 2**20
"""Room that a recording leaves on the disk, beside what finishing the run needs."""


def new_recording_folder(out: Path) -> Path:
    """Where a run that starts now and writes its results into `out` is recorded. The folder itself is made when the recording begins."""
    base = out / RECORDINGS / datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    folder, more = base, 1
    while folder.exists():
        folder, more = base.with_name(f"{base.name}-{more}"), more + 1
    return folder


def new_recorder(
    folder: Path, source: SourceDescription, settings: LiveSettings, room_to_finish: Callable[[], int]
) -> SessionRecorder:
    """A recorder for a run; it is opened when the graph starts."""
    info = SessionInfo(
        source=source.name[:1000],
        utc=datetime.now(UTC).isoformat(),
        fps=source.fps,
        camera=camera_record(source.camera),
        fields=tuple(sorted(source.fields & {"mask", "depth", "right_image", "pose"})),  # type: ignore[arg-type]
        settings={"device": settings.device, "scale": settings.scale, "seed": settings.seed},
        keeps_bytes=settings.recording.keep_bytes,
        keeps_s=settings.recording.keep_s,
    )
    reserve = StorageReserve(folder, lambda: RECORDING_RESERVE_BYTES + room_to_finish())
    return SessionRecorder(folder, info, settings.recording, reserve=reserve)


def recorded_analysis(graph: Application, analysis: list[Operator], recorder: SessionRecorder) -> list[Operator]:
    """The operators that look at each frame, with those between them that record it: behind the out-of-body gate, and behind all of them."""
    names = [operator.name for operator in analysis]
    behind_gate = names.index(GATE) + 1 if GATE in names else 0
    frames = RecordFramesOp(graph, name="recorded_frames", recorder=recorder)
    preparation = RecordPreparationOp(graph, name="recorded_preparation", recorder=recorder)
    return [*analysis[:behind_gate], frames, *analysis[behind_gate:], preparation]


def record_pictures(graph: Application, display: Operator, recorder: SessionRecorder) -> None:
    """Record what `display` shows."""
    pictures = RecordPicturesOp(graph, name="recorded_pictures", recorder=recorder)
    graph.add_flow(display, pictures, {("shown", "shown")}, policy="drop_oldest", capacity=8)


def records_schedule(recorder: SessionRecorder) -> ScheduleListener:
    """Writes every call that changes the model."""

    def listen(event: ScheduleEvent) -> None:
        line: ScheduleLine
        if event.kind == "rehearse":
            line = Rehearsed(steps=event.steps)
        elif event.seq is None:
            return
        elif event.kind == "begin_scene":
            line = SceneBegun(seq=event.seq)
        else:
            line = Observed(seq=event.seq, steps=event.steps, train=event.train)
        recorder.line(line)

    return listen


def records_reconstructors(
    make: Callable[[], LiveReconstructor], settings: LiveSettings, recorder: SessionRecorder
) -> Callable[[], LiveReconstructor]:
    """`make`, and write what was made."""

    def made() -> LiveReconstructor:
        reconstructor = make()
        recorder.line(
            ReconstructorMade(
                device=settings.device,
                seed=settings.seed,
                renderer=settings.renderer,
                config=_json(reconstructor.config),
                training=_json(settings.training),
                camera=camera_record(reconstructor.camera),
            )
        )
        return reconstructor

    return made


def _json(settings: Any) -> dict[str, Any]:
    """The fields of a dataclass, in what JSON has."""
    assert dataclasses.is_dataclass(settings)
    values: dict[str, Any] = TypeAdapter(type(settings)).dump_python(settings, mode="json")
    return values
