"""Detection of tissue that a scene does not cover, before Gaussians are added."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.snapshots import SnapshotSlots
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy

UNCOVERED_ALPHA = 0.5
"""Accumulated opacity below which a pixel counts as uncovered."""
SMALLEST_SHARE = 0.002
"""Uncovered share of the frame from which Gaussians are added; training closes single-pixel gaps.
"""


def uncovered_pixels(alpha: Tensor, mask: Tensor) -> Tensor:
    """Return tissue pixels, bool [H, W], whose accumulated opacity is below `UNCOVERED_ALPHA`.

    Args:
        alpha: accumulated opacity [H, W].
        mask: [H, W], non-zero on tissue.
    """
    return (alpha < UNCOVERED_ALPHA) & (mask > 0)


def are_worth_filling(uncovered: Tensor) -> bool:
    """Return True if the uncovered pixels [H, W] are more than single gaps. Synchronises with the
    device.
    """
    return HostCopy(torch.count_nonzero(uncovered)).item() >= SMALLEST_SHARE * uncovered.numel()


class CapturedCoverage:
    """Coverage test of a scene on a GPU by a captured graph.

    The scene is copied to a slot and rendered by a CUDA graph that stays valid while the scene
    grows. This takes a tenth of the launches of deforming and rendering the scene directly.
    """

    def __init__(self, camera: Camera, device: torch.device, rows: int = 0) -> None:
        """Prepare the test for at most `rows` Gaussians; 0 for a quarter more than the scene's
        first size.
        """
        self._slots = SnapshotSlots(device, most=2, rows=rows)  # the renderer holds one while the other is written
        self._renderer = AlphaRenderer(camera, device)

    def leaves_much_uncovered(self, gaussians: Gaussians, field: DeformationField, observation: Observation) -> bool:
        """Return True if uncovered tissue of the observation should be filled with Gaussians.
        Synchronises with the device.
        """
        snapshot = self._slots.publish(
            gaussians, field, version=1, camera=observation.camera, time_window_s=field.time_window_s
        )
        self._renderer.prepare(snapshot)
        alpha = self._renderer.render(observation.camera, observation.time_s, outputs=["alpha"]).result().alpha
        return are_worth_filling(uncovered_pixels(alpha, observation.mask))
