"""Depth correction of a scene on a GPU as a CUDA graph. A live stream has no time for its hundred
separate launches.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.deformation.basis import BasisField
from gsplat_core.ops.frame.frame import STATUS_OVERFLOW, FrameMode, View, render_frame
from gsplat_core.rendering.capture import CapturedSequence, GraphMemory
from gsplat_core.rendering.frame_renderer import FrameControls
from gsplat_core.rendering.tile_capacity import FrameStatusCopy, capacity_for
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import BASIS_CHANNELS, POSITION
from gsplat_core.training.coverage import UNCOVERED_ALPHA
from gsplat_core.training.depth_correction import move_along_rays_, smooth_factor
from gsplat_core.training.observations import Observation
from gsplat_core.training.surface_motion import NEAREST


class CapturedCorrection:
    """Depth correction of `Placement` at one time, captured for a scene whose tensors keep their
    addresses.

    A frame that overflows the tile lists corrects nothing; the lists are enlarged for the next one.
    """

    def __init__(self, rows: Gaussians, field: BasisField, camera: Camera) -> None:
        """Prepare the correction.

        Args:
            rows: the scene's tensors with all allocated rows.
            field: the scene's motion.
            camera: camera with the size of every frame.
        """
        device, shape = rows.device, (camera.height_px, camera.width_px)
        self._rows, self._field, self._weights, self._camera = rows, field, field.weights, camera
        self._controls = FrameControls(device, rates=1)
        self._depth = torch.zeros(shape, device=device)
        self._mask = torch.zeros(shape, dtype=torch.uint8, device=device)
        self._status = FrameStatusCopy()
        self._memory = GraphMemory(device)
        self._capacity = capacity_for(4 * rows.count)
        self._captured: CapturedSequence[None] | None = None

    def fits(self, rows: Gaussians, field: BasisField, camera: Camera) -> bool:
        """Return True if the graph fits these tensors and this size."""
        same_scene = rows is self._rows and field is self._field and field.weights is self._weights
        size = self._camera.width_px, self._camera.height_px
        return same_scene and size == (camera.width_px, camera.height_px)

    def __call__(self, observation: Observation, depth: Tensor, shown_s: float) -> None:
        """Queue the correction for an observation.

        Args:
            observation: camera, time and mask of the frame.
            depth: float32 [H, W], 0 = unknown.
            shown_s: time in seconds at which the scene is changed.
        """
        if (needs := self._status.wait()).overflowed:
            self._capacity, self._captured = capacity_for(needs.instances), None
        self._depth.copy_(depth)
        self._mask.copy_(observation.mask)
        field = self._field
        self._controls.set(observation.camera, field.frame_time(observation.time_s), [field.frame_time(shown_s)])
        with torch.no_grad():
            if self._captured is None:
                self._correct()
                self._captured = CapturedSequence(self._correct, self._depth.device, self._memory, warm_up=False)
            else:
                self._captured.replay()
        self._status.launched(self._depth.device)

    def _correct(self) -> None:
        scene, controls, camera = self._rows, self._controls, self._camera
        deltas_at = self._field.frame_deltas(scene)
        seen = deltas_at(controls.time)
        view = View(controls.viewmat, controls.intrinsics, camera.width_px, camera.height_px)
        frame = render_frame(scene.left_tensors, seen, view, self._capacity, FrameMode.SHARED)
        self._status.queue(frame.status)
        known = (self._depth > 0) & (self._mask > 0) & (frame.alphas >= UNCOVERED_ALPHA)
        known &= frame.status[STATUS_OVERFLOW] == 0
        # `Seen` does the same but copies the camera from the host, which cannot be captured.
        rotation, translation = controls.viewmat[:3, :3], controls.viewmat[:3, 3]
        local = ((scene.means + seen[:, POSITION])[:, None, :] * rotation).sum(2) + translation
        focal, middle = controls.intrinsics.diagonal()[:2], controls.intrinsics[:2, 2]
        pixels = local[:, :2] / local[:, 2:].clamp(min=NEAREST) * focal + middle
        factor = smooth_factor(self._depth, frame.image[..., 3], known, pixels)
        factor = torch.where(scene.logit_opacities.isfinite(), factor, 1.0)  # unused rows keep their values
        moved = deltas_at(controls.rates)[:, :BASIS_CHANNELS].contiguous()
        move_along_rays_(moved, scene.means, factor, -(rotation * translation[:, None]).sum(0))
        self._field.move_to_at(controls.rates, moved)
