"""Rendering of whole frames on an NVIDIA GPU as one CUDA graph without host synchronisation.

The graph deforms, projects, bins, sorts and blends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from gsplat_core.deformation import DeformationField
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.frame.frame import Frame, View, render_frame
from gsplat_core.ops.scalars.scalars import store_scalars_
from gsplat_core.rendering.capture import CapturedSequence, GraphMemory
from gsplat_core.rendering.rasterization import RenderOutput
from gsplat_core.rendering.renderer import Precision, check_background, check_camera
from gsplat_core.rendering.tile_capacity import FrameStatusCopy, TileListCapacity
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians


class FrameControls:
    """Per-frame inputs of a captured graph in one device buffer.

    These are pose, intrinsics, the field's time and, for training, the learning rates.
    """

    def __init__(self, device: torch.device, rates: int = 0) -> None:
        self._values = torch.zeros(26 + rates, device=device)
        self.viewmat = self._values[:16].view(4, 4)
        self.intrinsics = self._values[16:25].view(3, 3)
        self.time = self._values[25:26]
        self.rates = self._values[26:]

    def set(self, camera: Camera, time: float, rates: Sequence[float] = ()) -> None:
        """Enqueue new values as arguments of one launch, so no host memory must stay unchanged."""
        values = [*camera.world_to_camera.ravel().tolist(), *camera.K.ravel().tolist(), time, *rates]
        store_scalars_(self._values, values)


@dataclass(frozen=True)
class LaunchedFrame:
    """Launched frame; `result` renders it again with more capacity if its tile lists overflowed."""

    _renderer: FrameRenderer
    _number: int

    def result(self) -> RenderOutput:
        """Wait for the frame and return its outputs, which the next `render` overwrites.

        Raises:
            InvalidInput: if another frame has been rendered since.
        """
        return self._renderer._finish(self._number)


class FrameRenderer:
    """Repeated renderer of one set of Gaussians with changing camera, time and parameters.

    The number of Gaussians is fixed. `render` enqueues a frame and returns without waiting for the
    device. Tile lists have a fixed capacity. A frame that exceeds it reports the overflow in its
    status, and `LaunchedFrame.result` renders it again with a larger capacity. No finished picture
    lacks a splat.

    Tensors of the Gaussians and the field are read in place, so in-place changes affect the next
    frame. Exceptions are values computed at construction: half-precision spherical harmonics and
    the features precomputed by a HexPlane field. With `recompute` they are computed in every frame.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        field: DeformationField | None = None,
        *,
        background: Tensor | None = None,
        precision: Precision = "fp32",
        recompute: bool = False,
    ) -> None:
        """Create a renderer and capture its graph.

        With precision "fp16", SH coefficients, field and blending use half precision. The picture
        is nearly exact (PSNR in `benchmarks/notes/renderer.md`) and faster. `camera` determines
        size and camera model of every frame, and the pose of those rendered without a camera.

        Raises:
            InvalidInput: if the Gaussians are not float32 on a CUDA device, or the precision is
                unknown.
        """
        if precision not in get_args(Precision):
            raise InvalidInput(f"unknown precision {precision!r}; choose {' or '.join(get_args(Precision))}")
        if gaussians.device.type != "cuda" or gaussians.dtype != torch.float32:
            raise InvalidInput(
                f"FrameRenderer needs float32 Gaussians on a CUDA device, got {gaussians.dtype} on {gaussians.device};"
                " gsplat_core.render takes those of the CPU"
            )
        check_background(background)
        self.gaussians = gaussians.detach()
        self.field = field
        self.capacity = TileListCapacity.initial(gaussians.count, camera.width_px, camera.height_px)
        """Capacity of the tile lists; may be replaced between frames."""
        self._camera = camera
        self._background = background
        self._dtype = torch.float32 if precision == "fp32" else torch.float16
        self._recompute = recompute
        self._sh = self.gaussians.sh.to(self._dtype)
        self._deltas = self._field_deltas()
        self._controls = FrameControls(gaussians.device)
        self._status = FrameStatusCopy()
        self._memory = GraphMemory(gaussians.device)
        self._number = 0
        self._asked: tuple[Camera, float] | None = None
        self._captured: CapturedSequence[Frame] | None = None
        self._captured_capacity = self.capacity

    def render(self, camera: Camera | None = None, time_s: float = 0.0) -> LaunchedFrame:
        """Enqueue the picture of `camera` at `time_s` on the current stream."""
        camera = camera or self._camera
        check_camera(self._camera, camera)
        self._number += 1
        self._asked = camera, 0.0 if self.field is None else self.field.frame_time(time_s)
        self._launch()
        return LaunchedFrame(self, self._number)

    def _field_deltas(self) -> Callable[[Tensor], Tensor] | None:
        return None if self.field is None else self.field.frame_deltas(self.gaussians, self._dtype)

    def _launch(self) -> None:
        assert self._asked is not None
        self._controls.set(*self._asked)
        if self._captured is None or self._captured_capacity != self.capacity:
            self._captured = None  # frees its memory for the next capture
            self._captured = CapturedSequence(self._sequence, self.gaussians.device, self._memory, warm_up=True)
            self._captured_capacity = self.capacity
        self._captured.replay()
        self._status.launched(self.gaussians.device)

    def _sequence(self) -> Frame:
        sh, field_deltas = self._sh, self._deltas
        if self._recompute:
            sh, field_deltas = self.gaussians.sh.to(self._dtype), self._field_deltas()
        deltas = None if field_deltas is None else field_deltas(self._controls.time)
        scene, camera, controls = self.gaussians, self._camera, self._controls
        gaussians = scene.means, scene.quats, scene.log_scales, scene.logit_opacities, sh
        view = View(
            controls.viewmat, controls.intrinsics, camera.width_px, camera.height_px, self._background, camera.model
        )
        frame = render_frame(gaussians, deltas, view, self.capacity.capacity, self.capacity.mode)
        self._status.queue(frame.status)
        return frame

    def _finish(self, number: int) -> RenderOutput:
        if number != self._number:
            raise InvalidInput(
                "a later frame was rendered into this frame's memory; take result() before the next render()"
            )
        while (needs := self._status.wait()).overflowed:
            self.capacity = TileListCapacity.for_frame(needs.instances, needs.most_in_tile)
            self._launch()
        assert self._captured is not None
        frame = self._captured.results
        return RenderOutput(frame.image[..., :3], frame.alphas, frame.image[..., 3])
