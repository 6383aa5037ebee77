"""Faithful replay of a recorded session with its prepared frames, calls and settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter, ValidationError

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.sessions import SessionReader, is_session
from gsplat_core.io.sessions.records import ReconstructorMade, camera_of
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.live import LiveReconstructor, LiveTraining
from operators.applications.device import seeded
from operators.applications.warm_reconstructor import warm_reconstructor
from operators.compare_shown import CompareShownOp
from operators.graph import Application
from operators.scheduled_reconstruct import ScheduledReconstructOp
from operators.settings import check_option
from operators.sources.session import SessionSource

if TYPE_CHECKING:
    from operators.applications.replay import ReplaySettings


@dataclass(frozen=True)
class FollowedSession:
    """A recorded session whose schedule is replayed."""

    reader: SessionReader
    source: SessionSource
    made: ReconstructorMade
    config: ReconstructorConfig
    training: LiveTraining
    device: str

    def new_reconstructor(self) -> LiveReconstructor:
        """Create a reconstructor with the session's settings, warmed up identically."""
        with seeded(self.made.seed, self.device):
            reconstructor = LiveReconstructor(
                self.config,
                camera_of(self.made.camera),
                live=self.training,
                seed=self.made.seed,
                recording_digest=self.source.description.digest,
                device=self.device,
            )
            warm_reconstructor(reconstructor, stereo=self.made.stereo)
        return reconstructor

    def reconstruct_op(self, graph: Application, name: str) -> ScheduledReconstructOp:
        """Create the training operator, which follows the schedule."""
        return ScheduledReconstructOp(
            graph,
            name=name,
            make_reconstructor=self.new_reconstructor,
            schedule=self.reader.schedule,
            late_depths=self.reader.late_depths,
        )

    def compare_op(self, graph: Application, name: str) -> CompareShownOp:
        """Create the operator that compares the pictures with the recorded ones."""
        return CompareShownOp(graph, name=name, shown=self.reader.digests)


def followed_session(settings: ReplaySettings, notes: list[str]) -> FollowedSession | None:
    """Return the recorded session if its schedule can be replayed; None for a plain recording.

    Args:
        settings: settings of the replay.
        notes: receives the reason if the schedule of a session is not followed.

    Raises:
        InvalidSetting: the schedule has settings that this version does not support.
    """
    path = Path(settings.recording)
    if settings.ignore_schedule or not is_session(path):
        return None
    reader = SessionReader(path)
    made = reader.made
    why = None
    if made is None:
        why = "its beginning is not there any more, or it has no schedule"
    elif settings.given_scale != 1 or settings.heldout or settings.steps_per_frame is not None:
        why = "scale, held-out frames or steps per frame were given, which it does not have"
    if made is None or why is not None:
        notes.append(
            f"the session's schedule is not followed, so that pictures differ from those that it showed: {why}"
        )
        return None
    try:
        config = TypeAdapter(ReconstructorConfig).validate_python(made.config)
        training = TypeAdapter(LiveTraining).validate_python(made.training)
        check_option("seed", made.seed)
        camera_of(made.camera)
    except (ValidationError, InvalidInput, InvalidSetting) as error:
        first = " ".join(str(error).split())[:200]
        raise InvalidSetting(
            f"{path}: its schedule has settings that this version does not take ({first}); give --ignore-schedule"
        ) from error
    if made.device != settings.device:
        notes.append(f"the session ran on {made.device}: on {settings.device} its pictures come out otherwise")
    source = SessionSource(reader, open_recording(path), max_frames=settings.max_frames)
    return FollowedSession(reader, source, made, config, training, settings.device)
