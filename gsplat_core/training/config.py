"""Settings of the reconstructor: what is learned, how fast, from which frames."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, get_args

from gsplat_core.deformation.field import FieldRates, check_rates
from gsplat_core.deformation.registry import FIELDS
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.training.image_motion import Detail
from gsplat_core.training.motion_priors import MOTION_PRIORS

Eyes = Literal["left", "both"]
"""Which pictures of a stereo scope are trained on."""


def check_eyes(eyes: str) -> None:
    """Raises InvalidSetting for something else than the name of a choice."""
    if eyes not in get_args(Eyes):
        raise InvalidSetting(f"eyes is {eyes!r}; choose {' or '.join(get_args(Eyes))}")


MEASURED_WEIGHS, MEASURED_WEIGHS_ONLINE = 10.0, 3.0
"""How many times more depth counts that was measured than depth that was found in pictures, where all frames are known and where they come one after
another. With less of it, colours move Gaussians along the line of sight, which pictures hardly show, by more than a measured depth is off; with more, the
few steps of a frame leave less for its picture."""
MATCHED_WEIGHS = 10.0
"""The same of depth that two eyes were matched by, where all frames are known: it is then a surface (`matched_surface`), which colours make rough."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's rates. Those of positions are in pixels of the training image: they are multiplied by depth / focal length.

    Raises InvalidSetting when a rate is not in 0..10.
    """

    means_px: float = 0.03
    quats: float = 2e-3
    log_scales: float = 5e-3
    logit_opacities: float = 2e-2
    sh: float = 5e-3
    right_share: float = 0.1
    """Of the rate `sh`, for the right eye's own colours. Where depth is not known, that one colour does not fit both pictures is what moves a Gaussian to where it
    belongs: these come after that. Where matched depth holds the Gaussians (`MATCHED_WEIGHS`), they follow at once."""
    field: FieldRates | None = None
    """Rates of the deformation field, of the type that its kind has (`FIELDS[name].rates`); None: the kind's defaults."""

    def __post_init__(self) -> None:
        check_rates({name: rate for name, rate in vars(self).items() if name != "field"})


@dataclass(frozen=True)
class ReconstructorConfig:
    """What a `Reconstructor` learns and how much work it does. Raises InvalidSetting for a value out of its range."""

    field: str = "auto"
    """Deformation field: a name in `gsplat_core.deformation.FIELDS`. `auto` is the better one in `benchmarks/notes/replay.md`."""
    gaussians: int = 30_000
    """Gaussians that the first frame starts with; frames that uncover new tissue add to them."""
    max_gaussians: int = 60_000
    """Bound on Gaussians over the whole stream."""
    sh_degree: int = 0
    """Degree of the view-dependent colour; 0 suits a scope whose light moves with the camera."""
    steps_per_frame: int = 10
    """Optimiser steps that each new frame gets."""
    first_frame_steps: int = 60
    """Steps on the very first frame, from which the model starts."""
    newest_share: float = 0.7
    """Share of the steps that go to the newest frame; the rest goes to the window."""
    window_frames: int = 30
    """Recent frames that are trained on again, so that the model does not forget them."""
    jump_ratio: float = 1.8
    """A new frame whose loss is this many times the usual one shows a jump (a cut between shots, a sudden motion) and gets extra steps."""
    jump_extra: int = 4
    """Extra steps for a jump, in multiples of the frame's own."""
    bump_spacing_s: float = 0.2
    """The shortest time within which motion changes its course: the time between the basis functions of the basis field."""
    squared_error: bool = False
    """Whether colours are compared by the squared error, which PSNR measures, in place of L1."""
    history_s: float | None = None
    """How much of the past stays deformable online, with the basis field; None: all of it, in memory that grows with the stream."""
    preallocate: bool = False
    """Take the memory for `max_gaussians` at once, so that nothing is captured again when Gaussians join or leave."""
    ssim_weight: float = 0.0
    """Weight of 1 - SSIM beside L1 or the squared error, 0..1."""
    depth_weight: float = 0.1
    """Weight of the inverse-depth term, where frames have depth, times the distance at which the scene starts: in any unit of length the same.
    `MEASURED_WEIGHS` times as much where a scene with an end starts from measured depth, `MATCHED_WEIGHS` times where all frames are known and two eyes were
    matched."""
    default_depth_mm: float = 60.0
    """Distance of the plane on which a recording without depth starts."""
    eyes: Eyes = "left"
    """Whether the right eye's pictures are trained on, too, where frames have one and its camera is known."""
    motion_prior: str = "bumps"
    """What is assumed about motion after the newest frame: a name in `MOTION_PRIORS`."""
    motion_detail: Detail = "full"
    """How closely a motion prior looks at pictures; `half` where it has to be quick."""
    start_from_motion: bool = False
    """Whether a motion prior moves the scene to where a new frame shows it, before the first step on that frame."""
    depth_from_motion: bool = False
    """Whether the depth of the scene is found where the camera moves, its poses are given, and no depth is: online by the motion prior,
    offline before training, in key frames (`training/parallax.py`)."""
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)

    def __post_init__(self) -> None:
        kind = FIELDS[self.field]
        if self.rates.field is not None and not isinstance(self.rates.field, type(kind.rates)):
            raise InvalidSetting(
                f"rates.field is {type(self.rates.field).__name__}; a {kind.name} field has {type(kind.rates).__name__}"
            )
        for name in ("gaussians", "max_gaussians", "steps_per_frame", "first_frame_steps", "window_frames"):
            if getattr(self, name) < 1:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be at least 1")
        MOTION_PRIORS.check(self.motion_prior)
        if self.motion_detail not in get_args(Detail):
            raise InvalidSetting(f"motion_detail is {self.motion_detail!r}; choose {' or '.join(get_args(Detail))}")
        check_eyes(self.eyes)
        if not 0 <= self.sh_degree <= 4:
            raise InvalidSetting(f"sh_degree is {self.sh_degree}; it must be 0 to 4")
        if self.max_gaussians < self.gaussians:
            raise InvalidSetting(
                f"max_gaussians is {self.max_gaussians}, below the {self.gaussians} gaussians to start with"
            )
        if self.jump_extra < 0:
            raise InvalidSetting(f"jump_extra is {self.jump_extra}; it must be at least 0")
        for name in ("bump_spacing_s", "default_depth_mm", "jump_ratio"):
            if not 0 < getattr(self, name) < math.inf:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be positive")
        if self.history_s is not None and not 0 < self.history_s < math.inf:
            raise InvalidSetting(
                f"history_s is {self.history_s}; it must be a positive number of seconds, or None for all"
            )
        if not 0 <= self.ssim_weight <= 1:
            raise InvalidSetting(f"ssim_weight is {self.ssim_weight}; it must be between 0 and 1")
        if not 0 <= self.depth_weight < math.inf:
            raise InvalidSetting(f"depth_weight is {self.depth_weight}; it must be at least 0")
        if not 0 < self.newest_share <= 1:
            raise InvalidSetting(f"newest_share is {self.newest_share}; it must be in (0, 1]")

    @classmethod
    def offline(cls, field: str = "auto") -> ReconstructorConfig:
        """The configuration for `Reconstructor.fit`, which has time for more Gaussians and for finer motion than a stream.

        It starts with `gaussians` and ends with `max_gaussians`.
        """
        return cls(
            field=field,
            gaussians=60_000,
            max_gaussians=80_000,
            # The HexPlane's rows in time follow this, too; finer ones were not tried.
            bump_spacing_s=1 / 15 if field == "hexplane" else 0.05,
            squared_error=True,
            depth_from_motion=True,
        )

    def starting_from(self, frame: Frame, all_known: bool) -> ReconstructorConfig:
        """The same for a scene that starts from `frame`. all_known: whether all frames are there. A stream without an end keeps its weights from scene to
        scene, whatever these start from."""
        if frame.depth is None or self.history_s is not None:
            return self
        if frame.depth_origin in (None, DepthOrigin.MEASURED):
            factor = MEASURED_WEIGHS if all_known else MEASURED_WEIGHS_ONLINE
            return dataclasses.replace(self, depth_weight=factor * self.depth_weight)
        if frame.depth_origin is DepthOrigin.STEREO and all_known:
            rates = dataclasses.replace(self.rates, right_share=1.0)
            return dataclasses.replace(self, depth_weight=MATCHED_WEIGHS * self.depth_weight, rates=rates)
        return self

    @property
    def chosen_field(self) -> str:
        """The field's own name: for `auto`, of the field that it stands for."""
        return FIELDS[self.field].name
