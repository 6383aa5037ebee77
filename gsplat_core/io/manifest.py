"""The manifest of a model bundle: what is in the tensor file, checked value by value before any tensor is read."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, cast

import torch

from gsplat_core.deformation import DeformationField, field_from_config
from gsplat_core.errors import BundleCorrupt, InvalidInput, UnknownFormatVersion
from gsplat_core.scene.cameras import CAMERA_MODELS, Camera, CameraModel
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, Gaussians
from gsplat_core.scene.model import Model

FORMAT_VERSION = 1
MAX_MANIFEST_BYTES = 1 << 20
MAX_GAUSSIANS = 50_000_000
MAX_ARCHITECTURE_SIZE = 1 << 16
"""Largest size of any one axis of a field (bumps, grid cells, channels, widths, layers)."""


@dataclass(frozen=True)
class Manifest:
    """A manifest whose values have been checked."""

    version: int
    count: int
    sh_degree: int
    field: dict[str, Any] | None
    camera: Camera
    time_window_s: tuple[float, float]
    training_digest: str | None
    tensors_bytes: int
    tensors_sha256: str

    def skeleton(self) -> tuple[Gaussians, DeformationField | None]:
        """Gaussians and field of the described shapes on the meta device: no memory is taken for them."""
        with torch.device("meta"):
            n, k = self.count, (self.sh_degree + 1) ** 2
            gaussians = Gaussians(
                torch.empty(n, 3), torch.empty(n, 4), torch.empty(n, 3), torch.empty(n), torch.empty(n, k, 3)
            )
            return gaussians, None if self.field is None else field_from_config(self.field, gaussians)


def manifest_bytes(model: Model, tensors_bytes: int, tensors_sha256: str) -> bytes:
    """The manifest of `model` as JSON text."""
    manifest = {
        "format_version": FORMAT_VERSION,
        "version": model.version,
        **model.description(),
        "units": {"length": "mm", "time": "s"},
        "parameters": model.parameter_count,
        "tensors": {"bytes": tensors_bytes, "sha256": tensors_sha256},
    }
    return (json.dumps(manifest, indent=2, allow_nan=False) + "\n").encode()


def parse_manifest(text: bytes, name: str) -> Manifest:
    """Check a manifest that may come from anyone.

    Raises UnknownFormatVersion for a later version, BundleCorrupt for anything that this version does not write.
    """
    try:
        values = json.loads(text.decode(), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise BundleCorrupt(f"{name} is not valid JSON ({error}); copy the bundle again") from error
    root = _Reader(values, name)
    written = root.integer("format_version", 0, 1 << 31)
    if written != FORMAT_VERSION:
        raise UnknownFormatVersion(
            f"{name} has format version {written}, this program reads {FORMAT_VERSION}; update it or save the model again"
        )
    gaussians, tensors = root.nested("gaussians"), root.nested("tensors")
    window = root.numbers("time_window_s", 2)
    if window[0] > window[1]:
        raise BundleCorrupt(f"{name}: time_window_s must be in order, got {window}")
    field = None if root.values.get("field") is None else root.nested("field")
    return Manifest(
        version=root.integer("version", 1, 1 << 53),
        count=gaussians.integer("count", 0, MAX_GAUSSIANS),
        sh_degree=gaussians.integer("sh_degree", 0, MAX_SH_DEGREE),
        field=None if field is None else _field_config(field),
        camera=_camera(root.nested("camera")),
        time_window_s=(window[0], window[1]),
        training_digest=root.digest("training_digest", optional=True),
        tensors_bytes=tensors.integer("bytes", 0, 1 << 50),
        tensors_sha256=cast(str, tensors.digest("sha256")),
    )


def _refuse_constant(value: str) -> None:
    raise ValueError(f"{value} is not a number of JSON")


def _camera(reader: _Reader) -> Camera:
    model = reader.values.get("model")
    if model not in CAMERA_MODELS:
        raise BundleCorrupt(f"{reader.name}: model must be one of {', '.join(CAMERA_MODELS)}, got {model!r:.80}")
    try:
        return Camera(
            K=[reader.numbers("K", 3, row) for row in range(3)],  # type: ignore[arg-type]  # made an array by Camera
            width_px=reader.integer("width_px", 1, 1 << 16),
            height_px=reader.integer("height_px", 1, 1 << 16),
            world_to_camera=[reader.numbers("world_to_camera", 4, row) for row in range(4)],  # type: ignore[arg-type]
            model=cast(CameraModel, model),
        )
    except InvalidInput as error:
        raise BundleCorrupt(f"{reader.name}: {error}") from error


def _field_config(reader: _Reader) -> dict[str, Any]:
    """The architecture with every size bounded; unknown names are dropped."""
    kind = reader.values.get("kind")
    window = reader.numbers("time_window_s", 2)
    if window[0] > window[1]:
        raise BundleCorrupt(f"{reader.name}: time_window_s must be in order, got {window}")
    config: dict[str, Any] = {"kind": kind, "time_window_s": window}
    if kind == "basis":
        config |= reader.sizes("bumps", "channels")
        config |= {name: reader.number(name) for name in ("origin_s", "spacing_s")}
    elif kind == "hexplane":
        config |= reader.sizes("channels", "width", "depth")
        config |= {"resolution": reader.integers("resolution", 4, 4), "levels": reader.integers("levels", 1, 16)}
        if max(config["resolution"]) * max(config["levels"]) > MAX_ARCHITECTURE_SIZE or config["depth"] > 64:
            raise BundleCorrupt(f"{reader.name}: the field is larger than this program allows: {config}")
    else:
        raise BundleCorrupt(f"{reader.name}: unknown deformation field {kind!r:.80}; known are basis and hexplane")
    return config


class _Reader:
    """One JSON object, read by name and type; anything else is BundleCorrupt with the place and the value."""

    def __init__(self, values: object, name: str) -> None:
        if not isinstance(values, dict):
            raise BundleCorrupt(f"{name} must be a JSON object, got {values!r:.80}")
        self.values, self.name = values, name

    def nested(self, key: str) -> _Reader:
        return _Reader(self.values.get(key), f"{self.name}: {key}")

    def integer(self, key: str, low: int, high: int) -> int:
        return self._integer(key, self.values.get(key), low, high)

    def sizes(self, *keys: str) -> dict[str, int]:
        return {key: self.integer(key, 1, MAX_ARCHITECTURE_SIZE) for key in keys}

    def integers(self, key: str, shortest: int, longest: int) -> list[int]:
        values = self.values.get(key)
        if not isinstance(values, list) or not shortest <= len(values) <= longest:
            raise BundleCorrupt(f"{self.name}: {key} must be {shortest} to {longest} integers, got {values!r:.80}")
        return [self._integer(key, value, 1, MAX_ARCHITECTURE_SIZE) for value in values]

    def number(self, key: str) -> float:
        return self._number(key, self.values.get(key))

    def numbers(self, key: str, count: int, row: int | None = None) -> list[float]:
        values = self.values.get(key)
        if row is not None:
            values = values[row] if isinstance(values, list) and len(values) == count else None
        if not isinstance(values, list) or len(values) != count:
            raise BundleCorrupt(f"{self.name}: {key} must hold {count} numbers (a row), got {values!r:.80}")
        return [self._number(key, value) for value in values]

    def digest(self, key: str, *, optional: bool = False) -> str | None:
        value = self.values.get(key)
        if value is None and optional:
            return None
        if not isinstance(value, str) or len(value) != 64 or set(value) - set("0123456789abcdef"):
            raise BundleCorrupt(f"{self.name}: {key} must be a SHA-256 in lower-case hexadecimal, got {value!r:.80}")
        return value

    def _integer(self, key: str, value: object, low: int, high: int) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise BundleCorrupt(f"{self.name}: {key} must be an integer in {low}..{high}, got {value!r:.80}")
        return value

    def _number(self, key: str, value: object) -> float:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise BundleCorrupt(f"{self.name}: {key} must hold finite numbers, got {value!r:.80}")
        return float(value)
