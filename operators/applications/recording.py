"""Creation of the recorder of a live run, which keeps frames, pictures and the calls of training."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from gsplat_core.io.frame_codec import camera_record
from gsplat_core.io.sessions import SessionInfo
from gsplat_core.io.sessions.records import ReconstructorMade
from gsplat_core.training.reconstructor import Reconstructor
from operators.output_folder import RECORDINGS
from operators.sinks.session_recorder import SessionRecorder
from operators.sources.source import SourceDescription
from operators.storage import StorageReserve

if TYPE_CHECKING:
    from operators.applications.live_settings import LiveSettings

RECORDING_RESERVE_BYTES = 64 * 2**20
"""Disk space that a recording leaves free in addition to the space for finishing the run, in bytes."""


def new_recording_folder(out: Path) -> Path:
    """Return a new folder name for the recording of a run with the output folder `out`. Creates nothing."""
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


def reconstructor_line(
    reconstructor: Reconstructor, settings: LiveSettings, source: SourceDescription
) -> ReconstructorMade:
    """Return the line that records the settings of a new reconstructor."""
    return ReconstructorMade(
        device=settings.device,
        seed=settings.seed,
        renderer=settings.renderer,
        config=_json(reconstructor.config),
        training=_json(settings.chosen_training),
        camera=camera_record(reconstructor.camera),
        stereo=source.is_stereo,
    )


def _json(settings: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON values."""
    assert dataclasses.is_dataclass(settings)
    values: dict[str, Any] = TypeAdapter(type(settings)).dump_python(settings, mode="json")
    return values
