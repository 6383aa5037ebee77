"""Published model: Gaussians, deformation field, camera and time window."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, checked_window
from gsplat_core.errors import InvalidInput
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.surface import Surface, certainty, render_surface
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_source import DepthSource
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.value_ranges import check_seen_at


def clamp_time(time_s: float, window_s: tuple[float, float]) -> float:
    """Clamp `time_s` to the window; NaN is preserved, for the field to reject."""
    start, end = window_s
    return min(max(time_s, start), end) if time_s == time_s else time_s


@dataclass(frozen=True)
class TrainedBy:
    """Renderer whose pictures trained a model. Other renderers may be unable to show the model."""

    renderer: str = "alpha"
    """Name in `RENDERERS`."""
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Values of the renderer for the whole scene, learned or fixed at the start."""


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
    """Canonical Gaussians."""
    field: DeformationField | None
    """Deformation field; None for a static scene."""
    camera: Camera
    """Camera of the recording's first frame."""
    time_window_s: tuple[float, float]
    """First and last observed time in seconds; other times are clamped."""
    training_digest: str | None = None
    """SHA-256 of the training recording, if known."""
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
        """Return all tensors by name: `gaussians.*`, then `field.*` in the field's order."""
        named = {f"gaussians.{name}": tensor for name, tensor in self.gaussians.tensors().items()}
        if self.field is not None:
            named |= {f"field.{name}": tensor for name, tensor in self.field.state_dict(keep_vars=True).items()}
        return named

    @property
    def parameter_count(self) -> int:
        """Total number of parameters."""
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
        """Return everything except tensors and version as JSON-serialisable values."""
        source = self.depth_source
        # Omitted if unknown, which preserves the digest of models of earlier versions.
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
