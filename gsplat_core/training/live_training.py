"""How the training steps beside a live stream are taken."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.errors import InvalidSetting
from gsplat_core.training.colour_correction import MOST_RELAXATION

REHEARSED_CORRECTION = 0.5
"""Share of `colour_relaxation` in a rehearsal step: what is corrected at one time shows at the times around it, which had their turn."""
DEPTH_EVERY = 4
"""On a GPU every so many-th rehearsal step, of the left eye's, looks at depth where a frame has it, and trains colours in place of correcting them. Steps
of `observe` do not: what they change last is what is shown."""


@dataclass(frozen=True)
class LiveTraining:
    """How the steps beside a live stream are taken. Raises InvalidSetting for a value out of its range."""

    first_rate: float = 2.0
    """Factor of all learning rates in a frame's first step: large steps follow a large motion."""
    last_rate: float = 0.5
    """The factor that they end with: small steps settle."""
    rate_steps: int = 30
    """Steps from the first factor to the last, in equal ratios; a frame that gets more goes on with the last one."""
    recent_share: float = 0.6
    """Share of the rehearsal steps that go to the newest frame; the others are spread evenly over the window."""
    colour_relaxation: float = 0.0
    """Above 0 colours are not trained with a rate but corrected by what the picture is off by, by so many times the mean over the pixels that
    show them (`colour_correction`), where the field takes colours at one time. On a GPU with harmonics of degree 0 only, and depth is looked at by
    some of the rehearsal steps alone (`DEPTH_EVERY`)."""

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
        """The factor of a frame's step, counted from 0."""
        progress = min(1.0, step / max(1, self.rate_steps - 1))
        return self.first_rate * (self.last_rate / self.first_rate) ** progress

    def rehearsed_relaxation(self, number: int, or_depth: bool) -> float:
        """How much colours are corrected in the rehearsal step with this number. or_depth: a step either corrects them or looks at depth, which its frame
        has."""
        looks_at_depth = or_depth and number % DEPTH_EVERY == 0
        return 0.0 if looks_at_depth else REHEARSED_CORRECTION * self.colour_relaxation
