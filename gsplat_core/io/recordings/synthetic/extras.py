"""What a synthetic recording can have beyond pictures, masks, depth and poses of the usual scene."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.errors import InvalidSetting

MOST_SMOKE = 5.0
MOST_NOISE_MM = 20.0


@dataclass(frozen=True)
class Extras:
    """Another scene, more ground truth, and what makes a recording harder. Raises InvalidSetting for a value out of its range."""

    scene: str = "open"
    """`open`: a sheet of tissue with a tool; `colon`: a tube along its axis."""
    third: bool = False
    """A third camera's pictures and depth in `views/third/`, for evaluation alone."""
    flow: bool = False
    """Optical flow and scene flow from each frame to the next."""
    tracks: bool = False
    """Which of the points in `tracks.npy` each frame sees."""
    smoke: float = 0.0
    """Strength; 1 is dense."""
    depth_noise_mm: float = 0.0
    """Standard deviation of the depth's noise at 74 mm; it grows with the square of the distance. The true depth is kept beside it."""
    exposure_changes: bool = False
    """Let the exposure go up and down."""

    def __post_init__(self) -> None:
        if self.scene not in ("open", "colon"):
            raise InvalidSetting(f"scene must be 'open' or 'colon', got {self.scene!r}")
        for name, most in (("smoke", MOST_SMOKE), ("depth_noise_mm", MOST_NOISE_MM)):
            if not 0 <= getattr(self, name) <= most:
                raise InvalidSetting(f"{name} must be from 0 to {most:g}, got {getattr(self, name)}")

    @property
    def changes_pictures(self) -> bool:
        """Whether pictures differ from those of the scene in clear air and usual exposure."""
        return self.smoke > 0 or self.exposure_changes


CLEAR = Extras()
"""None of it."""
