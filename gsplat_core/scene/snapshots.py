"""Snapshots of a scene that is being learned, published without new memory and without a wait of the host.

A publisher on a GPU owns a few slots: tensors at fixed addresses with capacity for more Gaussians and bumps than there are. Each snapshot is
copied into a free slot on the stream. A renderer that has captured a CUDA graph for a slot replays it for every snapshot that comes to lie
there. A slot is free when nobody holds its snapshot any more; what a GPU still has to read from it then is waited for on the stream.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, FieldSlot, continued_window, copy_each
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_source import DepthSource
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model, clamp_time
from gsplat_core.scene.rows import inert_gaussians

ROW_STEP = 1024
"""The capacity for Gaussians is a multiple of this."""
ROW_HEADROOM = 1.25
MOST_SLOTS = 9
"""Snapshots of one publisher that may be held at a time. A replay needs three, seldom four."""


class SnapshotSlot:
    """Memory for one snapshot. Made and written by `SnapshotSlots`; read inside `Snapshot.reading`."""

    def __init__(self, number: int, device: torch.device, rows: int = 0) -> None:
        """`rows` are the fewest that it has room for from the start."""
        self.number = number
        self._fewest_rows = rows
        self.layout = 0
        """Counts up when the tensors are replaced by larger ones: what was captured for the old ones is void then."""
        self._gaussians: Gaussians | None = None
        self._field: FieldSlot | None = None
        self._count = 0
        self._in_use: list[Tensor] = []
        """The first `_count` rows of every tensor."""
        self._holder: weakref.ref[Snapshot] | None = None
        self._order = _DeviceOrder(device)

    @property
    def gaussians(self) -> Gaussians:
        """All rows. Those beyond the snapshot's count have opacity 0 (a logit of minus infinity) and are in no tile list."""
        assert self._gaussians is not None
        return self._gaussians

    @property
    def field(self) -> DeformationField | None:
        """The field for all rows."""
        return None if self._field is None else self._field.field

    @property
    def parameter_count(self) -> int:
        """Numbers in all tensors of what was written last, without the spare capacity."""
        own = sum(tensor[:1].numel() for tensor in self.gaussians.tensors().values()) * self._count
        return own + (0 if self._field is None else self._field.parameter_count)

    @property
    def is_free(self) -> bool:
        """Whether nobody holds the snapshot that lies here."""
        return self._holder is None or self._holder() is None

    def write(self, gaussians: Gaussians, field: DeformationField | None) -> None:
        """Queue the copy of a scene's state on the current stream, behind what is still to be read from the old one."""
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
        self._field = None if field is None else field.slot(rows)
        self.layout += 1
        written = self._overwrite(gaussians, field)
        assert written, "a new slot has capacity for what it was made for"


class Snapshot:
    """One published state of a scene in a slot. It stays as it is for as long as anybody holds this object.

    Reading threads keep a reference for the time of reading; on a GPU they read inside `reading`.
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
        """Counts up with every snapshot, from 1."""
        self.camera = camera
        """The camera of the recording's first frame."""
        self.time_window_s = time_window_s
        """First and last time that the model has seen; other times show the nearest of these."""
        self.training_digest = training_digest
        self._unseen_s = unseen_s
        self.depth_source = depth_source
        """Where the depth that it was trained on comes from."""
        self.parameter_count = slot.parameter_count
        """Numbers in all tensors, without the slot's spare capacity."""
        self.slot = slot
        self.gaussian_count = slot._count
        self._lock = threading.Lock()
        self._model: Model | None = None

    @property
    def device(self) -> torch.device:
        """Where the slot is."""
        return self.slot.gaussians.device

    @contextmanager
    def reading(self) -> Iterator[SnapshotSlot]:
        """The slot, for what is queued on the current stream inside: after the slot was written, before it is written again."""
        self.slot._order.before_reading()
        try:
            yield self.slot
        finally:
            self.slot._order.after_reading()

    def clamp_time(self, time_s: float) -> float:
        """`time_s` brought into the time window, or into what the field continues after it."""
        return clamp_time(time_s, continued_window(self.time_window_s, self.slot.field))

    def at(self, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`, clamped to the window, in memory of their own."""
        with self.reading() as slot, torch.no_grad():
            gaussians = slot.gaussians
            if slot.field is not None:
                gaussians = slot.field(gaussians, self.clamp_time(time_s))
            return gaussians.map(lambda tensor: tensor[: self.gaussian_count].clone())

    def unseen_s(self) -> Tensor | None:
        """How long each Gaussian had not been seen (`Model.unseen_s`), in memory of its own."""
        if self._unseen_s is None:
            return None
        with self.reading():
            seen = self._unseen_s.clone()
            if seen.is_cuda:
                # It lies in no slot: whoever published it may let go of it before this stream has read it.
                self._unseen_s.record_stream(torch.cuda.current_stream(self.device))
            return seen

    def as_model(self) -> Model:
        """An immutable copy in memory of its own, made when it is first asked for."""
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
    """The slots of one publisher. One thread publishes; any threads hold snapshots."""

    def __init__(self, device: torch.device | str, most: int = MOST_SLOTS, rows: int = 0) -> None:
        """`rows`: Gaussians that every slot has room for from the start; 0: a quarter more than it gets first."""
        self._device = torch.device(device)
        self._rows = rows
        self._most = most
        self._slots: list[SnapshotSlot] = []

    @property
    def count(self) -> int:
        """Slots that were needed so far."""
        return len(self._slots)

    @staticmethod
    def can_hold(field: DeformationField | None) -> bool:
        """Whether snapshots of this kind of field can lie in slots."""
        return field is None or field.slot_type is not None

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
        """Queue a copy of a scene's state on the current stream; the originals may be changed on that stream at once. `unseen_s` is not
        copied and must stay as it is (`Model.unseen_s`).

        Raises InvalidInput when all slots are held, or for a field that cannot lie in one.
        """
        if not self.can_hold(field):
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
    """Orders the writing and the reading of one piece of device memory between streams. On the CPU there is nothing to order."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._written: torch.cuda.Event | None = None
        self._read: dict[int, torch.cuda.Event] = {}
        """The end of the last reading on each stream."""

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
