"""Gaussians as binary glTF 2.0 with the extension KHR_gaussian_splatting (kernel `ellipse`, as ratified by Khronos).

One primitive of points. Its attributes are float32 and what the extension's kernel asks for: rotation x, y, z, w of length 1, scale linear, opacity 0 to 1,
harmonics coefficient by coefficient, in the colour space `srgb_rec709_display`, which pictures are trained in. COLOR_0 (linear, as glTF has it) is for
programs that show plain points. The values stay in the model's axes; the node turns them from x right, y down, z forward into glTF's x right, y up, z
backward, and scales millimetres to metres, so that harmonics need not be rotated.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import ExportError
from gsplat_core.io.exports.rows import Rows
from gsplat_core.scene.gaussians import SH_C0

EXTENSION = "KHR_gaussian_splatting"
MOST_SH_DEGREE = 3
FLOAT, UNSIGNED_SHORT = 5126, 5123
ARRAY_BUFFER = 34962
POINTS = 0
TURN_X = [1.0, 0.0, 0.0, 0.0]
"""Half a turn round x, as x, y, z, w."""
METRES_PER_UNIT = 0.001
MOST_BYTES = 2**32 - 1


def glb_pieces(rows: Rows, name: str, time_s: float) -> Iterator[bytes]:
    """The file's content, piece by piece. Raises ExportError for what the format cannot hold."""
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
    """A binary glTF file: the document, then the arrays one behind the other, each a multiple of four bytes. Raises ExportError for one too large."""
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
    """By name; each row is a multiple of four bytes long."""
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
    """sRGB without its transfer curve (IEC 61966-2-1)."""
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
