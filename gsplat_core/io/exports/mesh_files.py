"""Meshes as `.ply` and as binary glTF 2.0.

Colours are those of the picture, lit as the scope lit them; glTF's material says so (KHR_materials_unlit), so that no program lights them again. As with
Gaussians (`glb.py`), values stay in the model's axes, and the node turns and scales them into glTF's.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.mesh import Mesh
from gsplat_core.io.exports.glb import ARRAY_BUFFER, FLOAT, METRES_PER_UNIT, TURN_X, linear, packed
from gsplat_core.io.ply import MARK_LINE

UNLIT = "KHR_materials_unlit"
ELEMENT_ARRAY_BUFFER = 34963
UNSIGNED_SHORT, UNSIGNED_INT = 5123, 5125
TRIANGLES = 4
VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])


def mesh_ply_pieces(mesh: Mesh, unit: str, *, with_triangles: bool) -> Iterator[bytes]:
    """The content of a binary `.ply`: positions, normals, colours in a byte each, and triangles unless it is to be a point cloud."""
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
    """The content of a `.glb`. Raises ExportError where it would be too large."""
    colours = np.full((len(mesh.colours), 4), 65535, "<u2")  # the fourth is opacity
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
