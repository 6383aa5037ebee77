"""Encoders of exported files: Gaussians and meshes as `.splat`, `.ply` and binary glTF 2.0.

`.splat` is the layout of antimatter15's viewer, with 32 bytes per Gaussian. Gaussians in glTF use the extension
KHR_gaussian_splatting (kernel `ellipse`, as ratified by Khronos). Meshes have vertex colours and no lighting.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import ExportError
from gsplat_core.geometry.mesh import Mesh
from gsplat_core.io.ply import MARK_LINE
from gsplat_core.scene.gaussians import SH_C0, Gaussians

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Rows:
    """Activated values of N Gaussians as float32 arrays on the host: standard deviations and opacities, not logarithms and logits."""

    means: Array
    """Centres [N, 3] in world units."""
    rotations: Array
    """Unit quaternions wxyz [N, 4]; quaternions of zero length become the identity."""
    scales: Array
    """Standard deviations [N, 3]."""
    opacities: Array
    """Opacities from 0 to 1, [N]."""
    sh: Array
    """Spherical-harmonics coefficients [N, K, 3]."""


def rows_of(gaussians: Gaussians) -> Rows:
    """Convert Gaussians to activated host arrays.

    Raises:
        ExportError: if a value is not finite.
    """
    raw = {name: tensor.detach().cpu().float().numpy() for name, tensor in gaussians.tensors().items()}
    for name, values in raw.items():
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            raise ExportError(f"{name} holds {bad} values that are NaN or infinite; such a model is not exported")
    with np.errstate(over="ignore"):
        scales = np.exp(raw["log_scales"])
    if not np.isfinite(scales).all():
        raise ExportError("a Gaussian's size is beyond float32; such a model is not exported")
    opacities = gaussians.opacities.detach().cpu().float().numpy()
    return Rows(raw["means"], unit_rotations(raw["quats"]), scales, opacities, raw["sh"])


def unit_rotations(quats: Array) -> Array:
    """Return normalised quaternions wxyz [N, 4]; the identity for those of length zero."""
    # Divide by the largest component first, because squares of small numbers underflow in float32.
    largest = np.abs(quats).max(axis=1, keepdims=True)
    none = largest[:, 0] == 0
    scaled = np.where(none[:, None], np.array([1, 0, 0, 0], np.float32), quats / np.where(largest == 0, 1, largest))
    return np.asarray(scaled / np.linalg.norm(scaled, axis=1, keepdims=True), np.float32)


ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def splat_bytes(rows: Rows) -> bytes:
    """Return the bytes of a `.splat` file."""
    table = np.empty(len(rows.means), ROW)
    table["position"], table["scale"] = rows.means, rows.scales
    colour = np.column_stack([0.5 + SH_C0 * rows.sh[:, 0], rows.opacities])
    table["colour"] = _byte(colour * 255)
    table["rotation"] = _byte(rows.rotations * 128 + 128)
    importance = rows.scales.astype(np.float64).prod(axis=1) * rows.opacities
    return table[np.argsort(-importance, kind="stable")].tobytes()


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


EXTENSION = "KHR_gaussian_splatting"
MOST_SH_DEGREE = 3
FLOAT, UNSIGNED_SHORT = 5126, 5123
ARRAY_BUFFER = 34962
POINTS = 0
TURN_X = [1.0, 0.0, 0.0, 0.0]
"""Quaternion xyzw of a half turn around x, which converts OpenCV axes (y down, z forward) to those of glTF."""
METRES_PER_UNIT = 0.001
MOST_BYTES = 2**32 - 1


def glb_pieces(rows: Rows, name: str, time_s: float) -> Iterator[bytes]:
    """Yield the bytes of a `.glb` file piece by piece.

    Raises:
        ExportError: if the format cannot represent the Gaussians.
    """
    attributes = dict(_attributes(rows))
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for semantic, values in attributes.items():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": ARRAY_BUFFER})
        accessors.append(_accessor(len(accessors), semantic, values))
        offset += values.nbytes
    yield from packed(_document(list(attributes), views, accessors, offset, name, time_s), list(attributes.values()))


def packed(document: dict[str, Any], arrays: list[NDArray[Any]]) -> Iterator[bytes]:
    """Yield a binary glTF file: the JSON document, then the arrays, whose sizes must be multiples of four bytes.

    Raises:
        ExportError: if the file would be too large.
    """
    head = json.dumps(document, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    size = sum(array.nbytes for array in arrays)
    total = 12 + 8 + len(head) + 8 + size
    if total > MOST_BYTES:
        raise ExportError(f"the model takes {total} bytes as .glb, which holds {MOST_BYTES} at most; export it as .ply")
    yield struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(head), b"JSON") + head
    yield struct.pack("<I4s", size, b"BIN\0")
    for array in arrays:
        yield array.tobytes()


def _attributes(rows: Rows) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the glTF vertex attributes of Gaussians: semantic name and array, whose rows are multiples of four bytes."""
    count = len(rows.means)
    if count == 0:
        raise ExportError("the model has no Gaussians; glTF cannot hold an empty one")
    degree = round(rows.sh.shape[1] ** 0.5) - 1
    if degree > MOST_SH_DEGREE:
        raise ExportError(
            f"the model's harmonics are of degree {degree}, and {EXTENSION} holds {MOST_SH_DEGREE} at most; export it as .ply"
        )
    yield "POSITION", rows.means
    yield f"{EXTENSION}:ROTATION", np.ascontiguousarray(rows.rotations[:, [1, 2, 3, 0]])
    yield f"{EXTENSION}:SCALE", rows.scales
    yield f"{EXTENSION}:OPACITY", rows.opacities
    for level in range(degree + 1):
        for n in range(2 * level + 1):
            coefficients = np.ascontiguousarray(rows.sh[:, level * level + n])
            yield f"{EXTENSION}:SH_DEGREE_{level}_COEF_{n}", coefficients
    colours = np.column_stack([linear(np.clip(0.5 + SH_C0 * rows.sh[:, 0], 0, 1)), rows.opacities])
    yield "COLOR_0", np.round(colours * 65535).astype("<u2")


def linear(srgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert sRGB to linear values (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _accessor(view: int, semantic: str, values: NDArray[Any]) -> dict[str, Any]:
    kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
    made: dict[str, Any] = {"bufferView": view, "componentType": FLOAT, "count": len(values), "type": kind}
    if values.dtype.kind == "u":
        made |= {"componentType": UNSIGNED_SHORT, "normalized": True}
    if semantic == "POSITION":
        made |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    return made


def _document(
    semantics: list[str], views: list[Any], accessors: list[Any], size: int, name: str, time_s: float
) -> dict[str, Any]:
    primitive = {
        "mode": POINTS,
        "attributes": {semantic: index for index, semantic in enumerate(semantics)},
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    extras = {"time_s": time_s, "unit": "millimetre where the recording has a scale, else relative"}
    return {
        "asset": {"version": "2.0", "generator": "IntraSplat", "extras": extras},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0, "rotation": TURN_X, "scale": [METRES_PER_UNIT] * 3}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }


UNLIT = "KHR_materials_unlit"
ELEMENT_ARRAY_BUFFER = 34963
UNSIGNED_INT = 5125
TRIANGLES = 4
VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])


def mesh_ply_pieces(mesh: Mesh, unit: str, *, with_triangles: bool) -> Iterator[bytes]:
    """Yield a binary `.ply`: positions, normals, 8-bit colours, and triangles unless a point cloud."""
    names = [
        *(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"uchar {c}" for c in ("red", "green", "blue")),
    ]
    header = ["ply", "format binary_little_endian 1.0", MARK_LINE, f"comment unit {unit}"]
    header += [f"element vertex {len(mesh.vertices)}"]
    header += [f"property {name}" for name in names]
    if with_triangles:
        header += [f"element face {len(mesh.triangles)}", "property list uchar int vertex_indices"]
    yield "\n".join([*header, "end_header", ""]).encode()
    vertices = np.empty(len(mesh.vertices), VERTEX)
    vertices["position"], vertices["normal"], vertices["colour"] = mesh.vertices, mesh.normals, mesh.colours
    yield vertices.tobytes()
    if with_triangles:
        faces = np.empty(len(mesh.triangles), FACE)
        faces["corners"], faces["vertices"] = 3, mesh.triangles
        yield faces.tobytes()


def mesh_glb_pieces(mesh: Mesh, name: str, time_s: float, unit: str) -> Iterator[bytes]:
    """Yield a `.glb` file of a mesh.

    Raises:
        ExportError: if the file would be too large.
    """
    colours = np.full((len(mesh.colours), 4), 65535, "<u2")  # red, green, blue and opacity, which is 1
    colours[:, :3] = np.round(linear((mesh.colours / np.float32(255)).astype(np.float32)) * 65535)
    attributes = {"POSITION": mesh.vertices, "NORMAL": mesh.normals, "COLOR_0": colours}
    arrays: list[NDArray[Any]] = [*attributes.values(), mesh.triangles.astype("<u4").ravel()]
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": ARRAY_BUFFER}
        for start, array in zip(starts, arrays, strict=False)
    ]
    views[-1]["target"] = ELEMENT_ARRAY_BUFFER
    vec3: dict[str, Any] = {"componentType": FLOAT, "count": len(mesh.vertices), "type": "VEC3"}
    bounds = {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    accessors = [
        {"bufferView": 0, **vec3, **bounds},
        {"bufferView": 1, **vec3},
        {**vec3, "bufferView": 2, "componentType": UNSIGNED_SHORT, "normalized": True, "type": "VEC4"},
        {"bufferView": 3, "componentType": UNSIGNED_INT, "count": arrays[-1].size, "type": "SCALAR"},
    ]
    primitive = {"mode": TRIANGLES, "attributes": {n: k for k, n in enumerate(attributes)}, "indices": 3, "material": 0}
    material = {"extensions": {UNLIT: {}}, "pbrMetallicRoughness": {"metallicFactor": 0.0}}
    document = {
        "asset": {"version": "2.0", "generator": "IntraSplat", "extras": {"time_s": time_s, "unit": unit}},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0, "rotation": TURN_X, "scale": [METRES_PER_UNIT] * 3}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    yield from packed(document, arrays)
