"""A strict reader of binary glTF with Gaussians, written from the specifications and not from the writer."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
PARTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
NAME = "KHR_gaussian_splatting"
ALLOWED = {
    f"{NAME}:ROTATION": ("VEC4", {5126, 5120, 5122}),
    f"{NAME}:SCALE": ("VEC3", {5126, 5120, 5122}),
    f"{NAME}:OPACITY": ("SCALAR", {5126, 5121, 5123}),
}


def read_glb(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The document, and the attributes of its only primitive by name; normalised integers as shares of 1."""
    document, binary = opened(data)
    assert document["extensionsUsed"] == [NAME]
    node = document["nodes"][document["scenes"][document["scene"]]["nodes"][0]]
    (primitive,) = document["meshes"][node["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    values = {name: accessor(document, binary, index) for name, index in primitive["attributes"].items()}
    check_gaussians(document, primitive, values)
    return document, values


def read_mesh_glb(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray], np.ndarray]:
    """The document, the attributes of its only primitive by name, and the indices of its triangles."""
    document, binary = opened(data)
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    node = document["nodes"][document["scenes"][document["scene"]]["nodes"][0]]
    (primitive,) = document["meshes"][node["mesh"]]["primitives"]
    assert primitive["mode"] == 4
    assert document["materials"][primitive["material"]]["extensions"] == {"KHR_materials_unlit": {}}
    values = {name: accessor(document, binary, index) for name, index in primitive["attributes"].items()}
    for name, kind in (("POSITION", "VEC3"), ("NORMAL", "VEC3"), ("COLOR_0", "VEC4")):
        assert document["accessors"][primitive["attributes"][name]]["type"] == kind
    assert {"min", "max"} <= document["accessors"][primitive["attributes"]["POSITION"]].keys()
    assert len({len(each) for each in values.values()}) == 1
    assert np.allclose(np.linalg.norm(values["NORMAL"], axis=1), 1, atol=1e-5)
    indices = accessor(document, binary, primitive["indices"], target=34963)
    assert indices.dtype == np.dtype("<u4") and len(indices) % 3 == 0 and indices.max() < len(values["POSITION"])
    return document, values, indices


def opened(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary part."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and binary_size % 4 == 0 and 28 + size + binary_size == len(data)
    binary = data[28 + size :]
    assert document["asset"]["version"] == "2.0"
    assert document["buffers"] == [{"byteLength": len(binary)}]
    return document, binary


def accessor(document: dict[str, Any], binary: bytes, index: int, target: int = 34962) -> np.ndarray:
    about = document["accessors"][index]
    view = document["bufferViews"][about["bufferView"]]
    kind = np.dtype(TYPES[about["componentType"]])
    parts = PARTS[about["type"]]
    start = view["byteOffset"]
    assert view["buffer"] == 0 and view["target"] == target
    assert start % 4 == 0 and parts * kind.itemsize % 4 == 0, "vertex attributes are aligned to four bytes"
    assert view["byteLength"] == about["count"] * parts * kind.itemsize
    assert start + view["byteLength"] <= len(binary)
    values = np.frombuffer(binary, kind, about["count"] * parts, start)
    if parts > 1:
        values = values.reshape(-1, parts)
    for name, found in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
        if name in about:
            np.testing.assert_array_equal(np.float32(about[name]), found)
    if about.get("normalized"):
        return np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1)
    return values


def check_gaussians(document: dict[str, Any], primitive: dict[str, Any], values: dict[str, np.ndarray]) -> None:
    """Check the attributes that KHR_gaussian_splatting requires of a primitive with the kernel `ellipse`."""
    said = primitive["extensions"][NAME]
    assert said["kernel"] == "ellipse" and said["colorSpace"] in ("srgb_rec709_display", "lin_rec709_display")
    assert said.get("projection", "perspective") == "perspective"
    assert said.get("sortingMethod", "cameraDistance") == "cameraDistance"
    for name, (kind, components) in ALLOWED.items():
        about = document["accessors"][primitive["attributes"][name]]
        assert about["type"] == kind and about["componentType"] in components, name
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert (position["type"], position["componentType"]) == ("VEC3", 5126) and {"min", "max"} <= position.keys()
    assert len({len(each) for each in values.values()}) == 1
    assert np.allclose(np.linalg.norm(values[f"{NAME}:ROTATION"], axis=1), 1, atol=1e-5)
    assert (values[f"{NAME}:SCALE"] >= 0).all()
    assert ((values[f"{NAME}:OPACITY"] >= 0) & (values[f"{NAME}:OPACITY"] <= 1)).all()
    harmonics = {name for name in values if ":SH_DEGREE_" in name}
    degrees = {int(name.split("_DEGREE_")[1][0]) for name in harmonics}
    assert degrees == set(range(len(degrees))) and 1 <= len(degrees) <= 4
    expected = {f"{NAME}:SH_DEGREE_{level}_COEF_{n}" for level in degrees for n in range(2 * level + 1)}
    assert harmonics == expected, "a degree is whole or not there"
    for name in harmonics:
        about = document["accessors"][primitive["attributes"][name]]
        assert (about["type"], about["componentType"]) == ("VEC3", 5126)
