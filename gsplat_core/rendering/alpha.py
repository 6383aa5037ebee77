"""Alpha-blending `Renderer` for CPU and NVIDIA GPUs (Kerbl et al. 2023, section 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.models import Model, Snapshot
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.rendering.frame_renderer import FrameRenderer, LaunchedFrame
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.renderer import (
    FLOW_OUTPUTS,
    FLOW_STEP_S,
    STANDARD_OUTPUTS,
    SURFACE_OUTPUTS,
    Capabilities,
    FinishedFrame,
    PendingFrame,
    Precision,
    check_camera,
    check_trained_by,
    checked_outputs,
    standard_outputs,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians


class AlphaRenderer:
    """Renderer that deforms, projects, sorts and alpha-blends Gaussians (Kerbl et al. 2023).

    On a GPU, a frame is one CUDA graph. A snapshot is rendered in its slot by a graph captured once for the slot. A
    `Model` has its own graph, captured by `prepare`. On the CPU, and for fields without `frame_deltas`, the field's
    own function deforms the model and `gsplat_core.render` renders it. The outputs of a `Surface` (`SURFACE_OUTPUTS`)
    and the motion to a later time (`FLOW_OUTPUTS`) are rendered by single launches in addition to the picture.
    """

    capabilities = Capabilities(
        outputs=(*STANDARD_OUTPUTS, *SURFACE_OUTPUTS, *FLOW_OUTPUTS),
        precisions={"cpu": ("fp32",), "cuda": ("fp32", "fp16")},
        differentiable=True,
        deterministic=True,
        reads_snapshots=True,
    )

    rates: ClassVar[Mapping[str, float]] = {}

    @staticmethod
    def extended(gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians unchanged, because alpha blending has no tensors of its own."""
        return gaussians

    @staticmethod
    def first_values(distance: float) -> Mapping[str, float]:
        """Return an empty mapping, because alpha blending has no learned values for the whole scene."""
        return {}

    @staticmethod
    def picture(
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor | None,
        values: Mapping[str, Tensor],
        depth: bool = True,
    ) -> RenderOutput:
        """Render a differentiable picture; see `TrainableRenderer.picture`."""
        return render(gaussians, camera, background, depth)

    def __init__(
        self, camera: Camera, device: torch.device, *, precision: Precision = "fp32", background: Tensor | None = None
    ) -> None:
        self._camera, self._device, self._precision = camera, torch.device(device), precision
        self._background = background
        self._model: Model | Snapshot | None = None
        self._frames: FrameRenderer | None = None
        """CUDA-graph renderer of the prepared model; None if the model is rendered by separate kernel launches."""
        self._by_slot: dict[int, tuple[tuple[int, int], FrameRenderer]] = {}
        """Graph renderer by slot number, with the slot and layout for which it was captured."""

    def prepare(self, model: Model | Snapshot) -> None:
        """Set the model of the following frames; see `Renderer.prepare`. Raises InvalidInput for a model on another
        device, InvalidSetting for one of another renderer.
        """
        if model.device.type != self._device.type:
            raise InvalidInput(f"this renderer is made for {self._device.type}, the model is on {model.device}")
        check_trained_by("alpha", model)
        if model is self._model:
            return
        if isinstance(model, Snapshot):
            self._frames = self._for_slot(model)
        else:
            self._frames = self._new_frames(model, recompute=False)
        self._model = model

    def render(self, camera: Camera, time_s: float, outputs: Iterable[str] = STANDARD_OUTPUTS) -> PendingFrame:
        """Enqueue the picture of the prepared model; see `Renderer.render`."""
        asked = checked_outputs("alpha", outputs, self.capabilities)
        check_camera(self._camera, camera)
        model = self._model
        if model is None:
            raise InvalidInput("no model was prepared; call prepare(model) before render()")
        if not {*asked} <= {*STANDARD_OUTPUTS}:
            return FinishedFrame(_with_further(model.as_model(), camera, time_s, self._background, asked))
        if self._frames is None:
            with torch.no_grad():
                output = render(model.at(time_s), camera, self._background, depth="depth" in asked)
            return FinishedFrame(_chosen(output, asked))
        reading = model.reading if isinstance(model, Snapshot) else nullcontext
        with reading():
            launched = self._frames.render(camera, model.clamp_time(time_s))
        return _FrameInFlight(model, launched, reading, asked)

    def _for_slot(self, snapshot: Snapshot) -> FrameRenderer | None:
        slot = snapshot.slot
        key = id(slot), slot.layout
        known = self._by_slot.get(slot.number)
        if known is not None and known[0] == key:
            frames = known[1]
        else:
            made = self._new_frames(snapshot, recompute=True)
            if made is None:
                return None
            frames = made
            self._by_slot[slot.number] = key, frames
        if self._frames is not None and self._frames.gaussians.count == frames.gaussians.count:
            # An overflow in one slot raises the capacity for all slots.
            frames.capacity = self._frames.capacity
        return frames

    def _new_frames(self, model: Model | Snapshot, *, recompute: bool) -> FrameRenderer | None:
        scene = model.slot if isinstance(model, Snapshot) else model
        gaussians, field = scene.gaussians, scene.field
        if gaussians.device.type != "cuda" or gaussians.dtype != torch.float32 or CUDA_MISSING is not None:
            return None
        frame_deltas = None if field is None else field.capabilities.frame_deltas
        if field is not None and frame_deltas is None:
            return None
        return FrameRenderer(
            gaussians,
            self._camera,
            frame_deltas,
            background=self._background,
            precision=self._precision,
            recompute=recompute,
        )


@dataclass(frozen=True)
class _FrameInFlight:
    """Launched frame; keeps the model alive so that its slot is not reused before completion."""

    _model: Model | Snapshot
    _launched: LaunchedFrame
    _reading: Callable[[], AbstractContextManager[object]]
    _asked: tuple[str, ...]

    def outputs(self) -> Mapping[str, Tensor]:
        """Return the requested outputs by name; see `PendingFrame.outputs`."""
        with self._reading():  # an overflowing frame is rendered again from the slot
            return _chosen(self._launched.result(), self._asked)

    def result(self) -> RenderOutput:
        """Return the three standard outputs; see `PendingFrame.result`."""
        return standard_outputs(self.outputs())


def _with_further(
    model: Model, camera: Camera, time_s: float, background: Tensor | None, asked: tuple[str, ...]
) -> dict[str, Tensor]:
    """Render outputs by separate kernel launches, also on a GPU. Too slow for live frames."""
    outputs: dict[str, Tensor] = model.render(time_s, camera, background)._asdict()
    if {*asked} & {*SURFACE_OUTPUTS}:
        outputs = {**model.surface(time_s, camera)._asdict(), **outputs}
    if {*asked} & {*FLOW_OUTPUTS}:
        # The compiled op is loaded when it is first needed, so that pictures alone do not depend on it.
        from gsplat_core.rendering.flow import render_motion

        outputs |= render_motion(model.at(time_s), model.at(time_s + FLOW_STEP_S), camera)
    return {name: outputs[name] for name in asked}


def _chosen(output: RenderOutput, asked: tuple[str, ...]) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in output._asdict().items() if name in asked}
