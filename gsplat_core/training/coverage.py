"""How much of a frame's tissue a scene leaves uncovered: the question before Gaussians are added."""

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
"""A pixel whose accumulated opacity is below this shows nothing of the model."""
SMALLEST_SHARE = 0.002
"""Uncovered share of the frame from which on Gaussians are added; single pixels between Gaussians close by training."""


def uncovered_pixels(alpha: Tensor, mask: Tensor) -> Tensor:
    """bool [H, W]: tissue, in `mask` [H, W], where the accumulated opacity `alpha` [H, W] shows nothing of the model."""
    return (alpha < UNCOVERED_ALPHA) & (mask > 0)


def are_worth_filling(uncovered: Tensor) -> bool:
    """Whether the uncovered pixels [H, W] are more than gaps between Gaussians. Waits for one number."""
    return HostCopy(torch.count_nonzero(uncovered)).item() >= SMALLEST_SHARE * uncovered.numel()


class CapturedCoverage:
    """Asks a scene on a GPU, frame after frame, whether it leaves much uncovered.

    The scene is copied into a slot and rendered by the graph that is captured for it, which stays valid while the scene grows. That takes a
    tenth of the launches of deforming and rendering the scene where it is.
    """

    def __init__(self, camera: Camera, device: torch.device, rows: int = 0) -> None:
        """`rows`: Gaussians that the scene has room for; 0: a quarter more than it has first."""
        self._slots = SnapshotSlots(device, most=2, rows=rows)  # the renderer holds one while the other is written
        self._renderer = AlphaRenderer(camera, device)

    def leaves_much_uncovered(self, gaussians: Gaussians, field: DeformationField, observation: Observation) -> bool:
        """Whether tissue of the observation is worth filling with Gaussians. Waits for the device."""
        snapshot = self._slots.publish(
            gaussians, field, version=1, camera=observation.camera, time_window_s=field.time_window_s
        )
        self._renderer.prepare(snapshot)
        alpha = self._renderer.render(observation.camera, observation.time_s, outputs=["alpha"]).result().alpha
        return are_worth_filling(uncovered_pixels(alpha, observation.mask))
