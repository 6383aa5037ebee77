"""Optional content of synthetic recordings: other scenes, more ground truth, disturbances."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from gsplat_core.errors import InvalidSetting

MOST_SMOKE = 5.0
MOST_NOISE_MM = 20.0
MOST_RATIO = 5.0
MOST_WANDER = 0.5


@dataclass(frozen=True)
class Extras:
    """Optional scene, ground truth and disturbances of a synthetic recording.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    scene: str = "open"
    """`open`: a sheet of tissue with a tool; `colon`: a tube along its axis."""
    third: bool = False
    """Write a third camera's pictures and depth to `views/third/`, for evaluation only."""
    flow: bool = False
    """Write optical flow and scene flow from each frame to the next."""
    tracks: bool = False
    """Write the visibility of each point of `tracks.npy` in each frame."""
    behind: bool = False
    """Write pictures and depth with transparent tools to `behind/`, for evaluation only."""
    smoke: float = 0.0
    """Strength of the smoke; 1 is dense."""
    depth_noise_mm: float = 0.0
    """Standard deviation in mm of the depth noise at a distance of 74 mm.

    It grows with the squared distance. The noise-free depth is written as well.
    """
    exposure_changes: bool = False
    """Let the exposure vary over time."""

    breathing_ratio: float = 1.0
    """Expiration to inspiration ratio of the durations."""
    rate_wander: float = 0.0
    """Largest relative deviation of the breathing rate."""
    scope_path: str = "usual"
    """Path of a moving scope: `usual` is identical for all seeds, `seeded` depends on the seed."""

    def __post_init__(self) -> None:
        if self.scene not in ("open", "colon"):
            raise InvalidSetting(f"scene must be 'open' or 'colon', got {self.scene!r}")
        for name, most in (("smoke", MOST_SMOKE), ("depth_noise_mm", MOST_NOISE_MM)):
            if not 0 <= getattr(self, name) <= most:
                raise InvalidSetting(f"{name} must be from 0 to {most:g}, got {getattr(self, name)}")
        if not 1 / MOST_RATIO <= self.breathing_ratio <= MOST_RATIO:
            raise InvalidSetting(
                f"breathing_ratio must be from {1 / MOST_RATIO:g} to {MOST_RATIO:g}, got {self.breathing_ratio}"
            )
        if not 0 <= self.rate_wander <= MOST_WANDER:
            raise InvalidSetting(f"rate_wander must be from 0 to {MOST_WANDER:g}, got {self.rate_wander}")
        if self.scope_path not in ("usual", "seeded"):
            raise InvalidSetting(f"scope_path must be 'usual' or 'seeded', got {self.scope_path!r}")

    def described(self) -> dict[str, object]:
        """Return the fields for `recording.json`.

        Fields of later versions are omitted at their defaults, so recordings keep their bytes.
        """
        added = ("breathing_ratio", "rate_wander", "scope_path")
        return {
            name: value for name, value in asdict(self).items() if name not in added or value != getattr(CLEAR, name)
        }

    @property
    def changes_pictures(self) -> bool:
        """True if smoke or exposure changes alter the pictures."""
        return self.smoke > 0 or self.exposure_changes


CLEAR = Extras()
"""Extras of a recording without any optional content."""
