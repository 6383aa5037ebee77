"""What a live run is asked for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.registry import check_depth, depth_inputs
from gsplat_core.io.sessions import WriterOptions
from gsplat_core.training.config import Eyes, ReconstructorConfig, check_eyes
from gsplat_core.training.image_motion import Detail
from gsplat_core.training.live_training import LiveTraining
from operators.applications.limits import check_max_frames, check_scale, check_seed
from operators.applications.replay import PIXELS_PER_GAUSSIAN
from operators.applications.result import RunSettings
from operators.display import DisplaySettings
from operators.frame_clock import ClockSettings
from operators.out_of_body import Policy
from operators.pose import Poses
from operators.tool_mask import check_tool_mask

LIVE_WINDOW_FRAMES = {"cpu": 60, "cuda": 150}
LIVE_BUMP_SPACING_S = {"cpu": 0.2, "cuda": 0.1}
LIVE_HISTORY_S = {"cpu": 3.0, "cuda": 6.0}
"""How much of the past stays deformable: what the window holds at 30 frames a second, and a little more. On a CPU each second of it makes
every step longer."""
LIVE_MOTION_DETAIL: Detail = "half"
LIVE_GAUSSIANS = {"cpu": 12_000, "cuda": 45_000}
LIVE_MOST_GAUSSIANS = 100_000
"""At the start of a scene, for large pictures; twice as many may be there in all."""
LIVE_PIXELS_PER_GAUSSIAN = 13
"""On a GPU, for pictures that are larger than the usual ones."""
LIVE_TRAINING = {
    "cpu": LiveTraining(first_rate=2.0, last_rate=1.5, rate_steps=2, colour_relaxation=1.5),
    "cuda": LiveTraining(colour_relaxation=1.5),
}
LIVE_SQUARED_ERROR = {"cpu": True, "cuda": False}
"""What colours are corrected by where there are few steps; with many L1 follows motion better."""
LIVE_LEAST_STEPS = {"cpu": 1, "cuda": 3}
"""Steps that a frame gets though it is shown late."""
LIVE_LEAST_SHARE = {"cpu": 0.34, "cuda": 0.2}
"""Share of the time between frames that training gets though a frame is shown later for it: a few steps."""
LIVE_SHOW_AFTER = {"cpu": (0.85, 28.3), "cuda": (0.6, 17.0)}
"""A frame is shown after this share of the time between frames, and at most so many milliseconds. A step on a CPU is worth more than showing it
sooner, as long as it is shown before the next frame comes."""
LIVE_FIRST_STEPS = {"cpu": 4, "cuda": 5}
"""Steps of a scene's first frame: its picture, and the frames behind it, wait for them."""
LIVE_PREDICT_EVERY = {"cpu": 8, "cuda": 4}
"""Every so many pictures the next frame's prediction is rendered and scored. It costs as much as a picture and its score."""
LIVE_CATCH_UP_INTERVALS = {"cpu": 2.0, "cuda": 4.0}
"""How long a frame may wait before it is passed over. A GPU catches up within a few frames; two cores would show each of them late."""
LIVE_STARTS_FROM_MOTION = {"cpu": True, "cuda": False}
"""With few steps a frame, optical flow tells where the tissue is sooner than training does; on a GPU the flow itself takes longer."""
LIVE_SSIM_WEIGHT = {"cpu": 0.0, "cuda": 0.1}
"""Beside L1: follows motion better. On a CPU a step takes half as long again with it, and steps are what is short there."""


@dataclass(frozen=True)
class LiveSettings:
    """What to reconstruct live, how, and where the results go. Raises InvalidSetting for a value out of its range."""

    source: str
    """An address (see `open_source`)."""
    out: Path
    device: str = "cpu"
    field: str = "auto"
    renderer: str = "alpha"
    seed: int = 0
    eyes: Eyes = "left"
    """Which pictures of a stereo scope are trained on; `both` where the right one's camera is known. Depth is found from both in either case, and what is
    shown is the left one's: the right one takes steps from it."""
    scale: float | None = None
    """Resize the stream's pictures by this factor. None: as much as this machine needs on a CPU (`working_size`), not at all on a GPU."""
    max_frames: int | None = None
    seconds: float | None = None
    """End after so long; None: when the source ends or the run is interrupted."""
    loop: bool = False
    """Play a recording again and again."""
    fps: float | None = None
    """Play a recording at this rate instead of its own."""
    record: Path | None = None
    """Record the session into this folder, which is not there yet; None: it is not recorded."""
    recording: WriterOptions = dataclasses.field(default_factory=WriterOptions)
    """How it is recorded."""
    report: bool = True
    """Gather what a report shows: a line of figures for each frame, key frames, SSIM and the digest of the pictures. A run without an end
    has no report, and its log would grow."""
    tool_mask: str = "builtin"
    """How tools are found in frames that come without a mask (`operators.tool_mask.TOOL_MASKS`)."""
    depth: str = "auto"
    """Where depth comes from: a name in `gsplat_core.geometry.registry.DEPTHS`, or `auto`."""
    poses: Poses = "given"
    """Where the scope is: as the frames say, or as is estimated from the pictures (`operators.pose`)."""
    out_of_body: Policy = "withhold"
    """What happens to pictures from outside of the body: nothing of them goes on, or (`off`) they are not looked for."""
    clock: ClockSettings = dataclasses.field(default_factory=ClockSettings)
    display: DisplaySettings = dataclasses.field(default_factory=DisplaySettings)
    training: LiveTraining | None = None
    """None: as suits the number of steps that the device can make in a frame's time."""

    def __post_init__(self) -> None:
        check_seed(self.seed)
        check_eyes(self.eyes)
        check_scale(self.given_scale)
        check_max_frames(self.max_frames)
        if self.seconds is not None and not 0 < self.seconds < 1e9:
            raise InvalidSetting(f"seconds is {self.seconds:g}; it must be positive")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise InvalidSetting(f"fps is {self.fps:g}; it must be above 0 and at most 1000")

        if self.out_of_body not in get_args(Policy):
            raise InvalidSetting(f"out-of-body is {self.out_of_body!r}; choose {' or '.join(get_args(Policy))}")
        check_tool_mask(self.tool_mask)
        check_depth(self.depth)

    @property
    def given_scale(self) -> float:
        """The factor that was asked for; 1 where none was."""
        return 1.0 if self.scale is None else self.scale

    @property
    def chosen_clock(self) -> ClockSettings:
        """When frames are shown."""
        at_least = self.clock.at_least_steps or LIVE_LEAST_STEPS[self.device]
        fewest = self.clock.fewest_steps or at_least
        share, most_ms = LIVE_SHOW_AFTER[self.device]
        return dataclasses.replace(
            self.clock,
            auto_share=self.clock.auto_share or share,
            auto_most_ms=self.clock.auto_most_ms or most_ms,
            least_share=self.clock.least_share or LIVE_LEAST_SHARE[self.device],
            at_least_steps=at_least,
            fewest_steps=fewest,
            first_at_least_steps=self.clock.first_at_least_steps or LIVE_FIRST_STEPS[self.device],
            catch_up_intervals=self.clock.catch_up_intervals or LIVE_CATCH_UP_INTERVALS[self.device],
        )

    @property
    def chosen_training(self) -> LiveTraining:
        """How the steps are taken."""
        return self.training or LIVE_TRAINING[self.device]

    @property
    def inputs(self) -> tuple[Path, ...]:
        """What the run reads from the disk."""
        path = Path(self.source)
        return (*((path,) if path.exists() else ()), *depth_inputs(self.depth))

    def reconstructor_config(self, pixels: int) -> ReconstructorConfig:
        """The reconstructor's settings for frames of so many pixels. Raises InvalidSetting."""
        device = self.device
        wanted = LIVE_GAUSSIANS[device]
        if device == "cuda":
            wanted = max(wanted, min(LIVE_MOST_GAUSSIANS, pixels // LIVE_PIXELS_PER_GAUSSIAN))
        wanted = min(wanted, max(64, pixels // PIXELS_PER_GAUSSIAN))
        return ReconstructorConfig(
            field=self.field,
            gaussians=wanted,
            max_gaussians=2 * wanted,
            window_frames=LIVE_WINDOW_FRAMES[device],
            bump_spacing_s=LIVE_BUMP_SPACING_S[device],
            history_s=LIVE_HISTORY_S[device],
            preallocate=True,
            motion_prior="flow",
            motion_detail=LIVE_MOTION_DETAIL,
            start_from_motion=LIVE_STARTS_FROM_MOTION[device],
            eyes=self.eyes,
            ssim_weight=LIVE_SSIM_WEIGHT[device],
            squared_error=LIVE_SQUARED_ERROR[device],
        )

    def stated(self) -> RunSettings:
        """What the report says about them."""
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
