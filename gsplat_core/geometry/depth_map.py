"""Depth maps with confidence, as depth estimators return them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import DepthOrigin

BELIEVED = 0.5
"""Confidence from which a depth is used where it can only be used or rejected."""
POSSIBLE = 0.03
"""Confidence from which a stereo depth is a better start value than one extrapolated from its
neighbourhood.
"""


@dataclass(frozen=True)
class DepthMap:
    """Depth estimated for one picture.

    Raises:
        InvalidInput: for planes that are not float32 [H, W] of one shape, or a rejected map with
            non-zero confidence.
    """

    depth: NDArray[np.float32]
    """Depth along the optical axis, float32 [H, W]; 0 = unknown. In millimetres if `metric`."""
    confidence: NDArray[np.float32]
    """Probability that the depth is right, float32 [H, W], 0 to 1; 0 where the depth is unknown."""
    origin: DepthOrigin
    metric: bool
    """True if the depth is in millimetres; otherwise it is known up to one factor."""
    doubt: str | None = None
    """Reason why the whole map is rejected, as a sentence, or None. A rejected map has zero
    confidence everywhere.
    """

    remark: str | None = None
    """Information for the user about the whole map, as a sentence, or None. Like `doubt`, its text
    up to the first colon does not depend on numbers, so repeated messages can be recognised.
    """

    def __post_init__(self) -> None:
        for name in ("depth", "confidence"):
            plane = getattr(self, name)
            if plane.ndim != 2 or plane.dtype != np.float32 or plane.shape != self.depth.shape:
                raise InvalidInput(
                    f"{name} must be float32 {list(self.depth.shape)}, got {plane.dtype} {list(plane.shape)}"
                )
        if self.doubt is not None and np.any(self.confidence):
            raise InvalidInput("a depth map with a doubt must have confidence 0 everywhere")

    @property
    def believed(self) -> NDArray[np.float32]:
        """Depth where its confidence is at least `BELIEVED`, 0 elsewhere."""
        return np.where(self.confidence >= BELIEVED, self.depth, np.float32(0))

    @property
    def kept(self) -> NDArray[np.float32]:
        """Depth that is stored with the frame, 0 elsewhere: confident depth, for stereo also depth
        of at least `POSSIBLE` confidence.
        """
        least = POSSIBLE if self.origin is DepthOrigin.STEREO else BELIEVED
        return np.where(self.confidence >= least, self.depth, np.float32(0))


def doubted(shape: tuple[int, int], origin: DepthOrigin, doubt: str) -> DepthMap:
    """Return a rejected depth map [H, W] without depth, with the reason."""
    nothing = np.zeros(shape, np.float32)
    return DepthMap(nothing, nothing, origin, metric=False, doubt=doubt)
