"""Origins of depth and their properties.

`DEPTH_ORIGINS` is the only place that states how depth of an origin may be used. An estimator names its origin; all
other code reads the properties.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsplat_core.registry import Registry

BELIEVED = 0.5
"""Confidence from which a depth is used, in steps that either use or reject it."""


@dataclass(frozen=True)
class DepthOrigin:
    """Origin of depth, with the uses that its accuracy permits. The defaults suit an estimator without a known scale."""

    name: str
    """Name in files and reports."""
    relative_error: float
    """Assumed relative standard error, in addition to the errors visible in a model."""
    scale: Literal["metric", "calibrated", "relative"] = "relative"
    """`metric`: in millimetres. `calibrated`: in millimetres if the frame's right camera is known. `relative`: known up to
    one factor.
    """
    is_recorded: bool = False
    """True for depth supplied with a frame, False for depth estimated from pictures."""
    initialises_only: bool = False
    """True if the depth places a new scene, but is neither trained on nor used to correct the scene. For estimators
    whose scale changes from frame to frame.
    """
    is_of_still_tissue: bool = False
    """True if the depth assumes static tissue. It then corrects the scene at all times, otherwise only at its frame's
    time.
    """
    loss_weight_online: float = 1.0
    """Factor of `ReconstructorConfig.depth_weight` in training frame by frame, for a scene that starts from this depth."""
    loss_weight_offline: float = 1.0
    """Factor of `ReconstructorConfig.depth_weight` in training on a complete recording that starts from this depth."""
    right_share_offline: float | None = None
    """`LearningRates.right_share` in training on a complete recording. None keeps the setting, which lets colour
    differences between the eyes move Gaussians.
    """
    least_confidence: float = BELIEVED
    """Smallest confidence at which the depth is a better start value of new Gaussians than an extrapolation of its
    surroundings.
    """
    edge_margin_px: int = 0
    """Margin around unknown pixels within which the depth is not trained on. Half of it applies to start values."""
    tool_margin_px: int = 0
    """Margin around tools within which the depth may belong to the tool."""
    surface: str | None = None
    """Import path of a function (frame, camera) -> frame, called before training on a complete recording. The function
    replaces the depth by a smooth surface. None to keep the depth.
    """

    def is_metric(self, eyes_calibrated: bool) -> bool:
        """Return True if depth of this origin is in millimetres."""
        return self.scale == "metric" or (self.scale == "calibrated" and eyes_calibrated)


# The loss weights of measured depth are a compromise. With lower values, colour errors move Gaussians along the line of
# sight by more than the depth's error. Higher values leave less of a frame's few steps to its picture. Offline, colour
# errors would also roughen the surface fitted to stereo depth.
MEASURED = DepthOrigin(
    "measured", 0.005, "metric", is_recorded=True, loss_weight_online=3.0, loss_weight_offline=10.0
)  # fmt: skip
STEREO = DepthOrigin(
    "stereo", 0.0125, "calibrated", loss_weight_offline=10.0, right_share_offline=1.0, least_confidence=0.03,
    edge_margin_px=2, tool_margin_px=4, surface="gsplat_core.depth.plane_fits:with_matched_surface",
)  # fmt: skip
PARALLAX = DepthOrigin("parallax", 0.05, is_of_still_tissue=True)
LIGHT = DepthOrigin("light", 0.15, initialises_only=True)
LEARNED = DepthOrigin("learned", 0.2, initialises_only=True)

DEPTH_ORIGINS: Registry[DepthOrigin] = Registry(
    "depth origin", {origin.name: origin for origin in (MEASURED, STEREO, PARALLAX, LIGHT, LEARNED)}
)
"""Depth origins, in this order: sensor or recording; matching between the eyes; matching across times, in the unit of
the poses; shading of the scope's light; prediction of a network.
"""
RELATIVE_DISTANCE = 60.0
"""Mean distance of depth whose scale is unknown, in arbitrary units."""
UNKNOWN_ERROR = 0.3
"""Assumed relative standard error of the depth of a model that was trained without depth."""
