"""Snapshots of a scene in training, published without allocation or host synchronisation.

On a GPU, the publisher owns a few slots: tensors at fixed addresses with spare capacity for Gaussians and the field. Each
snapshot is copied into a free slot on the current stream. A renderer that captured a CUDA graph for a slot replays it
for every later snapshot in that slot. A slot becomes free when its snapshot has no references left. Pending GPU reads
are awaited on the stream before the slot is overwritten.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, FieldSlot
from gsplat_core.errors import InvalidInput
from gsplat_core.models.model import Model, clamp_time
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_source import DepthSource
from gsplat_core.scene.gaussians import Gaussians, inert_gaussians
from gsplat_core.transfers import copy_each

ROW_STEP = 1024
"""The number of Gaussians for which a slot has room is a multiple of this."""
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
        """Generation of the tensors; a change invalidates graphs captured for the previous ones."""
        self._gaussians: Gaussians | None = None
        self._field: FieldSlot | None = None
        self._count = 0
        self._in_use: list[Tensor] = []
        """Views of the first `_count` rows of every tensor."""
        self._holder: weakref.ref[Snapshot] | None = None
        self._order = _DeviceOrder(device)

    @property
    def gaussians(self) -> Gaussians:
        """All rows of the slot. Rows beyond the count have an opacity logit of -inf and are in no tile list."""
        assert self._gaussians is not None
        return self._gaussians

    @property
    def field(self) -> DeformationField | None:
        """Deformation field with capacity for all rows of the slot; None for a static scene."""
        return None if self._field is None else self._field.field

    @property
    def parameter_count(self) -> int:
        """Number of parameters last written, without spare capacity."""
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
        """Copy of the time since each Gaussian was last visible; see `Model.unseen_s`."""
        if self._unseen_s is None:
            return None
        with self.reading():
            seen = self._unseen_s.clone()
            if seen.is_cuda:
                # This tensor is in no slot. The publisher may free it before this stream has read
                # it.
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
        """Number of slots allocated so far."""
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
    """Ordering of writes and reads of a memory region across CUDA streams; a no-op on the CPU."""

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
