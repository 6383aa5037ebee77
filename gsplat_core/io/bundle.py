"""Model bundles: a folder with `model.safetensors` (tensors) and `manifest.json` (their description and the rest).

The tensor file is written in pieces that share the tensors' memory, because
`safetensors.torch.save` copies all of it twice. Loading validates the manifest before any tensor is read, and names,
shapes, sizes and finiteness before a model is built. It follows no link out of the folder.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField
from gsplat_core.deformation.kinds import field_from_config, kind_of
from gsplat_core.errors import BundleCorrupt, BundleError, InvalidInput, InvalidSetting, UnknownFormatVersion
from gsplat_core.io.files import replace_durably, write_durably
from gsplat_core.io.model_files import check_memory, open_model_file
from gsplat_core.models import Model, TrainedBy
from gsplat_core.scene.cameras import CAMERA_MODELS, MAX_INTRINSICS_PX, MIN_FOCAL_PX, Camera, CameraModel
from gsplat_core.scene.frames import DEPTH_ORIGINS, LONGEST_RECORDING_S, DepthError, DepthSource
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, Gaussians
from gsplat_core.value_ranges import IntegerIn, JsonObject, NumberIn, shortened

PIECE_BYTES = 1 << 22
"""Size in bytes of the pieces in which tensors are hashed and written; other threads can run between two pieces."""
ALIGNMENT = 8


def safetensors_pieces(tensors: Mapping[str, Tensor]) -> Iterator[bytes | memoryview]:
    """Yield a safetensors file of contiguous float32 CPU tensors, as `safetensors.torch.save` would."""
    names = sorted(tensors)
    entries, start = {}, 0
    for name in names:
        assert tensors[name].dtype == torch.float32 and tensors[name].is_contiguous()
        end = start + 4 * tensors[name].numel()
        entries[name] = {"dtype": "F32", "shape": list(tensors[name].shape), "data_offsets": [start, end]}
        start = end
    header = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
    header += b" " * (-len(header) % ALIGNMENT)
    yield struct.pack("<Q", len(header)) + header
    for name in names:
        values = tensors[name].numpy().reshape(-1).view(np.uint8).data
        for first in range(0, len(values), PIECE_BYTES):
            yield values[first : first + PIECE_BYTES]


RUN_MODEL = "model"
"""Name of the model's folder inside the folder of a run; named in the error of a user who gives the folder of the run."""
TENSORS, NEXT_TENSORS = "model.safetensors", "model.next.safetensors"
MANIFEST, NEXT_MANIFEST = "manifest.json", "manifest.next.json"
MAX_HEADER_BYTES = 1 << 20


def save_bundle(model: Model, folder: str | Path, *, to_host: Callable[[Tensor], Tensor] = Tensor.cpu) -> None:
    """Write `model` to `folder`, created if missing, atomically replacing a previous bundle.

    The file is written in pieces, so other threads can run in between.

    Args:
        model: model to save.
        folder: bundle folder.
        to_host: function that copies a GPU tensor to host memory.

    Raises:
        InvalidInput: if a tensor is not float32.
        BundleCorrupt: if a tensor contains NaN or infinity.
        BundleError: if the model exceeds the ranges of `docs/design/bundle.md`, or the files cannot
            be written. A previous bundle then stays intact.
    """
    folder = Path(folder)
    tensors = {name: to_host(tensor.detach()).contiguous() for name, tensor in model.tensors().items()}
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32:
            raise InvalidInput(f"a bundle holds float32, but {name} is {tensor.dtype}; convert the model first")
    _check_finite(tensors, f"the model was not saved to {folder}")
    digest, size = hashlib.sha256(), 0
    for piece in safetensors_pieces(tensors):
        digest.update(piece)
        size += len(piece)
    manifest = manifest_bytes(model, size, digest.hexdigest())
    try:
        # Validate the manifest, so that no bundle is written that `load_bundle` would reject.
        parse_manifest(manifest, MANIFEST)
    except BundleCorrupt as error:
        raise BundleError(
            f"the model was not saved to {folder}, because it could not be read again: {error}"
        ) from error
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_durably(folder / NEXT_TENSORS, safetensors_pieces(tensors))
        write_durably(folder / NEXT_MANIFEST, [manifest])
        replace_durably(folder / NEXT_TENSORS, folder / TENSORS)
        replace_durably(folder / NEXT_MANIFEST, folder / MANIFEST)
    except OSError as error:
        raise BundleError(
            f"cannot write the model to {folder}: {error.strerror or error}; free space or choose another folder. What was"
            " there before is unchanged"
        ) from error


def load_bundle(folder: str | Path) -> Model:
    """Load a model and verify all of its content.

    Args:
        folder: bundle folder.

    Raises:
        UnknownFormatVersion: if a later version wrote the bundle.
        BundleCorrupt: for out-of-range values, wrong digest, truncation, wrong tensors, NaN or infinity.
        BundleError: if the file is missing, unreadable, not a regular file, or larger than the available memory.
    """
    folder = Path(folder)
    path = folder / TENSORS
    if os.path.isfile(folder):  # False for unsupported names; opening the file below reports them
        raise BundleError(
            f"{folder} is a file, and a model is a folder with {TENSORS} and {MANIFEST}; give that folder"
        )
    if not os.path.lexists(path) and os.path.isfile(folder / RUN_MODEL / TENSORS):
        raise BundleError(f"{folder} is the folder of a run, whose model is {folder / RUN_MODEL}; give that folder")
    try:
        with open_model_file(path, folder) as file:
            size = os.fstat(file.fileno()).st_size
            manifest = _manifest_for(folder, size)
            _check_size(path, _expected_tensors(path, manifest), file.read(8), size)
            check_memory(path, 2 * size)  # memory for the file's bytes, and for the tensors made from them
            file.seek(0)
            payload = file.read(size)
    except OSError as error:
        raise BundleError(f"cannot read the model in {folder}: {error.strerror or error}; copy it again") from error
    digest = hashlib.sha256(payload).hexdigest()
    if digest != manifest.tensors_sha256:
        manifest = _interrupted_save(folder, size, digest) or _raise_digest(folder, digest, manifest)
    return _model(path, payload, manifest)


def _manifest_for(folder: Path, size: int) -> Manifest:
    """Return the bundle's manifest, or the one of an interrupted replacement if only that fits the size of the tensors."""
    if not (folder / MANIFEST).exists() and (folder / NEXT_MANIFEST).exists():
        return _read_manifest(folder, NEXT_MANIFEST)
    manifest = _read_manifest(folder, MANIFEST)
    if manifest.tensors_bytes == size:
        return manifest
    if (folder / NEXT_MANIFEST).exists():
        following = _read_manifest(folder, NEXT_MANIFEST)
        if following.tensors_bytes == size:
            return following
    raise BundleCorrupt(
        f"{folder / TENSORS} has {size} bytes, its manifest says {manifest.tensors_bytes}; copy the bundle again"
    )


def _interrupted_save(folder: Path, size: int, digest: str) -> Manifest | None:
    if not (folder / NEXT_MANIFEST).exists():
        return None
    following = _read_manifest(folder, NEXT_MANIFEST)
    return following if (following.tensors_bytes, following.tensors_sha256) == (size, digest) else None


def _raise_digest(folder: Path, digest: str, manifest: Manifest) -> Manifest:
    raise BundleCorrupt(
        f"{folder / TENSORS} has SHA-256 {digest}, its manifest says {manifest.tensors_sha256}; it was changed or damaged,"
        " copy the bundle again"
    )


def _read_manifest(folder: Path, name: str) -> Manifest:
    path = folder / name
    with open_model_file(path, folder) as file:
        text = file.read(MAX_MANIFEST_BYTES + 1)
    if len(text) > MAX_MANIFEST_BYTES:
        raise BundleCorrupt(f"{path} is larger than {MAX_MANIFEST_BYTES} bytes; it is not a manifest")
    return parse_manifest(text, str(path))


def _skeleton(path: Path, manifest: Manifest) -> tuple[Gaussians, DeformationField | None]:
    try:
        return manifest.skeleton()
    # torch raises RuntimeError for a shape with more elements than it supports
    except (InvalidInput, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise BundleCorrupt(f"the manifest of {path} describes no valid model: {reason}") from error


def _expected_tensors(path: Path, manifest: Manifest) -> dict[str, Tensor]:
    """Return the tensors described by a manifest, on the meta device."""
    gaussians, field = _skeleton(path, manifest)
    expected = {f"gaussians.{name}": tensor for name, tensor in gaussians.tensors().items()}
    if field is not None:
        expected |= {f"field.{name}": tensor for name, tensor in field.state_dict().items()}
    parameters = sum(tensor.numel() for tensor in expected.values())
    if manifest.parameters not in (None, parameters):
        raise BundleCorrupt(f"the manifest of {path} says {manifest.parameters} parameters, and describes {parameters}")
    return expected


def _model(path: Path, payload: bytes, manifest: Manifest) -> Model:
    gaussians, field = _skeleton(path, manifest)
    expected = _expected_tensors(path, manifest)
    _check_size(path, expected, payload[:8], len(payload))
    try:
        tensors = safetensors.torch.load(payload)
    except (safetensors.SafetensorError, ValueError, KeyError, AssertionError, RuntimeError) as error:
        raise BundleCorrupt(f"{path} is not a safetensors file ({error}); copy the bundle again") from error
    _check_tensors(path, tensors, expected)
    _check_finite(tensors, f"{path} cannot be used")
    loaded = Gaussians.from_tensors({name: tensors[f"gaussians.{name}"] for name in gaussians.tensors()})
    if field is not None:
        field.load_state_dict(
            {name.removeprefix("field."): t for name, t in tensors.items() if name.startswith("field.")}, assign=True
        )
        field.requires_grad_(False)
        try:
            field.check_state()
        except InvalidInput as error:
            raise BundleCorrupt(f"{path} cannot be used: {error}") from error
    return Model(
        manifest.version,
        loaded,
        field,
        manifest.camera,
        manifest.time_window_s,
        training_digest=manifest.training_digest,
        depth_source=manifest.depth_source,
        trained_by=manifest.trained_by,
    )


def _check_size(path: Path, expected: dict[str, Tensor], start: bytes, size: int) -> None:
    """Check the file size against the manifest and the header length, before the header and the tensors are read.

    A safetensors file consists of eight bytes with the header's length, the JSON header, and the tensors without gaps.
    """
    if len(start) < 8:
        raise BundleCorrupt(f"{path} has only {size} bytes; copy the bundle again")
    (header,) = struct.unpack("<Q", start)
    if header > min(size - 8, MAX_HEADER_BYTES):
        raise BundleCorrupt(
            f"{path} states a header of {header} bytes; the file has {size}, and at most {MAX_HEADER_BYTES} are allowed"
        )
    needed = 4 * sum(tensor.numel() for tensor in expected.values())
    if size != 8 + header + needed:
        raise BundleCorrupt(
            f"{path} holds {size - 8 - header} bytes of tensors, but the manifest describes {needed}; copy the bundle again"
        )


def _check_tensors(path: Path, tensors: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    missing, unknown = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or unknown:
        raise BundleCorrupt(
            f"{path} does not match its manifest: missing {', '.join(missing[:5]) or 'nothing'}, unknown"
            f" {', '.join(name[:80] for name in unknown[:5]) or 'nothing'}"
        )
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32 or tensor.shape != expected[name].shape:
            raise BundleCorrupt(
                f"{path}: {name} must be float32 {list(expected[name].shape)}, got {tensor.dtype} {list(tensor.shape)}"
            )


def _check_finite(tensors: dict[str, Tensor], consequence: str) -> None:
    for name, tensor in tensors.items():
        # A sum is finite only if all terms are. Check the terms of a non-finite sum, because finite terms can overflow.
        if not bool(torch.isfinite(tensor.sum())):
            bad = int((~torch.isfinite(tensor)).sum())
            if bad:
                raise BundleCorrupt(
                    f"{consequence}: {name} holds {bad} of {tensor.numel()} values that are NaN or infinite; go back to an"
                    " earlier version of the model"
                )


FORMAT_VERSION = 1
MAX_MANIFEST_BYTES = 1 << 20

# Permitted range of every value, also listed in docs/design/bundle.md.
VERSION = IntegerIn(1, (1 << 53) - 1)
COUNT = IntegerIn(0, 50_000_000)
SH_DEGREE = IntegerIn(0, MAX_SH_DEGREE)
TIME_S = NumberIn(-1e10, 1e10)
LONGEST_WINDOW_S = LONGEST_RECORDING_S
"""Longest accepted time window of a model, in seconds."""
LONGEST_FIELD_WINDOW_S = 4 * LONGEST_WINDOW_S
"""Longest accepted time window of a deformation field in seconds; it may extend beyond the observed window."""
SIDE_PX = IntegerIn(1, 16_384)
MOST_PIXELS = 1 << 26
FOCAL_PX = NumberIn(MIN_FOCAL_PX, MAX_INTRINSICS_PX)
INTRINSICS_PX = NumberIn(-MAX_INTRINSICS_PX, MAX_INTRINSICS_PX)
POSE = NumberIn(-1e9, 1e9)
ROTATION_TOLERANCE = 2e-3
"""Largest deviation of R Rᵀ from the identity (per element), and of the determinant from 1, for the rotation R of a pose."""
TENSOR_BYTES = IntegerIn(0, 1 << 40)
PARAMETERS = IntegerIn(0, 1 << 38)
DEPTH_ERROR, MOST_DEPTH_ERRORS = NumberIn(0, 1), 1024
EXTRA_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
MOST_EXTRA = 16
"""Largest number of extra tensors (`Gaussians.extra`) in a bundle."""
EXTRA_SIDE = IntegerIn(1, 1024)
EXTRA_SIDES = 3
"""Largest number of dimensions of an extra tensor, not counting the dimension of the Gaussians."""
RENDERER_VALUE = NumberIn(0.0, 1e30)
"""Accepted range of a renderer parameter that applies to the whole scene (`TrainedBy.values`)."""
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
    """Shapes of the extra tensors (`Gaussians.extra`) by name, without the dimension of the Gaussians."""

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
