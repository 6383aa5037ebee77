"""Replay: a recording goes through the graph and comes out reconstructed, measured and viewable.

    source → tool_mask → reconstruct → deform → rasterize → video
                                                          → metrics → keyframes
                                                                    → progress

Deterministic: each operator takes its frames in order and shares nothing with the others but messages, time comes from the recording, work
per frame is a count, every edge blocks. The same recording, settings and device give the same `frames_sha256`, on either engine and with
any number of threads (`scheduler_for`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import Recording, is_heldout, open_recording
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.device import check_device, scheduler_for
from operators.applications.execution import Execution
from operators.applications.progress import Progress, ProgressCallback
from operators.applications.result import RunOutcome
from operators.deform import DeformOp
from operators.graph import Application, Engine
from operators.ingest import SourceOp
from operators.metrics import MetricsOp, ScoredFrame
from operators.output_folder import check_output_folder, claim_output_folder
from operators.rasterize import RasterizeOp
from operators.reconstruct import ReconstructOp
from operators.sinks.display import CallbackSinkOp, VideoSinkOp
from operators.sinks.keyframes import KeyframesOp
from operators.storage import StorageReserve
from operators.tool_mask import RecordedToolMaskOp

REPORT_RESERVE_BYTES = 8 * 2**20
"""Room on the disk that stays free for the video's index and the report."""
KEYFRAMES = 5
PIXELS_PER_GAUSSIAN = 4


@dataclass(frozen=True)
class ReplaySettings:
    """What to replay, how, and where the results go."""

    recording: Path
    out: Path
    device: str = "cpu"
    engine: Engine = "embedded"
    field: str = "auto"
    seed: int = 0
    steps_per_frame: int | None = None
    """Optimiser steps per frame; None is the reconstructor's default."""
    max_frames: int | None = None
    scale: float = 1.0
    heldout: bool = False
    """Show the protocol's held-out frames without training on them, and score them apart."""

    def __post_init__(self) -> None:
        if self.engine not in get_args(Engine):
            raise InvalidInput(f"engine is {self.engine!r}; choose {' or '.join(get_args(Engine))}")
        if self.seed < 0:
            raise InvalidInput(f"seed is {self.seed}; it must not be negative")

    def reconstructor_config(self, pixels: int | None = None) -> ReconstructorConfig:
        """The reconstructor's settings for frames of so many pixels. Raises InvalidInput."""
        config = ReconstructorConfig(field=self.field)
        if pixels is not None:
            # More Gaussians than a quarter of the pixels have nothing to show.
            most = max(64, pixels // PIXELS_PER_GAUSSIAN)
            config = replace(
                config, gaussians=min(config.gaussians, most), max_gaussians=min(config.max_gaussians, 2 * most)
            )
        return config if self.steps_per_frame is None else replace(config, steps_per_frame=self.steps_per_frame)


class ReplayApplication(Application):
    """Composes the graph; after a run the operators hold its results."""

    def __init__(
        self,
        recording: Recording,
        settings: ReplaySettings,
        *,
        video: Path,
        reserve_bytes: int = REPORT_RESERVE_BYTES,
        progress: ProgressCallback | None = None,
        stop_requested: Callable[[], bool] = lambda: False,
        make_reconstructor: Callable[[], Any] | None = None,
        stage: str = "replay",
    ) -> None:
        super().__init__(name="replay", track=True)
        self.scheduler(scheduler_for(settings.device, self))
        self.recording = recording
        self.settings = settings
        self.video_path = video
        self.stage = stage
        self._progress = progress
        self._stop_requested = stop_requested
        self._make_reconstructor = make_reconstructor or self._new_reconstructor
        self._reserve_bytes = reserve_bytes

    def compose(self) -> None:
        """Wire the operators; see the module's picture."""
        reserve = StorageReserve(self.video_path.parent, self.room_to_finish)
        self.source = SourceOp(self, name="source", recording=self.recording, stop_requested=self._stop_requested)
        self.tool_mask = RecordedToolMaskOp(self, name="tool_mask")
        self.reconstruct = ReconstructOp(
            self, name="reconstruct", make_reconstructor=self._make_reconstructor, held_out=self._held_out
        )
        self.deform = DeformOp(self, name="deform")
        self.rasterize = RasterizeOp(self, name="rasterize")
        self.video = VideoSinkOp(self, name="video", path=self.video_path, fps=self.recording.fps, reserve=reserve)
        self.metrics = MetricsOp(self, name="metrics")
        self.keyframes = KeyframesOp(self, name="keyframes", count=KEYFRAMES)
        report = CallbackSinkOp(self, name="progress", callback=self._report)
        self.add_flow(self.source, self.tool_mask, {("frame", "frame")})
        self.add_flow(self.tool_mask, self.reconstruct, {("frame", "frame")})
        self.add_flow(self.reconstruct, self.deform, {("reconstruction", "reconstruction")})
        self.add_flow(self.deform, self.rasterize, {("scene", "scene")})
        self.add_flow(self.rasterize, self.video, {("rendered", "rendered")})
        self.add_flow(self.rasterize, self.metrics, {("rendered", "rendered")})
        self.add_flow(self.metrics, self.keyframes, {("scored", "scored")})
        self.add_flow(self.metrics, report, {("scored", "message")})

    def room_to_finish(self) -> int:
        """Bytes on the disk that finishing needs: the newest model, in float32, and the report."""
        model = self.reconstruct.newest
        return self._reserve_bytes + (0 if model is None else 4 * model.parameter_count)

    def _new_reconstructor(self) -> Reconstructor:
        return Reconstructor(
            self.settings.reconstructor_config(self.recording.width_px * self.recording.height_px),
            self.recording.camera,
            seed=self.settings.seed,
            recording_digest=self.recording.digest,
            device=self.settings.device,
        )

    def _held_out(self, frame: Frame) -> bool:
        return self.settings.heldout and is_heldout(frame.seq)

    def announce(self) -> None:
        """Say how much there is to do: the first frame, which starts the model, takes long."""
        self._tell(0, None)

    def _report(self, scored: ScoredFrame) -> None:
        self._tell(len(self.metrics.series), scored.quality.psnr_tissue_db)

    def _tell(self, done: int, psnr_tissue_db: float | None) -> None:
        if self._progress is not None:
            self._progress(Progress(self.stage, done, self.recording.frame_count, psnr_tissue_db=psnr_tissue_db))


def replay(
    settings: ReplaySettings,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> RunOutcome:
    """Run a replay and write `reconstruction.mp4` and `model/` into the output folder.

    When `stop_requested` answers True the frames on their way are finished and everything is written; the outcome says so.

    Raises:
        RecordingError, InvalidInput, DeviceMissing, OutputFolderInUse, StorageFull: before anything was written.
        RunFailed: the run ended early; what it had reached is saved, and the error carries the outcome.
    """
    recording, notes = prepare(settings, "replay")
    app = ReplayApplication(
        recording, settings, video=settings.out / "reconstruction.mp4", progress=progress, stop_requested=stop_requested
    )
    return Execution(app, notes, stop_requested).execute()


def prepare(settings: ReplaySettings, made_by: str) -> tuple[Recording, list[str]]:
    """Check everything that can be checked before the first frame, then claim the output folder; the recording and its notes.

    Raises as `replay` does before anything is written.
    """
    check_device(settings.device)
    settings.reconstructor_config()
    check_output_folder(settings.out)
    recording = open_recording(settings.recording, scale=settings.scale, max_frames=settings.max_frames)
    notes = list(recording.notes)
    if "depth" not in recording.fields:
        notes.append(
            f"the recording has no depth: the scene starts on a plane {settings.reconstructor_config().default_depth_mm:g} mm away, and its"
            " depth has no measured scale"
        )
    if claim_output_folder(settings.out, made_by):
        notes.append("the output folder held an earlier run; this one replaces its files")
    StorageReserve(settings.out, lambda: REPORT_RESERVE_BYTES).require()
    return recording, notes
