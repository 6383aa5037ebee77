"""Settings of the reconstructor: model size, learning rates, losses and frame selection."""

from __future__ import annotations

import dataclasses
import math
import numbers
from dataclasses import dataclass
from typing import get_args

from gsplat_core.choices import FIELDS, MOTION_PRIORS, RENDERERS, STRATEGIES, Eyes, check_losses, check_strategy
from gsplat_core.deformation.kinds import FieldRates, check_rates
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import RELATIVE_DISTANCE, Frame
from gsplat_core.training.image_motion import Detail
from gsplat_core.training.losses import loss_weights


def check_eyes(eyes: str) -> None:
    """Check the name of an eye selection.

    Raises:
        InvalidSetting: for an unknown name.
    """
    if eyes not in get_args(Eyes):
        raise InvalidSetting(f"eyes is {eyes!r}; choose {' or '.join(get_args(Eyes))}")


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam. Those of positions are in pixels of the training image and are
    multiplied by depth / focal length.

    Raises:
        InvalidSetting: for a rate outside 0 to 10.
    """

    means_px: float = 0.03
    quats: float = 2e-3
    log_scales: float = 5e-3
    logit_opacities: float = 2e-2
    sh: float = 5e-3
    right_share: float = 0.1
    """Factor of the rate `sh` for the right eye's own colours. Without depth, only the colour difference between the
    eyes moves Gaussians to the right depth. The right eye's colours must therefore adapt slowly, so that they do not
    absorb that difference. A scene that starts from stereo depth offline uses 1.
    """
    field: FieldRates | None = None
    """Rates of the deformation field, of type `FIELDS[name].rates`; None for its defaults."""

    def __post_init__(self) -> None:
        check_rates({name: rate for name, rate in vars(self).items() if name != "field"})

    @classmethod
    def offline(cls, field: FieldRates | None = None) -> LearningRates:
        """Return the rates for `Reconstructor.fit`, which lowers them towards the end of training.

        The Gaussians' own rates are twice as high as for a stream, which keeps them constant.
        """
        return cls(means_px=0.06, quats=4e-3, log_scales=1e-2, logit_opacities=4e-2, sh=1e-2, field=field)


@dataclass(frozen=True)
class ReconstructorConfig:
    """Settings of a `Reconstructor`.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    field: str = "auto"
    """Deformation field: a name in `gsplat_core.deformation.FIELDS`. `auto` is the better one in
    `benchmarks/results/replay.md`.
    """
    gaussians: int = 30_000
    """Number of Gaussians created from the first frame; frames that uncover new tissue add more."""
    max_gaussians: int = 60_000
    """Largest number of Gaussians over the whole stream."""
    sh_degree: int = 0
    """Degree of the view-dependent colour. 0 suits a scope whose light moves with the camera."""
    steps_per_frame: int = 10
    """Optimiser steps for each new frame."""
    first_frame_steps: int = 60
    """Optimiser steps for the first frame of a scene."""
    window_frames: int = 30
    """Number of recent frames that are trained on again to prevent forgetting."""
    motion_spacing_s: float = 0.2
    """Temporal resolution of motion: shortest time in seconds in which its direction or speed can change."""
    squared_error: bool = False
    """Compare colours by squared error, which PSNR measures, instead of L1."""
    history_s: float | None = None
    """Length of the past in seconds that stays deformable online. None keeps all of it. The memory of some fields then
    grows with the stream.
    """
    preallocate: bool = False
    """Allocate memory for `max_gaussians` at the start, so that CUDA graphs stay valid when
    Gaussians are added or removed.
    """
    ssim_weight: float = 0.0
    """Weight of 1 - SSIM relative to L1 or squared error, 0 to 1."""
    depth_weight: float = 0.1
    """Weight of the inverse-depth loss of frames with depth, multiplied by the scene's initial distance so that it does
    not depend on the unit, and by a factor of the depth's origin (`DEPTH_ORIGINS`).
    """
    renderer: str = "alpha"
    """Renderer that trains the scene: a name in `RENDERERS`. The pictures of a renderer without gradients are trained
    by alpha blending.
    """
    strategy: str = "streaming"
    """Change of the Gaussians between offline training steps: a name in `STRATEGIES`."""
    losses: tuple[str, ...] = ()
    """Losses added to those of colours and depth: names in `LOSSES`, each optionally followed by a colon and its
    weight. On a GPU, a step with losses other than `RayLoss` is not captured as a CUDA graph and therefore slower.
    """
    default_depth_mm: float = RELATIVE_DISTANCE
    """Distance of the plane on which a scene without depth starts, in millimetres."""
    eyes: Eyes = "left"
    """Eyes trained on: `left`, or `both` for frames with a calibrated right eye."""
    motion_prior: str = "bumps"
    """Prediction of motion after the newest frame: a name in `MOTION_PRIORS`."""
    motion_detail: Detail = "full"
    """Resolution at which a motion prior processes pictures; `half` is faster."""
    start_from_motion: bool = False
    """True to move the scene by the motion prior to the time of a new frame before the first step on the frame."""
    depth_from_motion: bool = False
    """Estimate the scene's depth online from camera motion by the motion prior, if poses but no depth are given."""
    depth_of_recording: str | None = None
    """Estimator of depth from all frames before training on a complete recording: a name in `DEPTHS` whose class has
    `of_recording`. None uses the frames' own depth only.
    """
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)

    def __post_init__(self) -> None:
        kind = FIELDS[self.field]
        if self.rates.field is not None and not isinstance(self.rates.field, type(kind.rates)):
            raise InvalidSetting(
                f"rates.field is {type(self.rates.field).__name__}; a {kind.name} field has {type(kind.rates).__name__}"
            )
        for name in ("gaussians", "max_gaussians", "steps_per_frame", "first_frame_steps", "window_frames"):
            value = getattr(self, name)
            if not isinstance(value, numbers.Integral) or value < 1:
                raise InvalidSetting(f"{name} is {value!r}; it must be a whole number of at least 1")
        MOTION_PRIORS.check(self.motion_prior)
        RENDERERS.check(self.renderer)
        STRATEGIES.check(self.strategy)
        loss_weights(self.losses)
        check_losses(self.renderer, self.losses)
        check_strategy(self.renderer, self.strategy)
        if self.motion_detail not in get_args(Detail):
            raise InvalidSetting(f"motion_detail is {self.motion_detail!r}; choose {' or '.join(get_args(Detail))}")
        check_eyes(self.eyes)
        if not 0 <= self.sh_degree <= 4:
            raise InvalidSetting(f"sh_degree is {self.sh_degree}; it must be 0 to 4")
        if self.max_gaussians < self.gaussians:
            raise InvalidSetting(
                f"max_gaussians is {self.max_gaussians}, below the {self.gaussians} gaussians to start with"
            )
        for name in ("motion_spacing_s", "default_depth_mm"):
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

    @classmethod
    def offline(cls, field: str = "auto") -> ReconstructorConfig:
        """Return the configuration for `Reconstructor.fit`, with more Gaussians and finer motion than for a stream.

        Training starts with `gaussians` and ends with `max_gaussians` Gaussians.
        """
        return cls(
            field=field,
            gaussians=60_000,
            max_gaussians=80_000,
            motion_spacing_s=FIELDS[field].offline_spacing_s,
            squared_error=True,
            depth_of_recording="parallax",
            rates=LearningRates.offline(FIELDS[field].offline_rates),
        )

    def starting_from(self, frame: Frame, all_known: bool) -> ReconstructorConfig:
        """Return the settings for a scene that starts from `frame`, with weights that depend on its depth source.

        Streams with a limited `history_s` keep their weights for all scenes.

        Args:
            frame: first frame of the scene.
            all_known: True offline, where all frames are available.
        """
        origin = frame.depth_origin
        if frame.depth is None or origin is None or self.history_s is not None:
            return self
        factor = origin.loss_weight_offline if all_known else origin.loss_weight_online
        share = origin.right_share_offline if all_known else None
        rates = self.rates if share is None else dataclasses.replace(self.rates, right_share=share)
        return dataclasses.replace(self, depth_weight=factor * self.depth_weight, rates=rates)

    @property
    def chosen_field(self) -> str:
        """Name of the field, with `auto` resolved."""
        return FIELDS[self.field].name
