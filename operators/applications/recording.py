"""Recording of a live run: frames, pictures and the schedule of training."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from gsplat_core.io.frame_codec import camera_record
from gsplat_core.io.sessions import SessionInfo
from gsplat_core.io.sessions.records import (
    Grown,
    Observed,
    ReconstructorMade,
    Rehearsed,
    SceneBegun,
    ScheduleLine,
)
from gsplat_core.training.reconstructor import Reconstructor
from operators.graph import Application, Operator
from operators.output_folder import RECORDINGS
from operators.reconstruct import ScheduleEvent, ScheduleListener
from operators.sinks.session_recorder import RecordFramesOp, RecordPicturesOp, RecordPreparationOp, SessionRecorder
from operators.sources.source import SourceDescription
from operators.storage import StorageReserve

if TYPE_CHECKING:
    from operators.applications.live_settings import LiveSettings

RECORDING_RESERVE_BYTES = 64 * 2**20
"""Disk space that a recording leaves free in addition to the space for finishing the run, in
bytes.
"""


def new_recording_folder(out: Path) -> Path:
    """Return a new folder name for the recording of a run with the output folder `out`. Creates
    nothing.
    """
    base = out / RECORDINGS / datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    folder, more = base, 1
    while folder.exists():
        folder, more = base.with_name(f"{base.name}-{more}"), more + 1
    return folder


def new_recorder(
    folder: Path, source: SourceDescription, settings: LiveSettings, room_to_finish: Callable[[], int]
) -> SessionRecorder:
    """Create the recorder of a run. The graph opens it at its start.

    Args:
        folder: folder for this recording alone.
        source: description of the stream.
        settings: settings of the run.
        room_to_finish: returns the disk space that finishing the run needs, in bytes.
    """
    info = SessionInfo(
        source=source.name[:1000],
        utc=datetime.now(UTC).isoformat(),
        fps=source.fps,
        camera=camera_record(source.camera),
        fields=tuple(sorted(source.fields & {"mask", "depth", "right_image", "pose"})),  # type: ignore[arg-type]
        settings={"device": settings.device, "scale": settings.given_scale, "seed": settings.seed},
        keeps_bytes=settings.recording.keep_bytes,
        keeps_s=settings.recording.keep_s,
    )
    reserve = StorageReserve(folder, lambda: RECORDING_RESERVE_BYTES + room_to_finish())
    return SessionRecorder(folder, info, settings.recording, reserve=reserve)


class RunRecording:
    """Inserts the recording of a live run into its graph. Without a recording folder it has no
    effect.
    """

    def __init__(
        self, graph: Application, settings: LiveSettings, source: SourceDescription, room: Callable[[], int]
    ) -> None:
        """Create the recorder if the settings ask for a recording.

        Args:
            graph: graph of the run.
            settings: settings of the run.
            source: description of the stream.
            room: returns the disk space that finishing the run needs, in bytes.
        """
        self._graph, self._settings, self._is_stereo = graph, settings, source.is_stereo
        self.recorder: SessionRecorder | None = None
        if settings.record is not None:
            self.recorder = new_recorder(settings.record, source, settings, room)

    def behind_gate(self) -> list[Operator]:
        """Return the operators that record each frame after the out-of-body gate."""
        if self.recorder is None:
            return []
        return [RecordFramesOp(self._graph, name="recorded_frames", recorder=self.recorder)]

    def behind_analysis(self) -> list[Operator]:
        """Return the operators that record the analysis results of each frame before training."""
        if self.recorder is None:
            return []
        return [RecordPreparationOp(self._graph, name="recorded_preparation", recorder=self.recorder)]

    def pictures_of(self, display: Operator) -> None:
        """Record the pictures that `display` emits."""
        if self.recorder is not None:
            pictures = RecordPicturesOp(self._graph, name="recorded_pictures", recorder=self.recorder)
            self._graph.add_flow(display, pictures, {("shown", "shown")}, policy="drop_oldest", capacity=8)

    @property
    def listener(self) -> ScheduleListener | None:
        """Callback that records every call that changes the model; None without a recording."""
        if self.recorder is None:
            return None
        recorder = self.recorder

        def record_event(event: ScheduleEvent) -> None:
            if event.frame is not None:
                recorder.depth(event.frame)
            else:
                recorder.line(_line(event))

        return record_event

    def made_by(self, make: Callable[[], Reconstructor]) -> Callable[[], Reconstructor]:
        """Return a factory that calls `make` and records the settings of the new reconstructor."""
        if self.recorder is None:
            return make
        recorder, settings = self.recorder, self._settings

        def made() -> Reconstructor:
            reconstructor = make()
            recorder.line(
                ReconstructorMade(
                    device=settings.device,
                    seed=settings.seed,
                    renderer=settings.renderer,
                    config=_json(reconstructor.config),
                    training=_json(settings.chosen_training),
                    camera=camera_record(reconstructor.camera),
                    stereo=self._is_stereo,
                )
            )
            return reconstructor

        return made


def _line(event: ScheduleEvent) -> ScheduleLine:
    if event.kind == "rehearse":
        return Rehearsed(steps=event.steps)
    assert event.seq is not None, f"{event.kind} is of a frame"
    if event.kind == "begin_scene":
        return SceneBegun(seq=event.seq)
    if event.kind == "grow":
        return Grown(seq=event.seq)
    return Observed(seq=event.seq, steps=event.steps, train=event.train)


def _json(settings: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON values."""
    assert dataclasses.is_dataclass(settings)
    values: dict[str, Any] = TypeAdapter(type(settings)).dump_python(settings, mode="json")
    return values
