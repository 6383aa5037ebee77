"""Whole frames on an NVIDIA GPU without a wait of the host: deform, project, sort and blend as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.deformation import DeformationField
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.frame.frame import Frame, FrameMode, View, render_frame
from gsplat_core.ops.scalars.scalars import store_scalars_
from gsplat_core.rendering.capture import CapturedSequence, GraphMemory
from gsplat_core.rendering.rasterization import RenderOutput
from gsplat_core.rendering.tile_capacity import ListRoom, StatusOnHost
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

Precision = Literal["fp32", "fp16"]


class FrameControls:
    """What changes from frame to frame, in one piece of device memory: pose, intrinsics, the field's time, and learning rates where
    the frame is trained on."""

    def __init__(self, device: torch.device, rates: int = 0) -> None:
        self._values = torch.zeros(26 + rates, device=device)
        self.viewmat = self._values[:16].view(4, 4)
        self.intrinsics = self._values[16:25].view(3, 3)
        self.time = self._values[25:26]
        self.rates = self._values[26:]

    def set(self, camera: Camera, time: float, rates: Sequence[float] = ()) -> None:
        """One launch, with the values in its arguments: nothing is copied from memory that could change meanwhile."""
        values = [*camera.world_to_camera.ravel().tolist(), *camera.K.ravel().tolist(), time, *rates]
        store_scalars_(self._values, values)


@dataclass(frozen=True)
class PendingFrame:
    """A frame that was launched. `result` gives its picture, rendered again with more room if the lists were too short."""

    _renderer: FrameRenderer
    _number: int

    def result(self) -> RenderOutput:
        """Waits for the frame. The tensors are the renderer's own and hold until its next `render`.

        Raises InvalidInput when another frame was rendered since.
        """
        return self._renderer._finish(self._number)


class FrameRenderer:
    """Renders one set of Gaussians again and again: new camera, new time, changed parameters, same number.

    `render` queues a frame and returns at once; nothing in it waits for the device. The lists of splats per tile have a fixed size; a
    frame that does not fit is noticed on the device and rendered again with more room by `PendingFrame.result`, so no splat is ever left
    out of a finished picture.

    The Gaussians' tensors and the field's parameters are used where they are: changed in place, they change the next frame. Not so in half
    precision, which keeps what it rounds: the harmonics and what a field computes ahead.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        field: DeformationField | None = None,
        *,
        background: Tensor | None = None,
        precision: Precision = "fp32",
    ) -> None:
        """`camera` gives size and camera model of every frame, and the pose of those rendered without one.

        With `precision` "fp16" the harmonics are kept, the field deforms and splats are blended in half precision: a near-exact picture
        (`benchmarks/RESULTS.md` has its PSNR to the exact one) in less time.

        Raises InvalidInput when the Gaussians are not float32 on a CUDA device, or the precision is another one.
        """
        if precision not in get_args(Precision):
            raise InvalidInput(f"unknown precision {precision!r}; choose {' or '.join(get_args(Precision))}")
        if gaussians.device.type != "cuda" or gaussians.dtype != torch.float32:
            raise InvalidInput(
                f"FrameRenderer needs float32 Gaussians on a CUDA device, got {gaussians.dtype} on {gaussians.device};"
                " gsplat_core.render takes those of the CPU"
            )
        if background is not None:
            require_shape("background", background, (3,), "[3]")
        self.gaussians = gaussians.detach()
        self.field = field
        self._camera = camera
        self._background = background
        kept = torch.float32 if precision == "fp32" else torch.float16
        self._sh = self.gaussians.sh.to(kept)
        self._deltas: Callable[[Tensor], Tensor] | None = (
            None if field is None else field.frame_deltas(self.gaussians, kept)
        )
        self._controls = FrameControls(gaussians.device)
        self._status = StatusOnHost()
        self._memory = GraphMemory(gaussians.device)
        self._number = 0
        self._asked: tuple[Camera, float] | None = None
        self._room = ListRoom.at_first(gaussians.count, camera.width_px, camera.height_px)
        self._captured: CapturedSequence[Frame] | None = None

    @property
    def room(self) -> ListRoom:
        """What there is room for now."""
        return self._room

    def render(self, camera: Camera | None = None, time_s: float = 0.0) -> PendingFrame:
        """Queue the picture of `camera` at `time_s` on the current stream."""
        camera = camera or self._camera
        wanted = (self._camera.width_px, self._camera.height_px, self._camera.model)
        if (camera.width_px, camera.height_px, camera.model) != wanted:
            raise InvalidInput(
                f"this renderer makes {wanted[0]}x{wanted[1]} {wanted[2]} pictures, the camera is"
                f" {camera.width_px}x{camera.height_px} {camera.model}; make another FrameRenderer for it"
            )
        self._number += 1
        self._asked = camera, 0.0 if self.field is None else self.field.frame_time(time_s)
        self._launch()
        return PendingFrame(self, self._number)

    def _launch(self) -> None:
        assert self._asked is not None
        self._controls.set(*self._asked)
        if self._captured is None:
            self._captured = CapturedSequence(self._sequence, self.gaussians.device, self._memory, warm_up=True)
        self._captured.replay()
        self._status.mark(self.gaussians.device)

    def _sequence(self) -> Frame:
        deltas = None if self._deltas is None else self._deltas(self._controls.time)
        scene, camera, controls = self.gaussians, self._camera, self._controls
        tensors = scene.means, scene.quats, scene.log_scales, scene.logit_opacities, self._sh
        view = View(
            controls.viewmat, controls.intrinsics, camera.width_px, camera.height_px, self._background, camera.model
        )
        mode = FrameMode.SEGMENTS if self._room.per_tile else FrameMode.SHARED
        frame = render_frame(tensors, deltas, view, self._room.capacity, mode)
        self._status.fetch(frame.status)
        return frame

    def _finish(self, number: int) -> RenderOutput:
        if number != self._number:
            raise InvalidInput("this frame's memory was used for a later one; take result() before the next render()")
        while (needs := self._status.wait()).cut:
            self._room = ListRoom.for_frame(needs.in_all, needs.in_a_tile)
            self._captured = None
            self._launch()
        assert self._captured is not None
        frame = self._captured.results
        return RenderOutput(frame.image[..., :3], frame.alphas, frame.image[..., 3])
