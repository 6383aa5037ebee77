"""Model bundles: a folder with `model.safetensors` (tensors) and `manifest.json` (the rest).

The tensor file is written in pieces that share the tensors' memory, because
`safetensors.torch.save` copies all of it twice. Loading validates names, shapes, sizes and
finiteness before a model is built, and follows no link out of the folder.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField
from gsplat_core.errors import BundleCorrupt, BundleError, InvalidInput
from gsplat_core.io.files import replace_durably, write_durably
from gsplat_core.io.manifest import MAX_MANIFEST_BYTES, Manifest, manifest_bytes, parse_manifest
from gsplat_core.io.model_files import check_memory, open_model_file
from gsplat_core.models import Model
from gsplat_core.scene.gaussians import Gaussians

PIECE_BYTES = 1 << 22
"""Piece size in bytes for hashing and writing; other threads run between two pieces."""
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
    if os.path.isfile(folder):  # False for impossible names, which the open below reports
        raise BundleError(
            f"{folder} is a file, and a model is a folder with {TENSORS} and {MANIFEST}; give that folder"
        )
    try:
        with open_model_file(path, folder) as file:
            size = os.fstat(file.fileno()).st_size
            manifest = _manifest_for(folder, size)
            _check_size(path, _expected_tensors(path, manifest), file.read(8), size)
            check_memory(path, 2 * size)  # the file's bytes, and the tensors made from them
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
        # A sum is finite only if all terms are, unless it overflows. Check the terms in that case.
        if not bool(torch.isfinite(tensor.sum())):
            bad = int((~torch.isfinite(tensor)).sum())
            if bad:
                raise BundleCorrupt(
                    f"{consequence}: {name} holds {bad} of {tensor.numel()} values that are NaN or infinite; go back to an"
                    " earlier version of the model"
                )
