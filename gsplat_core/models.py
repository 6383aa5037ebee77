"""Published models and snapshots: Gaussians with their deformation field, camera and time window.

A snapshot of a scene in training is published without allocation or host synchronisation. On a GPU, the publisher owns a few slots: tensors at fixed addresses with spare capacity for Gaussians and the field. Each
snapshot is copied into a free slot on the current stream. A renderer that captured a CUDA graph for a slot replays it
for every later snapshot in that slot. A slot becomes free when its snapshot has no references left. Pending GPU reads
are awaited on the stream before the slot is overwritten.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, FieldSlot, checked_window
from gsplat_core.errors import InvalidInput
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.surface import Surface, certainty, render_surface
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthSource
from gsplat_core.scene.gaussians import Gaussians, inert_gaussians
from gsplat_core.transfers import copy_each
from gsplat_core.value_ranges import check_seen_at


def clamp_time(time_s: float, window_s: tuple[float, float]) -> float:
    """Clamp `time_s` to the window; NaN is preserved, for the field to reject."""
    start, end = window_s
    return min(max(time_s, start), end) if time_s == time_s else time_s


@dataclass(frozen=True)
class TrainedBy:
    """Renderer whose pictures were compared with the frames in training a model. Other renderers may be unable to show the model."""

    renderer: str = "alpha"
    """Name of the renderer, a key of `RENDERERS`."""
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Parameters of the renderer that apply to the whole scene, by name; learned, or fixed at the start of training."""


@dataclass(frozen=True, eq=False)
class Model:
    """One immutable version of a reconstruction; safe to read from several threads.

    The publisher passes detached copies of the tensors and never changes them afterwards.

    Raises:
        InvalidInput: if a tensor requires a gradient, or the field has another number of Gaussians.
    """

    version: int
    """Version number; increases with every snapshot, from 1."""
    gaussians: Gaussians
    """Canonical Gaussians, which the field deforms."""
    field: DeformationField | None
    """Deformation field; None for a static scene."""
    camera: Camera
    """Camera of the recording's first frame."""
    time_window_s: tuple[float, float]
    """First and last observed time in seconds; other times are clamped."""
    training_digest: str | None = None
    """SHA-256 of the training recording; None if unknown."""
    unseen_s: Tensor | None = None
    """Time since each Gaussian was last visible, float64 [N], in seconds of the stream.

    Live training updates it every few frames; 0 means visible. None if unknown. Neither saved nor part of the digest.
    """

    depth_source: DepthSource | None = None
    """Source of the training depth; None without depth or in bundles of earlier versions."""
    trained_by: TrainedBy = TrainedBy()
    """Renderer that trained the model."""

    _deform: Callable[[float], Gaussians] | None = dataclasses.field(default=None, init=False, repr=False)
    _last: tuple[float, Gaussians] | None = dataclasses.field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_window_s", checked_window(self.time_window_s))
        if self.version < 1:
            raise InvalidInput(f"a model's version counts from 1, got {self.version}")
        if self.unseen_s is not None and self.unseen_s.shape != (self.gaussians.count,):
            raise InvalidInput(
                f"unseen_s is {list(self.unseen_s.shape)}; it must have a time for each of {self.gaussians.count} Gaussians"
            )
        learning = [name for name, tensor in self.tensors().items() if tensor.requires_grad]
        if learning:
            raise InvalidInput(
                f"a model is published with detached copies, but {', '.join(learning)} require gradients"
            )
        rows = None if self.field is None else self.field.capabilities.rows
        if rows is not None and rows.count != self.gaussians.count:
            raise InvalidInput(f"the field deforms {rows.count} Gaussians, the model has {self.gaussians.count}")

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors of the model by name: `gaussians.*`, then `field.*` in the field's order."""
        named = {f"gaussians.{name}": tensor for name, tensor in self.gaussians.tensors().items()}
        if self.field is not None:
            named |= {f"field.{name}": tensor for name, tensor in self.field.state_dict(keep_vars=True).items()}
        return named

    @property
    def parameter_count(self) -> int:
        """Total number of values in the tensors of the Gaussians and the field."""
        return sum(tensor.numel() for tensor in self.tensors().values())

    def to(self, device: torch.device | str) -> Model:
        """Return the model on `device`: itself if already there, otherwise a copy."""
        if self.gaussians.device == torch.device(device):
            return self
        field = None if self.field is None else self.field.detached_copy().to(device)
        seen = None if self.unseen_s is None else self.unseen_s.to(device)
        return dataclasses.replace(self, gaussians=self.gaussians.to(device), field=field, unseen_s=seen)

    @property
    def metric(self) -> bool:
        """True if lengths are millimetres; otherwise they are known up to one factor."""
        return self.depth_source is not None and self.depth_source.metric

    @property
    def device(self) -> torch.device:
        return self.gaussians.device

    @property
    def gaussian_count(self) -> int:
        return self.gaussians.count

    def as_model(self) -> Model:
        """Return the model itself; counterpart of `Snapshot.as_model`."""
        return self

    def check_time(self, time_s: float) -> None:
        """Raise InvalidSetting for a time in seconds outside the model's window.

        Clamping would silently show another time.
        """
        check_seen_at(time_s, self.time_window_s)

    def clamp_time(self, time_s: float) -> float:
        """Clamp `time_s` to the time window, extended by the field's extrapolation range."""
        window_s = self.time_window_s
        return clamp_time(time_s, window_s if self.field is None else self.field.continued_window(window_s))

    def at(self, time_s: float) -> Gaussians:
        """Return the Gaussians at `time_s`, clamped to the window; the last result is cached."""
        if self.field is None:
            return self.gaussians
        time_s = self.clamp_time(time_s)
        last = self._last
        if last is not None and last[0] == time_s:
            return last[1]
        deform = self._deform
        if deform is None:
            deform = self.field.cached(self.gaussians)
            object.__setattr__(self, "_deform", deform)
        deformed = deform(time_s)
        object.__setattr__(self, "_last", (time_s, deformed))
        return deformed

    def seen_by_right(self) -> Model:
        """Return the model with the right eye's colours; itself if the right eye was not trained."""
        if self.gaussians.right_sh is None:
            return self
        return dataclasses.replace(self, gaussians=self.gaussians.seen_by_right())

    def render(
        self, time_s: float, camera: Camera | None = None, background: Tensor | None = None, depth: bool = True
    ) -> RenderOutput:
        """Render the scene at `time_s` by alpha blending without autograd, by default from the recording's camera."""
        with torch.no_grad():
            return render(self.at(time_s), camera or self.camera, background, depth)

    def surface(self, time_s: float, camera: Camera | None = None) -> Surface:
        """Render depth, normals, spread and confidence at `time_s`; see `Surface`.

        The default camera is that of the recording.
        """
        gaussians = self.at(time_s)
        certain = None if self.unseen_s is None else certainty(self.unseen_s)
        return render_surface(gaussians, camera or self.camera, certain)

    def description(self) -> dict[str, Any]:
        """Return the model's metadata (everything except tensors and version) as JSON-serialisable values."""
        source = self.depth_source
        # An unknown depth source is omitted, so that models of earlier versions, which have none, keep their digest.
        depth: dict[str, Any] = {}
        if source is not None:
            depth = {"depth": {"origin": source.origin.name, "metric": source.metric}}
            if source.errors:
                depth["depth"]["errors"] = [list(each) for each in source.errors]
        right: dict[str, Any] = {} if self.gaussians.right_sh is None else {"right_eye": True}
        if self.gaussians.extra:
            right["extra"] = {name: list(tensor.shape[1:]) for name, tensor in self.gaussians.extra.items()}
        by: dict[str, Any] = {}
        if self.trained_by.renderer != "alpha":
            by = {"trained_by": {"renderer": self.trained_by.renderer, "values": dict(self.trained_by.values)}}
        return {
            "gaussians": {"count": self.gaussians.count, "sh_degree": self.gaussians.sh_degree, **right},
            "field": None if self.field is None else self.field.config(),
            "camera": {
                "K": self.camera.K.tolist(),
                "width_px": self.camera.width_px,
                "height_px": self.camera.height_px,
                "world_to_camera": self.camera.world_to_camera.tolist(),
                "model": self.camera.model,
            },
            "time_window_s": list(self.time_window_s),
            "training_digest": self.training_digest,
            **depth,
            **by,
        }

    def sha256(self) -> str:
        """Return the digest of the description and of all tensors (name, dtype, shape, bytes).

        The version is not included.
        """
        digest = hashlib.sha256()
        for piece in self._canonical_bytes():
            digest.update(piece)
        return digest.hexdigest()

    def _canonical_bytes(self) -> Iterator[bytes | memoryview]:
        yield json.dumps(self.description(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
        for name, tensor in sorted(self.tensors().items()):
            yield f"\n{name} {tensor.dtype} {list(tensor.shape)}\n".encode()
            if tensor.numel():
                yield tensor.detach().cpu().contiguous().numpy().data.cast("B")


ROW_STEP = 1024
"""Granularity of a slot's capacity: its number of Gaussians is a multiple of this."""
ROW_HEADROOM = 1.25
MOST_SLOTS = 9
"""Maximum number of simultaneously held snapshots per publisher. Replay needs three or four."""


class SnapshotSlot:
    """Memory for one snapshot, written by `SnapshotSlots` and read inside `Snapshot.reading`."""

    def __init__(self, number: int, device: torch.device, rows: int = 0) -> None:
        """Create an empty slot with capacity for at least `rows` Gaussians."""
        self.number = number
        self._fewest_rows = rows
        self.layout = 0
        """Generation number of the slot's tensors. It changes when they are reallocated, which invalidates CUDA graphs captured for them."""
        self._gaussians: Gaussians | None = None
        self._field: FieldSlot | None = None
        self._count = 0
        self._in_use: list[Tensor] = []
        """Views of the used part, the first `_count` Gaussians, of every tensor of the slot."""
        self._holder: weakref.ref[Snapshot] | None = None
        self._order = _DeviceOrder(device)

    @property
    def gaussians(self) -> Gaussians:
        """Gaussians in all tensor rows of the slot. Unused rows have an opacity logit of -inf and are in no tile list."""
        assert self._gaussians is not None
        return self._gaussians

    @property
    def field(self) -> DeformationField | None:
        """Deformation field with capacity for all rows of the slot; None for a static scene."""
        return None if self._field is None else self._field.field

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the scene last written into the slot, without spare capacity."""
        own = sum(tensor[:1].numel() for tensor in self.gaussians.tensors().values()) * self._count
        return own + (0 if self._field is None else self._field.parameter_count)

    @property
    def is_free(self) -> bool:
        """True if the snapshot in the slot has no references left."""
        return self._holder is None or self._holder() is None

    def write(self, gaussians: Gaussians, field: DeformationField | None) -> None:
        """Enqueue the copy of a scene on the current stream, after pending reads of the old content."""
        self._order.before_writing()
        with torch.no_grad():
            if not self._overwrite(gaussians, field):
                self._replace(gaussians, field)
        self._order.after_writing()

    def _overwrite(self, gaussians: Gaussians, field: DeformationField | None) -> bool:
        if self._gaussians is None or not _fits(gaussians, self._gaussians):
            return False
        if (field is None) != (self._field is None):
            return False
        if field is not None and self._field is not None and not self._field.overwrite(field):
            return False
        count = gaussians.count
        if self._count > count:
            self._gaussians.logit_opacities[count : self._count].fill_(-math.inf)
        if self._count != count or not self._in_use:
            self._in_use = [tensor[:count] for tensor in self._gaussians.tensors().values()]
            self._count = count
        copy_each(self._in_use, [*gaussians.tensors().values()])
        return True

    def _replace(self, gaussians: Gaussians, field: DeformationField | None) -> None:
        wanted: float = self._fewest_rows
        if gaussians.count > wanted or wanted == 0:
            wanted = max(gaussians.count * ROW_HEADROOM, 1)
        rows = math.ceil(wanted / ROW_STEP) * ROW_STEP
        self._gaussians = inert_gaussians(gaussians, rows)
        self._count, self._in_use = 0, []
        new_slot = None if field is None else field.capabilities.slot
        self._field = None if new_slot is None else new_slot(rows)
        self.layout += 1
        written = self._overwrite(gaussians, field)
        assert written, "a new slot has capacity for what it was made for"


class Snapshot:
    """One published state of a scene in a slot, valid while this object is referenced.

    Reading threads keep a reference during the read. On a GPU, they read inside `reading`.
    """

    def __init__(
        self,
        slot: SnapshotSlot,
        *,
        version: int,
        camera: Camera,
        time_window_s: tuple[float, float],
        training_digest: str | None = None,
        unseen_s: Tensor | None = None,
        depth_source: DepthSource | None = None,
    ) -> None:
        self.version = version
        """Version number; increases with every snapshot, from 1."""
        self.camera = camera
        """The camera of the recording's first frame."""
        self.time_window_s = time_window_s
        """First and last observed time in seconds; other times are clamped."""
        self.training_digest = training_digest
        self._unseen_s = unseen_s
        self.depth_source = depth_source
        """Depth source of the frames that the model was trained on."""
        self.parameter_count = slot.parameter_count
        """Number of parameters, without the slot's spare capacity."""
        self.slot = slot
        self.gaussian_count = slot._count
        self._lock = threading.Lock()
        self._model: Model | None = None

    @property
    def device(self) -> torch.device:
        return self.slot.gaussians.device

    @contextmanager
    def reading(self) -> Iterator[SnapshotSlot]:
        """Provide the slot to kernels enqueued on the current stream within the context.

        The stream waits for the write of the slot. The next write waits for the enqueued reads.
        """
        self.slot._order.before_reading()
        try:
            yield self.slot
        finally:
            self.slot._order.after_reading()

    def clamp_time(self, time_s: float) -> float:
        """Clamp `time_s` to the time window, extended by the field's extrapolation range."""
        window_s, field = self.time_window_s, self.slot.field
        return clamp_time(time_s, window_s if field is None else field.continued_window(window_s))

    def at(self, time_s: float) -> Gaussians:
        """Return the Gaussians at `time_s`, clamped to the window, in separate memory."""
        with self.reading() as slot, torch.no_grad():
            gaussians = slot.gaussians
            if slot.field is not None:
                gaussians = slot.field(gaussians, self.clamp_time(time_s))
            return gaussians.map(lambda tensor: tensor[: self.gaussian_count].clone())

    def unseen_s(self) -> Tensor | None:
        """Copy of the seconds since each Gaussian was last visible, [N], or None if unknown; see `Model.unseen_s`."""
        if self._unseen_s is None:
            return None
        with self.reading():
            seen = self._unseen_s.clone()
            if seen.is_cuda:
                # `unseen_s` is in no slot. Its memory must not be reused before the current stream has read it.
                self._unseen_s.record_stream(torch.cuda.current_stream(self.device))
            return seen

    def as_model(self) -> Model:
        """Return a copy of the snapshot as an immutable model, created on first access."""
        with self._lock:
            if self._model is None:
                with self.reading() as slot, torch.no_grad():
                    gaussians = slot.gaussians.map(lambda tensor: tensor[: self.gaussian_count].clone())
                    field = None if slot._field is None else slot._field.exact_copy()
                    seen = self.unseen_s()
                facts = self.camera, self.time_window_s, self.training_digest, seen, self.depth_source
                self._model = Model(self.version, gaussians, field, *facts)
            return self._model


class SnapshotSlots:
    """Slots of one publisher. One thread publishes; any thread may hold snapshots."""

    def __init__(self, device: torch.device | str, most: int = MOST_SLOTS, rows: int = 0) -> None:
        """Create an empty pool; slots are allocated on demand.

        Args:
            device: device of the slots.
            most: maximum number of slots.
            rows: initial capacity of each slot in Gaussians; 0 selects 1.25 times the first scene's count.
        """
        self._device = torch.device(device)
        self._rows = rows
        self._most = most
        self._slots: list[SnapshotSlot] = []

    @property
    def count(self) -> int:
        """Number of allocated slots, in use or free. Each holds one snapshot; slots are reused and never freed."""
        return len(self._slots)

    def publish(
        self,
        gaussians: Gaussians,
        field: DeformationField | None,
        *,
        version: int,
        camera: Camera,
        time_window_s: tuple[float, float],
        training_digest: str | None = None,
        unseen_s: Tensor | None = None,
        depth_source: DepthSource | None = None,
    ) -> Snapshot:
        """Enqueue a copy of a scene on the current stream and return its snapshot.

        The originals may be changed on that stream immediately. `unseen_s` is not copied and must stay unchanged.

        Raises:
            InvalidInput: if all slots are in use, or the field cannot be stored in a slot.
        """
        if field is not None and field.capabilities.slot is None:
            raise InvalidInput(f"a {type(field).__name__} cannot lie in a slot; publish it as a Model")
        slot = self._free_slot()
        slot.write(gaussians, field)
        snapshot = Snapshot(
            slot,
            version=version,
            camera=camera,
            time_window_s=time_window_s,
            training_digest=training_digest,
            unseen_s=unseen_s,
            depth_source=depth_source,
        )
        slot._holder = weakref.ref(snapshot)
        return snapshot

    def _free_slot(self) -> SnapshotSlot:
        for slot in self._slots:
            if slot.is_free:
                return slot
        if len(self._slots) == self._most:
            raise InvalidInput(
                f"all {self._most} snapshots of this publisher are held; let go of some, or keep Snapshot.as_model()"
            )
        self._slots.append(SnapshotSlot(len(self._slots), self._device, self._rows))
        return self._slots[-1]


class _DeviceOrder:
    """Events that order a slot's writes and reads across CUDA streams; a no-op on the CPU."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._written: torch.cuda.Event | None = None
        self._read: dict[int, torch.cuda.Event] = {}
        """Completion event of the last read on each CUDA stream, by handle, since the last write."""

    def before_writing(self) -> None:
        read, self._read = self._read, {}
        for event in read.values():
            torch.cuda.current_stream(self._device).wait_event(event)

    def after_writing(self) -> None:
        if self._device.type == "cuda":
            self._written = self._now()

    def before_reading(self) -> None:
        if self._written is not None:
            torch.cuda.current_stream(self._device).wait_event(self._written)

    def after_reading(self) -> None:
        if self._device.type == "cuda":
            self._read[torch.cuda.current_stream(self._device).cuda_stream] = self._now()

    def _now(self) -> torch.cuda.Event:
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(self._device))
        return event


def _fits(gaussians: Gaussians, capacity: Gaussians) -> bool:
    same_kind = gaussians.sh_degree == capacity.sh_degree and gaussians.tensors().keys() == capacity.tensors().keys()
    return gaussians.count <= capacity.count and same_kind
