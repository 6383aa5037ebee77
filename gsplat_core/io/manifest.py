"""Manifest of a model bundle: the description of its tensors, validated before any is read."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from itertools import pairwise
from typing import Any, cast

import numpy as np
import torch

from gsplat_core.deformation.field import DeformationField
from gsplat_core.deformation.kinds import field_from_config, kind_of
from gsplat_core.errors import BundleCorrupt, InvalidInput, InvalidSetting, UnknownFormatVersion
from gsplat_core.models import Model, TrainedBy
from gsplat_core.scene.cameras import CAMERA_MODELS, MAX_INTRINSICS_PX, MIN_FOCAL_PX, Camera, CameraModel
from gsplat_core.scene.frames import DEPTH_ORIGINS, LONGEST_RECORDING_S, DepthError, DepthSource
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, Gaussians
from gsplat_core.value_ranges import IntegerIn, JsonObject, NumberIn, shortened

FORMAT_VERSION = 1
MAX_MANIFEST_BYTES = 1 << 20

# Permitted range of every value, also listed in docs/design/bundle.md.
VERSION = IntegerIn(1, (1 << 53) - 1)
COUNT = IntegerIn(0, 50_000_000)
SH_DEGREE = IntegerIn(0, MAX_SH_DEGREE)
TIME_S = NumberIn(-1e10, 1e10)
LONGEST_WINDOW_S = LONGEST_RECORDING_S
"""Longest time window of a model."""
LONGEST_FIELD_WINDOW_S = 4 * LONGEST_WINDOW_S
"""Longest time window of a deformation field, which may extend beyond the observed window."""
SIDE_PX = IntegerIn(1, 16_384)
MOST_PIXELS = 1 << 26
FOCAL_PX = NumberIn(MIN_FOCAL_PX, MAX_INTRINSICS_PX)
INTRINSICS_PX = NumberIn(-MAX_INTRINSICS_PX, MAX_INTRINSICS_PX)
POSE = NumberIn(-1e9, 1e9)
ROTATION_TOLERANCE = 2e-3
"""Tolerance of the pose's R Rᵀ from the identity (per entry) and of its determinant from 1."""
TENSOR_BYTES = IntegerIn(0, 1 << 40)
PARAMETERS = IntegerIn(0, 1 << 38)
DEPTH_ERROR, MOST_DEPTH_ERRORS = NumberIn(0, 1), 1024
EXTRA_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
MOST_EXTRA = 16
"""Largest number of extra tensors."""
EXTRA_SIDE = IntegerIn(1, 1024)
EXTRA_SIDES = 3
"""Largest number of dimensions of an extra tensor after the first."""
RENDERER_VALUE = NumberIn(0.0, 1e30)
"""Range of a value that a renderer has for the whole scene."""
UNITS = {"length": ("mm",), "time": ("s",)}


@dataclass(frozen=True)
class Manifest:
    """Validated manifest of a model bundle."""

    version: int
    count: int
    sh_degree: int
    field: dict[str, Any] | None
    camera: Camera
    time_window_s: tuple[float, float]
    training_digest: str | None
    tensors_bytes: int
    tensors_sha256: str
    parameters: int | None
    depth_source: DepthSource | None = None
    right_eye: bool = False
    """True if the Gaussians have separate colours for the right eye."""
    trained_by: TrainedBy = dataclass_field(default_factory=TrainedBy)
    extra: Mapping[str, tuple[int, ...]] = dataclass_field(default_factory=dict)
    """Shapes of the extra tensors of a Gaussian by name."""

    def skeleton(self) -> tuple[Gaussians, DeformationField | None]:
        """Return Gaussians and field of the described shapes on the meta device, without memory."""
        with torch.device("meta"):
            n, k = self.count, (self.sh_degree + 1) ** 2
            gaussians = Gaussians(
                torch.empty(n, 3), torch.empty(n, 4), torch.empty(n, 3), torch.empty(n), torch.empty(n, k, 3)
            ).with_right(self.right_eye)
            gaussians = replace(gaussians, extra={name: torch.empty(n, *shape) for name, shape in self.extra.items()})
            return gaussians, None if self.field is None else field_from_config(self.field, gaussians)


def manifest_bytes(model: Model, tensors_bytes: int, tensors_sha256: str) -> bytes:
    """Return the manifest of `model` as JSON."""
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
    """Validate an untrusted manifest.

    Raises:
        UnknownFormatVersion: if a later version wrote it.
        BundleCorrupt: if this version would not write it.
    """
    root = JsonObject.parse(text, name)
    written = root.integer("format_version", IntegerIn(0, (1 << 31) - 1))
    if written != FORMAT_VERSION:
        raise UnknownFormatVersion(
            f"{name} has format version {written}, this program reads {FORMAT_VERSION}; update it or save the model again"
        )
    gaussians, tensors = root.nested("gaussians"), root.nested("tensors")
    if "units" in root.values:
        units = root.nested("units")
        for quantity, known in UNITS.items():
            units.choice(quantity, known)
    return Manifest(
        version=root.integer("version", VERSION),
        count=gaussians.integer("count", COUNT),
        sh_degree=gaussians.integer("sh_degree", SH_DEGREE),
        field=None if root.values.get("field") is None else _field_config(root.nested("field")),
        camera=_camera(root.nested("camera")),
        time_window_s=root.window("time_window_s", TIME_S, LONGEST_WINDOW_S),
        training_digest=None if root.values.get("training_digest") is None else root.digest("training_digest"),
        tensors_bytes=tensors.integer("bytes", TENSOR_BYTES),
        tensors_sha256=tensors.digest("sha256"),
        parameters=root.integer("parameters", PARAMETERS) if "parameters" in root.values else None,
        depth_source=None if root.values.get("depth") is None else _depth_source(root.nested("depth")),
        right_eye=gaussians.boolean("right_eye") if "right_eye" in gaussians.values else False,
        trained_by=_trained_by(root.nested("trained_by")) if "trained_by" in root.values else TrainedBy(),
        extra=_extra_shapes(gaussians.nested("extra")) if "extra" in gaussians.values else {},
    )


def _trained_by(reader: JsonObject) -> TrainedBy:
    renderer, values = reader.values.get("renderer"), reader.nested("values")
    if not isinstance(renderer, str) or not EXTRA_NAME.fullmatch(renderer):
        raise BundleCorrupt(f"{reader.name}: {shortened(renderer)} is no name of a renderer; use a to z, 0 to 9 and _")
    if len(values.values) > MOST_EXTRA:
        raise BundleCorrupt(f"{values.name}: {len(values.values)} values; at most {MOST_EXTRA} are allowed")
    for name in values.values:
        if not EXTRA_NAME.fullmatch(name):
            raise BundleCorrupt(f"{values.name}: {shortened(name)} is no name of a value; use a to z, 0 to 9 and _")
    return TrainedBy(renderer, {name: values.number(name, RENDERER_VALUE) for name in values.values})


def _extra_shapes(reader: JsonObject) -> dict[str, tuple[int, ...]]:
    if len(reader.values) > MOST_EXTRA:
        raise BundleCorrupt(f"{reader.name}: {len(reader.values)} extra tensors; at most {MOST_EXTRA} are allowed")
    for name in reader.values:
        if not EXTRA_NAME.fullmatch(name):
            raise BundleCorrupt(f"{reader.name}: {shortened(name)} is no name of a tensor; use a to z, 0 to 9 and _")
    return {name: reader.integers(name, EXTRA_SIDE, EXTRA_SIDES) for name in reader.values}


def _depth_source(reader: JsonObject) -> DepthSource:
    origin = DEPTH_ORIGINS[reader.choice("origin", tuple(DEPTH_ORIGINS))]
    metric = reader.boolean("metric")
    if metric and not origin.is_metric(eyes_calibrated=True):
        raise BundleCorrupt(f"{reader.name}: depth of origin {origin.name!r} has no unit, and metric is true")
    return DepthSource(origin, metric, _depth_errors(reader) if "errors" in reader.values else ())


def _depth_errors(reader: JsonObject) -> tuple[DepthError, ...]:
    """Return the errors of a model's depth, listed as pairs of time and relative error."""
    listed = reader.values["errors"]
    if not isinstance(listed, list) or not 1 <= len(listed) <= MOST_DEPTH_ERRORS:
        raise BundleCorrupt(
            f"{reader.name}: errors must be a list of 1 to {MOST_DEPTH_ERRORS} pairs, got {shortened(listed)}"
        )
    name = f"{reader.name}: errors"
    pairs = [JsonObject({"time_s": pair[0], "relative": pair[1]}, name) for pair in listed if _is_pair(pair)]
    found = tuple(DepthError(pair.number("time_s", TIME_S), pair.number("relative", DEPTH_ERROR)) for pair in pairs)
    if len(found) != len(listed) or any(second.time_s <= first.time_s for first, second in pairwise(found)):
        raise BundleCorrupt(f"{name} must be pairs of time and relative error in temporal order")
    return found


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2


def _camera(reader: JsonObject) -> Camera:
    model = reader.choice("model", CAMERA_MODELS)
    width_px, height_px = reader.integer("width_px", SIDE_PX), reader.integer("height_px", SIDE_PX)
    if width_px * height_px > MOST_PIXELS:
        raise BundleCorrupt(
            f"{reader.name}: the image is {width_px}x{height_px} px; at most {MOST_PIXELS} pixels are allowed"
        )
    intrinsics = np.array(reader.matrix("K", 3, INTRINSICS_PX))
    pose = np.array(reader.matrix("world_to_camera", 4, POSE))
    try:
        for axis, name in enumerate(("fx", "fy")):
            FOCAL_PX.checked(f"K's {name}", float(intrinsics[axis, axis]))
        _check_rigid(pose)
        return Camera(intrinsics, width_px, height_px, pose, cast(CameraModel, model))
    except InvalidInput as error:
        raise BundleCorrupt(f"{reader.name}: {error}") from error


def _check_rigid(pose: np.ndarray) -> None:
    """Raise InvalidInput unless the upper left 3x3 of a pose is a rotation."""
    # Clipping keeps the products finite. Clipped values are never part of a rotation.
    rotation = np.clip(pose[:3, :3], -2, 2)
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    error = max(error, abs(float(np.linalg.det(rotation)) - 1))
    if error > ROTATION_TOLERANCE:
        raise InvalidInput(
            f"world_to_camera must be a rotation and a translation, but its rotation is off by {error:.3g} (at most"
            f" {ROTATION_TOLERANCE:g})"
        )


def _field_config(reader: JsonObject) -> dict[str, Any]:
    """Return the validated configuration of the field, without unknown keys."""
    reader.window("time_window_s", TIME_S, LONGEST_FIELD_WINDOW_S)
    try:
        return kind_of(reader.values.get("kind")).checked_config(reader.values)
    except (InvalidInput, InvalidSetting) as error:
        raise BundleCorrupt(f"{reader.name}: {error}") from error
