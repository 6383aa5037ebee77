"""Compatibility of a finished model with a recording, and the frames that both have in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from gsplat_core.choices import Eyes
from gsplat_core.errors import InvalidSetting, RecordingInvalid
from gsplat_core.io.recordings.calibration import POSES_FILE, read_poses
from gsplat_core.io.recordings.plain_files import Findings
from gsplat_core.io.sessions import SessionReader, is_session
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.applications.session import FirstFrames, judged
from operators.sources.derived import PosedSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import FrameSource, SourceDescription

SAME_CAMERA = 1e-3
"""Largest difference of focal lengths and of principal points for which two cameras count as equal, as a share of the
picture's width."""


@dataclass(frozen=True)
class EvaluatedRun:
    """Settings of the run that made a model, as read from its report."""

    folder: Path
    command: str
    field: str
    seed: int
    steps_per_frame: int | None
    scale: float
    heldout: bool
    """True if the held-out frames (1, 9, 17, ...) were excluded from training."""
    eyes: Eyes = "left"
    fps: float | None = None
    """Playback rate of a live run, in frames/s; None for the recording's own rate."""


@dataclass(frozen=True)
class Playback:
    """Mapping of a recording's timestamps to those of the stream that played it (see `RealtimeSource`)."""

    last_s: float
    """Timestamp in the stream, in seconds, of the recording's last frame when it was first played."""
    stretch: float = 1.0
    """Factor on all timestamps: 0.5 for a recording of 30 frames/s played at 60."""
    round_s: float = math.inf
    """Duration of one round of a looped recording, in seconds; infinite if not looped."""

    def times(self, frame: Frame, turn: int, frames: int) -> Frame:
        """Return the frame with the number and timestamp that it had in the stream.

        Args:
            frame: frame of the recording.
            turn: round of a looped recording, from 0.
            frames: number of frames in the recording.
        """
        if turn == 0 and self.stretch == 1:
            return frame
        offset_ns = round(turn * self.round_s * 1e9) if turn else 0
        return frame.with_fields(seq=frame.seq + turn * frames, pts_ns=offset_ns + round(frame.pts_ns * self.stretch))


@dataclass(frozen=True)
class SeenFrames:
    """Iterable of a source's frames within a time range. Each iteration reads the source from its beginning."""

    source: FrameSource
    from_s: float
    until_s: float
    playback: Playback
    stop_requested: Callable[[], bool] = lambda: False
    progress: Callable[[int], None] = lambda done: None

    def __iter__(self) -> Iterator[Frame]:
        count = self.source.description.frame_count or 2**62
        looped = math.isfinite(self.playback.round_s)
        turn = math.floor(self.from_s / self.playback.round_s) if looped and self.from_s > 0 else 0
        done = 0
        while turn == 0 or turn * self.playback.round_s <= self.until_s:
            for frame in FirstFrames(self.source, count):
                frame = self.playback.times(frame, turn, count)
                if self.stop_requested() or frame.time_s > self.until_s:
                    return
                done += 1
                self.progress(done)
                if frame.time_s >= self.from_s:
                    yield frame
            if not looped:
                return
            turn += 1


def frame_tolerance_s(fps: float) -> float:
    """Return the tolerance of a model's time window in seconds, slightly more than one frame interval.

    The frame after the last trained frame counts as inside, because the held-out split of some recordings includes the
    last frame.
    """
    return 1.01 / fps


def fitting_source(
    address: Path | str,
    model: Model,
    scale: float | None,
    max_frames: int | None,
    run: EvaluatedRun | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> tuple[FrameSource, float, Playback, list[str]]:
    """Open the recording at the model's size and check that it fits the model.

    Args:
        address: address of the recording.
        model: the finished model.
        scale: scale of the frames; None selects the scale that gives the model's size.
        max_frames: number of frames to read; None for all.
        run: settings of the run that made the model; None if unknown.
        stop_requested: polled while the recording is read; True ends that.

    Returns:
        The source as `judged` returns it, its scale, the mapping of its timestamps, and notes for the report.

    Raises:
        InvalidSetting: the model cannot come from such a recording, because camera, aspect ratio or
            time range differ, or the source can be read only once. Also as `open_source`.
    """
    notes: list[str] = []
    source = open_source(address, SourceOptions(scale or 1.0, max_frames))
    made = model.camera
    if scale is None:
        scale = _scale_of_model(made, source.description.camera, None if run is None else run.scale)
        if scale != 1:
            source = open_source(address, SourceOptions(scale, max_frames))
            if run is None or scale != run.scale:
                notes.append(f"evaluated at the model's size of {made.width_px}x{made.height_px} px, scale {scale:.4g}")
    description = source.description
    _check_camera(made, description.camera, description.name)
    if (made.width_px, made.height_px) != (description.width_px, description.height_px):
        notes.append(
            f"the model was made from frames of {made.width_px}x{made.height_px} px and is evaluated at"
            f" {description.width_px}x{description.height_px} px, as --scale says"
        )
    if description.frame_count is None or description.digest is None:
        raise InvalidSetting(f"{description.name} can be read only once; evaluate needs a recording")
    if model.training_digest is None:
        notes.append("the model does not say which recording it was made from")
    elif model.training_digest != description.digest:
        notes.append(
            "the model was made from other files than these: the figures state how well it shows a recording that it was not made from,"
            " unless only files next to the pictures have changed"
        )
    if is_session(Path(address)):
        playback, more = _session_playback(model, Path(address), description)
    else:
        playback, more = _playback(model, description, None if run is None else run.fps, max_frames is not None)
    return judged(source, stop_requested), scale, playback, [*notes, *more]


def poses_of_run(source: FrameSource, run: EvaluatedRun | None) -> Path | None:
    """Return the file with the poses that `reconstruct` estimated for its model; None if it estimated none, or if the
    source has poses."""
    path = None if run is None else run.folder / POSES_FILE
    return path if path is not None and path.is_file() and "pose" not in source.description.fields else None


def with_poses_of_run(source: FrameSource, run: EvaluatedRun | None) -> FrameSource:
    """Return the source with the poses that `reconstruct` estimated for its model; without such poses the source itself.

    Raises:
        RecordingInvalid: the run's file of poses is damaged.
    """
    path = poses_of_run(source, run)
    if path is None:
        return source
    try:
        count = len(np.load(path, mmap_mode="r"))
    except (OSError, ValueError, TypeError) as error:
        raise RecordingInvalid(f"{path} has no poses: {error}; make the run again") from error
    poses = read_poses(path, count, Findings(strict=True))
    assert poses is not None  # with strict findings, the reader raises instead of returning None
    return PosedSource(source, lambda frame: poses[min(frame.seq, count - 1)])


def _scale_of_model(made: Camera, seen: Camera, run_scale: float | None) -> float:
    """Return the scale at which pictures of the camera `seen` have the size of those of `made`; preferably 1 or `run_scale`."""
    for scale in (1.0, run_scale):
        if scale is not None:
            scaled = seen.scaled(scale)
            if (scaled.width_px, scaled.height_px) == (made.width_px, made.height_px):
                return scale
    return made.width_px / seen.width_px


def _check_camera(made: Camera, seen: Camera, name: str) -> None:
    """Raise InvalidSetting unless both cameras have the same intrinsics up to the picture size."""
    if made.model != seen.model:
        raise InvalidSetting(
            f"the model was made with a {made.model} camera, and {name} has a {seen.model} one; give the recording that it was made from"
        )
    ratio = seen.width_px / made.width_px
    if abs(seen.height_px - made.height_px * ratio) > 1:
        raise InvalidSetting(
            f"the model's pictures have {made.width_px}x{made.height_px} px, those of {name} {seen.width_px}x{seen.height_px} px, which is"
            " another shape; give the recording that it was made from"
        )
    # Scaling rounds width and height to whole pixels separately, so their scale factors differ slightly.
    wanted = made.scaled(ratio).K if ratio != 1 else made.K
    apart = float(np.abs(wanted - seen.K).max()) / seen.width_px
    if apart > SAME_CAMERA + 1.0 / seen.height_px * (ratio != 1):
        raise InvalidSetting(
            f"the model's camera has a focal length of {wanted[0, 0]:.2f} px and its axis at ({wanted[0, 2]:.1f}, {wanted[1, 2]:.1f}), that of"
            f" {name} {seen.K[0, 0]:.2f} px and ({seen.K[0, 2]:.1f}, {seen.K[1, 2]:.1f}); give the recording that it was made from"
        )


def _playback(
    model: Model, description: SourceDescription, fps: float | None, shortened: bool
) -> tuple[Playback, list[str]]:
    """Return the mapping of the recording's timestamps to those of the run, of which the model's time window is known.

    Args:
        model: the finished model.
        description: the recording.
        fps: playback rate of the run, in frames/s; None for the recording's own rate.
        shortened: only the beginning of the recording is read.

    Returns:
        The mapping and notes for the report.

    Raises:
        InvalidSetting: model and recording have no time in common.
    """
    assert description.frame_count is not None
    stretch = 1.0 if fps is None else description.fps / fps
    start_s, end_s = model.time_window_s
    round_s = description.frame_count / description.fps * stretch
    last_s = (description.frame_count - 1) / description.fps * stretch
    tolerance_s = frame_tolerance_s(description.fps / stretch)
    notes = [f"the run played the recording at {fps:g} frames/s; times are the run's"] if fps and stretch != 1 else []
    if fps is not None and not shortened and end_s - tolerance_s > round_s:
        notes.append(
            f"the run looped the recording: retention is of the last of {end_s / round_s:.1f} rounds, the baselines are of one"
        )
        return Playback(last_s, stretch, round_s), notes
    notes += _common_time(model, description.name, round_s, tolerance_s)
    seen = math.floor((end_s + tolerance_s) * description.fps / stretch) + 1
    if seen < description.frame_count:
        notes.append(
            f"the model has seen {start_s:.2f} to {end_s:.2f} s: the first {seen} of the {description.frame_count} frames are evaluated"
        )
    return Playback(last_s, stretch), notes


def _session_playback(model: Model, folder: Path, description: SourceDescription) -> tuple[Playback, list[str]]:
    """Return the mapping of a recorded session, whose timestamps are already those of the run."""
    lines = islice(SessionReader(folder).frame_lines(), description.frame_count)
    last_s = max((line.pts_ns * 1e-9 for line in lines), default=0.0)
    return Playback(last_s), _common_time(model, description.name, last_s, frame_tolerance_s(description.fps))


def _common_time(model: Model, name: str, recorded_s: float, tolerance_s: float) -> list[str]:
    """Return a note if the model's time window ends after the recording.

    Raises InvalidSetting if the model's time window begins after the recording's end, `recorded_s`.
    """
    start_s, end_s = model.time_window_s
    if start_s > recorded_s + tolerance_s:
        raise InvalidSetting(
            f"the model has seen {start_s:.2f} to {end_s:.2f} s, and the frames of {name} end at {recorded_s:.2f} s; they have no time in common"
        )
    if end_s - tolerance_s > recorded_s:
        return [
            f"the model has seen {start_s:.2f} to {end_s:.2f} s, and the frames that are evaluated end at {recorded_s:.2f} s"
        ]
    return []
