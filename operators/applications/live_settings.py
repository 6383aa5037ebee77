"""Settings of a live run, and their defaults per device."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.depth.maps import check_depth, depth_inputs
from gsplat_core.io.sessions import WriterOptions
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.image_motion import Detail
from gsplat_core.training.schedule import LiveTraining
from operators.applications.replay import PIXELS_PER_GAUSSIAN
from operators.applications.session import RunSettings
from operators.frame_clock import ClockSettings
from operators.settings import LiveOptions
from operators.tool_mask import check_tool_mask

LIVE_WINDOW_FRAMES = {"cpu": 60, "cuda": 150}
LIVE_BUMP_SPACING_S = {"cpu": 0.2, "cuda": 0.1}
LIVE_HISTORY_S = {"cpu": 3.0, "cuda": 6.0}
"""Duration of the past that stays deformable, in seconds, one more than the training window
(`LIVE_WINDOW_FRAMES`) takes at 30 frames/s. Longer histories slow down every optimiser step on a CPU.
"""
LIVE_MOTION_DETAIL: Detail = "half"
LIVE_GAUSSIANS = {"cpu": 12_000, "cuda": 45_000}
LIVE_MOST_GAUSSIANS = 100_000
"""Maximum number of initial Gaussians of a scene, for large pictures. The capacity is twice the initial number."""
LIVE_PIXELS_PER_GAUSSIAN = 13
"""Pixels per initial Gaussian on a GPU, for pictures large enough that this gives more than `LIVE_GAUSSIANS` Gaussians."""
LIVE_TRAINING = {
    "cpu": LiveTraining(first_rate=2.0, last_rate=1.5, rate_steps=2, colour_relaxation=1.5, corrections_before=4),
    "cuda": LiveTraining(colour_relaxation=1.5),
}
LIVE_SQUARED_ERROR = {"cpu": True, "cuda": False}
"""True for a squared colour loss instead of L1. It suits few optimiser steps per frame; with many, L1 follows motion better."""
LIVE_LEAST_STEPS = {"cpu": 1, "cuda": 3}
"""Minimum number of optimiser steps per frame, even past the display deadline."""
LIVE_LEAST_SHARE = {"cpu": 0.34, "cuda": 0.2}
"""Share of the frame interval guaranteed for training, even past the display deadline."""
LIVE_LEAST_MOST_MS = {"cpu": None, "cuda": 13.0}
"""Upper limit in milliseconds of the training time that `LIVE_LEAST_SHARE` guarantees; None for no limit (results/live.md)."""
LIVE_SHOW_AFTER = {"cpu": (0.85, 28.3), "cuda": (0.6, 17.0)}
"""Display deadline after a frame's arrival: share of the frame interval, and upper limit in milliseconds. On a CPU another
optimiser step improves the picture more than an earlier display does.
"""
LIVE_FIRST_STEPS = {"cpu": 4, "cuda": 5}
"""Minimum number of optimiser steps on a scene's first frame. Its display and the following frames wait for these steps."""
LIVE_PREDICT_EVERY = {"cpu": 8, "cuda": 4}
"""One in this many frames is also predicted before training on it and scored. This costs about one rendering and scoring."""
LIVE_CATCH_UP_INTERVALS = {"cpu": 2.0, "cuda": 4.0}
"""Longest wait of a frame before it is dropped, in frame intervals. A GPU catches up within a few
frames. A CPU with two cores would display all queued frames late.
"""
LIVE_STARTS_FROM_MOTION = {"cpu": True, "cuda": False}
"""Initialise motion by optical flow. With few optimiser steps, flow follows the tissue faster than training;
on a GPU, flow is slower than training.
"""
LIVE_SSIM_WEIGHT = {"cpu": 0.0, "cuda": 0.1}
"""Weight of SSIM next to L1, which improves tracking of motion. On a CPU an optimiser step with SSIM takes 1.5 times
as long."""


@dataclass(frozen=True)
class LiveSettings(LiveOptions):
    """Settings of a live run. Raises InvalidSetting for a value out of range."""

    source: str
    """Address of the source (see `open_source`)."""
    out: Path
    record: Path | None = None
    """New folder for a recording of the session; None: no recording."""
    recording: WriterOptions = dataclasses.field(default_factory=WriterOptions)
    """Format and limits of the session recording that `record` requests."""
    report: bool = True
    """Collect data for the report: per-frame scores, key frames, SSIM and a digest of the pictures.
    Disable for endless runs, because the log grows.
    """
    clock: ClockSettings = dataclasses.field(default_factory=ClockSettings)
    """Display deadlines, and limits on optimiser steps. The option `budget_ms` overrides `clock.budget_ms`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_tool_mask(self.tool_mask)
        check_depth(self.depth)

    @property
    def chosen_clock(self) -> ClockSettings:
        """Display deadlines, and limits on optimiser steps, with the defaults of the device filled in."""
        at_least = self.clock.at_least_steps or LIVE_LEAST_STEPS[self.device]
        fewest = self.clock.fewest_steps or at_least
        share, most_ms = LIVE_SHOW_AFTER[self.device]
        return dataclasses.replace(
            self.clock,
            budget_ms=self.clock.budget_ms if self.budget_ms is None else self.budget_ms,
            auto_share=self.clock.auto_share or share,
            auto_most_ms=self.clock.auto_most_ms or most_ms,
            least_share=self.clock.least_share or LIVE_LEAST_SHARE[self.device],
            least_most_ms=self.clock.least_most_ms or LIVE_LEAST_MOST_MS[self.device],
            at_least_steps=at_least,
            fewest_steps=fewest,
            first_at_least_steps=self.clock.first_at_least_steps or LIVE_FIRST_STEPS[self.device],
            catch_up_intervals=self.clock.catch_up_intervals or LIVE_CATCH_UP_INTERVALS[self.device],
        )

    @property
    def chosen_training(self) -> LiveTraining:
        """Defaults of the training parameters for the selected device."""
        return LIVE_TRAINING[self.device]

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files and folders that the run reads, which its output must not replace."""
        path = Path(self.source)
        return (*((path,) if path.exists() else ()), *depth_inputs(self.depth))

    def reconstructor_config(self, pixels: int) -> ReconstructorConfig:
        """Return the reconstructor's settings for frames of `pixels` pixels. Raises InvalidSetting."""
        device = self.device
        wanted = LIVE_GAUSSIANS[device]
        if device == "cuda":
            wanted = max(wanted, min(LIVE_MOST_GAUSSIANS, pixels // LIVE_PIXELS_PER_GAUSSIAN))
        wanted = min(wanted, max(64, pixels // PIXELS_PER_GAUSSIAN))
        config = ReconstructorConfig(
            gaussians=wanted,
            max_gaussians=2 * wanted,
            window_frames=LIVE_WINDOW_FRAMES[device],
            motion_spacing_s=LIVE_BUMP_SPACING_S[device],
            history_s=LIVE_HISTORY_S[device],
            preallocate=True,
            motion_prior="flow",
            motion_detail=LIVE_MOTION_DETAIL,
            start_from_motion=LIVE_STARTS_FROM_MOTION[device],
            ssim_weight=LIVE_SSIM_WEIGHT[device],
            squared_error=LIVE_SQUARED_ERROR[device],
        )
        return self.applied_to(config)

    def stated(self) -> RunSettings:
        """Return the settings that the report states."""
        return RunSettings(
            device=self.device,
            engine="embedded",
            field=ReconstructorConfig(field=self.field).chosen_field,
            renderer=self.renderer,
            seed=self.seed,
            scale=self.given_scale,
            steps_per_frame=None,
            heldout=False,
        )
