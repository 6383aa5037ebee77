"""Alpha-blending `Renderer` for CPU and NVIDIA GPUs (Kerbl et al. 2023, section 4), and frames as CUDA graphs.

`FrameRenderer` renders whole frames on a GPU as one CUDA graph without host synchronisation. The graph deforms,
projects, bins, sorts and blends. `CapturedSequence` captures a sequence of launches and replays it as one launch.

An instance is a pair of a splat and a tile that it touches. A tile's list holds the instances that it blends.
`TileListCapacity` bounds the lists. The host reads an overflow counter after the frame and repeats a frame that needed
longer lists.
"""

from __future__ import annotations

import contextlib
import gc
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar, get_args

import torch
from torch import Tensor

from gsplat_core.deformation.field import FrameDeltas
from gsplat_core.errors import InvalidInput
from gsplat_core.models import Model, Snapshot
from gsplat_core.ops.frame import (
    MAX_SEGMENT,
    STATUS_LONGEST,
    STATUS_NEEDED,
    STATUS_OVERFLOW,
    Frame,
    FrameMode,
    View,
    render_frame,
)
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.ops.scalars import store_scalars_
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
    check_background,
    check_camera,
    check_trained_by,
    checked_outputs,
    standard_outputs,
)
from gsplat_core.rendering.settings import TILE_SIZE
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
        """CUDA-graph renderers by slot number, each with the slot's id and the generation of its tensors for which it was
        captured.
        """

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
            # Tile lists that overflowed in one slot raise the capacity for all slots.
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
    """Frame that was launched on a GPU. It keeps the model alive, so that its slot is not reused before the frame is complete."""

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
    """Render a frame with outputs beyond picture, opacity and depth by separate kernel launches; too slow for live frames."""
    outputs: dict[str, Tensor] = model.render(time_s, camera, background)._asdict()
    if {*asked} & {*SURFACE_OUTPUTS}:
        outputs = {**model.surface(time_s, camera)._asdict(), **outputs}
    if {*asked} & {*FLOW_OUTPUTS}:
        # Imported here, so that rendering only pictures does not load the compiled op for flow.
        from gsplat_core.rendering.flow import render_motion

        outputs |= render_motion(model.at(time_s), model.at(time_s + FLOW_STEP_S), camera)
    return {name: outputs[name] for name in asked}


def _chosen(output: RenderOutput, asked: tuple[str, ...]) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in output._asdict().items() if name in asked}


Result = TypeVar("Result")
_CAPTURING = threading.Lock()
"""Lock held during a capture. Other threads may launch and allocate, but captures never overlap."""


class GraphMemory:
    """Memory pool for the captured graphs of one owner.

    A graph that replaces an unused graph takes over its memory.
    """

    def __init__(self, device: torch.device) -> None:
        # torch frees a pool together with the last graph in it. This empty graph keeps the pool alive.
        self._keeper = torch.cuda.CUDAGraph()
        _capture(self._keeper, lambda: torch.zeros(1, device=device), device, None)

    @property
    def pool(self) -> Any:
        """Return torch's handle of the memory pool, for `CUDAGraph.capture_begin`."""
        return self._keeper.pool()


class CapturedSequence(Generic[Result]):
    """CUDA graph of the launches of `sequence()`.

    Allocations of the sequence keep their addresses. `results` are the same tensors at every replay, which overwrites
    them. Inputs that change between replays must be in device memory referenced by the sequence.

    CUDA cannot load kernels during a capture. The sequence must therefore have run before. `warm_up` runs it once, with
    all its side effects. Replays have the `priority` of a CUDA stream, whichever stream they are launched on.
    """

    def __init__(
        self,
        sequence: Callable[[], Result],
        device: torch.device,
        memory: GraphMemory,
        *,
        warm_up: bool,
        priority: int = 0,
    ) -> None:
        if warm_up:
            sequence()
        self._graph = torch.cuda.CUDAGraph()
        self.results = _capture(self._graph, sequence, device, memory.pool, priority)

    def replay(self) -> Result:
        """Launch the graph on the current stream without waiting."""
        self._graph.replay()
        return self.results


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _capture(
    graph: torch.cuda.CUDAGraph,
    sequence: Callable[[], Result],
    device: torch.device,
    pool: Any,
    priority: int = 0,
) -> Result:
    # Not `torch.cuda.graph`, which runs the garbage collector first. That takes longer than many frames. The collector
    # must not run during the capture either: freeing an earlier graph invalidates it.
    with _CAPTURING, _without_garbage_collection():
        # torch instantiates graphs with the priorities of their nodes, which are that of the capturing stream.
        current, side = torch.cuda.current_stream(device), torch.cuda.Stream(device, priority=priority)
        side.wait_stream(current)
        with torch.cuda.stream(side):
            # thread_local lets other threads allocate memory during the capture.
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                results = sequence()
            finally:
                graph.capture_end()
        current.wait_stream(side)
    return results


CAPACITY_STEP = 1 << 16
"""Number of instances (pairs of splat and tile) to a multiple of which the capacity of a buffer for all tiles is rounded up."""
TILE_STEP = 32
"""Number of instances (pairs of splat and tile) to a multiple of which the capacity of each tile's own segment is rounded up."""
HEADROOM = 1.25
"""Ratio of allocated tile-list capacity to the need of a frame, so that a moving scene seldom exceeds the capacity."""


def capacity_for(needed: int) -> int:
    """Return the shared capacity to allocate after a frame that needed `needed` instances."""
    return max(1, math.ceil(needed * HEADROOM / CAPACITY_STEP)) * CAPACITY_STEP


@dataclass(frozen=True)
class TileListCapacity:
    """Capacity of a buffer shared by all tile lists, or of each tile's own segment."""

    capacity: int
    per_tile: bool

    @property
    def mode(self) -> FrameMode:
        """Frame mode that `render_frame` uses with this capacity."""
        return FrameMode.SEGMENTS if self.per_tile else FrameMode.SHARED

    @staticmethod
    def for_frame(needed: int, most_in_tile: int) -> TileListCapacity:
        """Return the capacity for a frame's measured need.

        Separate buffers per tile are faster and take up to 32 bytes per pixel. If a tile has more
        instances than fit, one shared buffer is used.

        Args:
            needed: number of instances in the frame.
            most_in_tile: largest number of instances in one tile.
        """
        of_tile = max(1, math.ceil(most_in_tile * HEADROOM / TILE_STEP)) * TILE_STEP
        if of_tile <= MAX_SEGMENT:
            return TileListCapacity(of_tile, per_tile=True)
        return TileListCapacity(capacity_for(needed), per_tile=False)

    @staticmethod
    def initial(gaussians: int, width_px: int, height_px: int) -> TileListCapacity:
        """Return the initial capacity, for four instances per Gaussian and at most twice their mean in a tile."""
        tiles = math.ceil(width_px / TILE_SIZE) * math.ceil(height_px / TILE_SIZE)
        return TileListCapacity.for_frame(4 * gaussians, math.ceil(8 * gaussians / tiles))


class FrameNeeds(NamedTuple):
    """Tile-list entries (instances) needed by rendered frames, and the number of overflows."""

    instances: int
    """Total number of instances (pairs of splat and tile) of a frame, the largest one over several frames."""
    most_in_tile: int
    overflowed: int
    """Number of frames that dropped instances because their lists were full."""


class FrameStatusCopy:
    """Asynchronous copy of the last frame's status to the host.

    Enqueue the copy with `queue` (also inside a CUDA graph), call `launched` after the launch that
    contains it, then `wait`.
    """

    def __init__(self) -> None:
        self._arrived = torch.cuda.Event()
        self._values = torch.zeros(4, dtype=torch.int32, pin_memory=True)

    def __del__(self) -> None:
        # torch does not track writes of a graph and would free the memory while a copy is in flight.
        self._arrived.synchronize()

    def queue(self, status: Tensor) -> None:
        """Enqueue the copy of a frame's `status` on the current stream."""
        self._values.copy_(status, non_blocking=True)

    def launched(self, device: torch.device) -> None:
        """Record the point on the current stream of `device` that `wait` waits for."""
        self._arrived.record(torch.cuda.current_stream(device))

    def wait(self) -> FrameNeeds:
        """Wait for the status copy and return its values."""
        self._arrived.synchronize()
        values = self._values.tolist()
        return FrameNeeds(values[STATUS_NEEDED], values[STATUS_LONGEST], values[STATUS_OVERFLOW])


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
        """Enqueue the copy of a camera, a time and learning rates to the device buffer. They are passed as arguments of one
        launch, so the caller may reuse its memory at once.
        """
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

    The number of Gaussians is fixed. `render` enqueues a frame and returns without waiting for the device. Tile lists
    have a fixed capacity. A frame that exceeds it reports the overflow in its status, and `LaunchedFrame.result`
    renders it again with a larger capacity. No finished picture lacks a splat.

    Tensors of the Gaussians and the field are read in place, so in-place changes affect the next frame. Exceptions are
    values computed at construction: half-precision spherical harmonics and values that `FrameDeltas.frame_deltas`
    precomputes. With `recompute` they are computed in every frame.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        field: FrameDeltas | None = None,
        *,
        background: Tensor | None = None,
        precision: Precision = "fp32",
        recompute: bool = False,
    ) -> None:
        """Create a renderer and capture its graph.

        With precision "fp16", SH coefficients, field and blending use half precision. The picture is nearly exact (PSNR
        in `benchmarks/results/renderer.md`) and faster. `camera` determines size and camera model of every frame, and
        the pose of those rendered without a camera.

        Raises:
            InvalidInput: if the Gaussians are not float32 on a CUDA device, or the precision is unknown.
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
        """Capacity of the tile lists; replaced by one that fits when a frame overflows it."""
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

    @property
    def picture_shape(self) -> tuple[int, int, str]:
        """Width and height in pixels, and camera model of every frame."""
        return self._camera.width_px, self._camera.height_px, self._camera.model

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
