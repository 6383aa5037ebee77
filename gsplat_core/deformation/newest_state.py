"""A scene at its newest time and how it goes on from there: all that a live picture needs, without the past."""

from __future__ import annotations

from gsplat_core.deformation.continuation import Continuation
from gsplat_core.deformation.displacement import displaced
from gsplat_core.deformation.field import DeformationField
from gsplat_core.scene.gaussians import Gaussians


class NewestState(DeformationField):
    """For Gaussians as they are at the newest time: earlier times show that one, later ones its continuation. It is not trained or saved."""

    kind = "newest state"
    continues = True

    def __init__(self, newest_s: float, continuation: Continuation) -> None:
        super().__init__((newest_s, newest_s))
        self.continuation = continuation

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`."""
        assert self.continuation is not None
        added = self.continuation.added(self.clamp_time(time_s), gaussians.count)
        if added is None:
            return gaussians
        return displaced(gaussians, added)
