"""Reader of triangle meshes (positions and faces) from `.ply`, `.stl` and `.obj` files.

`.ply` and `.stl` may be ASCII or binary. Faces with more than three corners become triangle fans. Normals, colours and
textures are skipped. Files are untrusted: sizes are validated before memory is allocated, and nothing is executed.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import read_regular
from gsplat_core.io.ply import SCALAR_TYPES

MOST_BYTES = 1 << 30
MOST_HEADER_BYTES = 1 << 16
MOST_COORDINATE = 1e9
MOST_ELEMENTS = 20_000_000
STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])


class TriangleMesh(NamedTuple):
    """Vertex positions and triangles of a mesh."""

    vertices: NDArray[np.float64]
    """Vertex positions [V, 3]."""
    triangles: NDArray[np.int64]
    """Vertex indices of the triangles, [T, 3]; empty for a point cloud."""


def read_surface(path: Path) -> TriangleMesh:
    """Read a mesh.

    Raises:
        InvalidSetting: if the file cannot be used; the message names the file and the defect.
    """
    readers = {".ply": _read_ply, ".stl": _read_stl, ".obj": _read_obj}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InvalidSetting(f"{path.name!r:.80} ends in none of {', '.join(readers)}; give such a mesh")
    try:
        data = read_regular(path, MOST_BYTES)
    except OSError as error:
        raise InvalidSetting(f"cannot read {path}: {error.strerror or error}") from error
    try:
        vertices, triangles = reader(data)
    except OverflowError as error:
        raise InvalidSetting(
            f"{path} is no plain {path.suffix.lower()} mesh: it holds a number that is too large"
        ) from error
    except (ValueError, IndexError, KeyError, TypeError, MemoryError) as error:
        raise InvalidSetting(f"{path} is no plain {path.suffix.lower()} mesh: {error!s:.120}") from error
    if not len(vertices):
        raise InvalidSetting(f"{path} has no vertices")
    if not np.isfinite(vertices).all():
        raise InvalidSetting(f"{path} has vertices that are not finite")
    farthest = float(np.abs(vertices).max())
    if farthest > MOST_COORDINATE:
        raise InvalidSetting(
            f"{path} has a coordinate of {farthest:.3g}; at most {MOST_COORDINATE:g} is taken, export it again in millimetres"
        )
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
        raise InvalidSetting(f"{path} has a triangle with a vertex that is not there; it has {len(vertices)}")
    return TriangleMesh(vertices, triangles)


def _fans(polygons: list[list[int]]) -> NDArray[np.int64]:
    cut = [(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)]
    return np.array(cut, np.int64).reshape(-1, 3)


def _read_obj(data: bytes) -> TriangleMesh:
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in data.decode("utf-8", "replace").splitlines():
        parts = line.split()
        if parts and parts[0] == "v":
            if len(parts) < 4:
                raise ValueError(f"the vertex {line.strip()!r:.60} has fewer than three coordinates")
            vertices.append([float(value) for value in parts[1:4]])
        elif parts and parts[0] == "f":
            # OBJ indices count from 1, or if negative backwards from the newest vertex.
            numbers = [int(corner.split("/")[0]) for corner in parts[1:]]
            polygons.append([number - 1 if number > 0 else len(vertices) + number for number in numbers])
    return TriangleMesh(np.array(vertices, np.float64).reshape(-1, 3), _fans(polygons))


def _read_stl(data: bytes) -> TriangleMesh:
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + count * STL_ROW.itemsize:
        corners = np.frombuffer(data, STL_ROW, count, 84)["corners"].astype(np.float64).reshape(-1, 3)
    else:
        if not data.isascii():
            raise ValueError(f"it has {len(data)} bytes, and {84 + max(count, 0) * STL_ROW.itemsize} by its header")
        words = data.decode("ascii").split()
        at = [k for k, word in enumerate(words) if word == "vertex"]
        corners = np.array([[float(word) for word in words[k + 1 : k + 4]] for k in at], np.float64).reshape(-1, 3)
    if len(corners) % 3 or not len(corners):
        raise ValueError(f"it has {len(corners)} corners, which are no triangles")
    # STL stores the corners of each triangle separately. Merge corners at the same position to one vertex.
    vertices, numbers = np.unique(corners, axis=0, return_inverse=True)
    return TriangleMesh(vertices, numbers.reshape(-1, 3).astype(np.int64))


def _read_ply(data: bytes) -> TriangleMesh:
    end = data.find(b"end_header\n", 0, MOST_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no header")
    lines = [line.split() for line in data[:end].decode("ascii").splitlines()]
    kind, version = next((words[1:] for words in lines if words[:1] == ["format"] and len(words) == 3), ("missing", ""))
    if kind not in ("ascii", "binary_little_endian") or version != "1.0":
        raise ValueError(
            f"its format is {kind} {version}; it must be ascii 1.0 or binary_little_endian 1.0".replace("  ", " ")
        )
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    body = data[end + len(b"end_header\n") :]
    reader = _AsciiPly(body) if kind == "ascii" else _BinaryPly(body)
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for name, count, properties in elements:
        if not 0 <= count <= min(len(body), MOST_ELEMENTS):
            raise ValueError(f"{count} of {name} are more than the file has bytes, or more than {MOST_ELEMENTS}")
        if any(words[0] == "list" for words in properties):
            if len(properties) != 1:
                raise ValueError(f"{name} has further properties beside a list")
            polygons = reader.lists(count, properties[0][1], properties[0][2])
            triangles = _fans(polygons) if name == "face" else triangles
            continue
        columns = reader.rows(count, [(words[1], SCALAR_TYPES[words[0]]) for words in properties])
        if name == "vertex":
            vertices = np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], 1)
    return TriangleMesh(vertices, triangles)


class _AsciiPly:
    def __init__(self, body: bytes) -> None:
        self._words = body.decode("ascii").split()
        self._at = 0

    def _take(self, count: int) -> list[str]:
        taken = self._words[self._at : self._at + max(count, 0)]
        if len(taken) < count or count < 0:
            raise ValueError("it was cut short")
        self._at += count
        return taken

    def rows(self, count: int, columns: list[tuple[str, str]]) -> dict[str, NDArray[np.float64]]:
        values = np.array(self._take(count * len(columns)), np.float64).reshape(count, len(columns))
        return {name: values[:, k] for k, (name, _) in enumerate(columns)}

    def lists(self, count: int, length_type: str, item_type: str) -> list[list[int]]:
        return [[int(word) for word in self._take(int(self._take(1)[0]))] for _ in range(count)]


class _BinaryPly:
    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, 0

    def rows(self, count: int, columns: list[tuple[str, str]]) -> dict[str, NDArray[np.float64]]:
        layout = np.dtype(columns)
        if self._at + count * layout.itemsize > len(self._body):
            raise ValueError("it was cut short")
        rows = np.frombuffer(self._body, layout, count, self._at)
        self._at += rows.nbytes
        return {name: rows[name] for name, _ in columns}

    def lists(self, count: int, length_type: str, item_type: str) -> list[list[int]]:
        length, item = np.dtype(SCALAR_TYPES[length_type]), np.dtype(SCALAR_TYPES[item_type])
        found = []
        for _ in range(count):
            if self._at + length.itemsize > len(self._body):
                raise ValueError("it was cut short")
            (corners,) = np.frombuffer(self._body, length, 1, self._at)
            self._at += length.itemsize
            if corners < 0:
                raise ValueError(f"a list has {corners} items")
            if self._at + item.itemsize * int(corners) > len(self._body):
                raise ValueError("it was cut short")
            found.append(np.frombuffer(self._body, item, int(corners), self._at).tolist())
            self._at += item.itemsize * int(corners)
        return found
