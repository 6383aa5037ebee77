"""How far away each pixel of a picture is, and how far that is to be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import DepthOrigin

BELIEVED = 0.5
"""Confidence from which a depth is used where it can only be used or left out."""
POSSIBLE = 0.03
"""Confidence from which a matched depth is rather started from than a guess by what lies around it."""


@dataclass(frozen=True)
class DepthMap:
    """What an estimator found for one picture. Raises InvalidInput for planes of other types, or that do not fit together."""

    depth: NDArray[np.float32]
    """z [H, W]; 0 = unknown. Millimetres where `metric`."""
    confidence: NDArray[np.float32]
    """[H, W], 0 to 1: how probable it is that the depth is right; 0 where it is unknown."""
    origin: DepthOrigin
    metric: bool
    """Whether the unit is known; otherwise depth is relative, right up to one factor."""
    doubt: str | None = None
    """What speaks against the whole of it, in a sentence; the confidence is 0 everywhere then."""

    remark: str | None = None
    """What whoever uses it should know, in a sentence. Like `doubt` it says the same up to its first colon, whatever the numbers behind it."""

    def __post_init__(self) -> None:
        for name in ("depth", "confidence"):
            plane = getattr(self, name)
            if plane.ndim != 2 or plane.dtype != np.float32 or plane.shape != self.depth.shape:
                raise InvalidInput(
                    f"{name} must be float32 {list(self.depth.shape)}, got {plane.dtype} {list(plane.shape)}"
                )
        if self.doubt is not None and np.any(self.confidence):
            raise InvalidInput("a depth that is doubted as a whole must have no confidence anywhere")

    @property
    def believed(self) -> NDArray[np.float32]:
        """The depth where it is believed, 0 everywhere else."""
        return np.where(self.confidence >= BELIEVED, self.depth, np.float32(0))

    @property
    def kept(self) -> NDArray[np.float32]:
        """The depth that a frame goes on with beside its confidence, 0 elsewhere: where it is believed, and of two eyes where it is possible."""
        least = POSSIBLE if self.origin is DepthOrigin.STEREO else BELIEVED
        return np.where(self.confidence >= least, self.depth, np.float32(0))


def doubted(shape: tuple[int, int], origin: DepthOrigin, doubt: str) -> DepthMap:
    """No depth at all [H, W], and why."""
    nothing = np.zeros(shape, np.float32)
    return DepthMap(nothing, nothing, origin, metric=False, doubt=doubt)
