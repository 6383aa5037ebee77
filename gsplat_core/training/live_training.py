"""Settings of training steps during a live stream."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.errors import InvalidSetting
from gsplat_core.training.colour_correction import MOST_RELAXATION

REHEARSED_CORRECTION = 0.5
"""Share of `colour_relaxation` in rehearsal steps. A correction at one time also affects
neighbouring times, which are corrected themselves.
"""
DEPTH_EVERY = 4
"""On a GPU, every n-th rehearsal step compares depth if its frame has it, and trains colours
instead of correcting them. The right eye has odd numbers, so these steps are on the left eye. Steps
of `observe` never compare depth, because their last changes are displayed.
"""


@dataclass(frozen=True)
class LiveTraining:
    """Settings of training steps during a live stream.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    first_rate: float = 2.0
    """Factor of all learning rates in a frame's first step; large steps follow large motion."""
    last_rate: float = 0.5
    """Factor of all learning rates at the end; small steps converge."""
    rate_steps: int = 30
    """Number of steps from the first to the last factor in equal ratios; further steps use the last
    factor.
    """
    recent_share: float = 0.6
    """Share of the rehearsal steps on the newest frame; the others are spread evenly over the
    window.
    """
    colour_relaxation: float = 0.0
    """Above 0, colours are corrected by this multiple of the mean residual (`colour_correction`)
    instead of trained with a learning rate, if the field has temporal colours. On a GPU this
    requires spherical harmonics of degree 0, and depth is compared only in some rehearsal steps
    (`DEPTH_EVERY`).
    """

    def __post_init__(self) -> None:
        for name in ("first_rate", "last_rate"):
            if not 0 < getattr(self, name) <= 100:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be in (0, 100]")
        if self.rate_steps < 1:
            raise InvalidSetting(f"rate_steps is {self.rate_steps}; it must be at least 1")
        if not 0 <= self.recent_share <= 1:
            raise InvalidSetting(f"recent_share is {self.recent_share}; it must be between 0 and 1")
        if not 0 <= self.colour_relaxation < MOST_RELAXATION:
            raise InvalidSetting(
                f"colour_relaxation is {self.colour_relaxation}; it must be at least 0 and below {MOST_RELAXATION:g}"
            )

    def rate_at(self, step: int) -> float:
        """Return the factor of the learning rates in a frame's step, counted from 0."""
        progress = min(1.0, step / max(1, self.rate_steps - 1))
        return self.first_rate * (self.last_rate / self.first_rate) ** progress

    def rehearsed_relaxation(self, number: int, or_depth: bool) -> float:
        """Return the colour relaxation of a rehearsal step. `or_depth` is True if its frame has
        depth and a step cannot correct colours and compare depth at once.
        """
        looks_at_depth = or_depth and number % DEPTH_EVERY == 0
        return 0.0 if looks_at_depth else REHEARSED_CORRECTION * self.colour_relaxation
