"""Gaussians as `.ply`, in the layout of the INRIA trainer that viewers and editors read, or in the compressed layout.

An INRIA file has one `vertex` element, binary little endian, with `float` properties: x y z nx ny nz f_dc_0..2 f_rest_*
opacity scale_0..2 rot_0..3. Opacity is a logit, scales are logarithms, rotations are wxyz. `f_rest_*` is channel-major:
all higher coefficients of red, then of green, then of blue. Normals are written as zero and ignored when read.

The compressed layout of PlayCanvas and SuperSplat takes 16 bytes per Gaussian, plus one byte per coefficient. Rows are
grouped into chunks of 256. The element `chunk` has the bounds of position, log-scale and colour of each chunk as floats.
The element `vertex` has four `uint` properties: `packed_position` and `packed_scale` (11, 10 and 11 bits between the
bounds), `packed_rotation` (index of the largest component of wxyz, then the other three with 10 bits), `packed_color`
(red, green, blue, opacity, 8 bits each). The optional element `sh` has the higher harmonics, channel-major, as `uchar`
from -4 to 4. Early files have no colour bounds; their colours are between 0 and 1.

Files are read and written in blocks of rows, so the memory beside the tensors does not grow with the file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, ExportError
from gsplat_core.io.files import replace_durably, write_durably
from gsplat_core.io.model_files import (
    BLOCK_BYTES,
    check_memory,
    gaussians_of,
    logit_of_bytes,
    open_model_file,
    read_rows,
)
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, SH_C0, Gaussians, require_gaussians

POSITION, COLOUR = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1))
"""Number of `f_rest_*` properties by SH degree."""


def save_ply(gaussians: Gaussians, path: str | Path) -> None:
    """Write Gaussians to a `.ply` file atomically.

    Raises:
        OSError: if it cannot be written.
    """
    require_gaussians("save_ply", gaussians)
    path = Path(path)
    draft = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    write_durably(draft, ply_pieces(gaussians))
    replace_durably(draft, path)


def ply_pieces(gaussians: Gaussians) -> Iterator[bytes]:
    """Yield a `.ply` file: the header, then blocks of rows."""
    g = {name: t.detach().cpu().to(torch.float32).numpy() for name, t in gaussians.tensors().items()}
    rest = 3 * (g["sh"].shape[1] - 1)
    names = [*POSITION, "nx", "ny", "nz", *COLOUR, *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", *SCALE, *ROTATION]
    yield "\n".join(header_lines([("vertex", gaussians.count, [f"float {name}" for name in names])])).encode()
    step = max(1, BLOCK_BYTES // (4 * len(names)))
    for first in range(0, gaussians.count, step):
        block = {name: values[first : first + step] for name, values in g.items()}
        table = np.zeros((len(block["means"]), len(names)), "<f4")
        table[:, 0:3], table[:, 6:9] = block["means"], block["sh"][:, 0]
        table[:, 9 : 9 + rest].reshape(len(table), 3, rest // 3)[:] = block["sh"][:, 1:].transpose(0, 2, 1)
        table[:, 9 + rest], table[:, 10 + rest : 13 + rest] = block["logit_opacities"], block["log_scales"]
        table[:, 13 + rest :] = block["quats"]
        yield table.tobytes()


def load_ply(path: str | Path) -> Gaussians:
    """Read Gaussians of SH degree 0 to 4; unused properties are skipped.

    The compressed layout is recognised by its header.

    Raises:
        BundleCorrupt: if the file has another format, is truncated, or contains NaN or infinity.
        BundleError: if it is missing, not a regular file, or larger than the available memory.
    """
    path = Path(path)
    with open_model_file(path) as file:
        elements = read_header(file, path)
        start = file.tell()
        needed, left = sum(each.nbytes for each in elements), os.fstat(file.fileno()).st_size - start
        if left < needed:
            raise BundleCorrupt(
                f"{path}: {elements[-1].count} Gaussians take {needed} bytes, only {left} follow the header; the file was cut short"
            )
        if elements[0].name == "chunk":
            return read_compressed(file.fileno(), path, elements, start)
        return _read_inria(file.fileno(), path, elements[0], start)


def _read_inria(descriptor: int, path: Path, vertices: Element, start: int) -> Gaussians:
    rest_count = sum(name.startswith("f_rest_") for name in vertices.names)
    rest = tuple(f"f_rest_{i}" for i in range(rest_count))
    used = (*POSITION, *COLOUR, *rest, "opacity", *SCALE, *ROTATION)
    missing = [name for name in used if name not in vertices.names]
    if missing:
        raise BundleCorrupt(
            f"{path}: no property {', '.join(missing[:5])}; it is not a file of Gaussians in the INRIA layout"
        )
    if rest_count not in REST_COUNTS:
        raise BundleCorrupt(
            f"{path}: {rest_count} f_rest properties; SH degrees 0 to {MAX_SH_DEGREE} have {REST_COUNTS}"
        )
    count = vertices.count
    check_memory(path, 4 * len(used) * count)
    means, quats, log_scales = (np.empty((count, width), np.float32) for width in (3, 4, 3))
    logits, sh = np.empty(count, np.float32), np.empty((count, 1 + rest_count // 3, 3), np.float32)
    at = {group: _columns(vertices.names, group) for group in (POSITION, ROTATION, SCALE, COLOUR, rest, ("opacity",))}

    def take(first: int, rows: NDArray[np.void]) -> None:
        table, end = _float_table(rows), first + len(rows)
        if not np.isfinite(table).all():
            _check_finite(table, vertices.names, used, path, first)
        means[first:end], quats[first:end] = table[:, at[POSITION]], table[:, at[ROTATION]]
        log_scales[first:end], logits[first:end] = table[:, at[SCALE]], table[:, at[("opacity",)]][:, 0]
        sh[first:end, 0] = table[:, at[COLOUR]]
        if rest:
            sh[first:end, 1:] = table[:, at[rest]].reshape(len(rows), 3, -1).transpose(0, 2, 1)

    read_rows(descriptor, path, start, vertices.layout, count, take)
    return gaussians_of(means, quats, log_scales, logits, sh)


def _columns(names: Sequence[str], wanted: Sequence[str]) -> slice | list[int]:
    """Return the column numbers of the wanted names: a slice if they are consecutive."""
    numbers = [names.index(name) for name in wanted]
    if numbers and numbers == list(range(numbers[0], numbers[0] + len(numbers))):
        return slice(numbers[0], numbers[0] + len(numbers))
    return numbers


def _float_table(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Return all properties of N rows as the columns of a table [N, P], without a copy if all are float32."""
    names = rows.dtype.names or ()
    if all(rows.dtype[name] == np.dtype("<f4") for name in names):
        return rows.view("<f4").reshape(len(rows), len(names))
    table = np.empty((len(rows), len(names)), np.float32)
    for i, name in enumerate(names):
        # A double beyond the range of float32 becomes infinite; non-finite values are rejected afterwards.
        with np.errstate(over="ignore"):
            table[:, i] = rows[name]
    return table


def _check_finite(
    table: NDArray[np.float32], names: Sequence[str], used: Sequence[str], path: Path, first: int
) -> None:
    for name in used:
        bad = int(np.count_nonzero(~np.isfinite(table[:, names.index(name)])))
        if bad:
            raise BundleCorrupt(
                f"{path}: property {name} holds {bad} of {len(table)} values that are NaN or infinite, from row {first} on; export it again"
            )


CHUNK = 256
"""Number of consecutive Gaussians of a compressed file that share the bounds of their values."""
BOUNDS = [
    *(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
]
WITHOUT_COLOUR = 12
"""Number of bounds per chunk in early compressed files, which have none for colours: those of position and log-scale."""
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
COMPRESSED_REST_COUNTS = REST_COUNTS[1:4]
"""Numbers of `sh` properties of SH degrees 1 to 3."""
MOST_SH = 4.0
MOST_LOG_SCALE = 20.0
MOST_BOUND = 1e30


def read_compressed(descriptor: int, path: Path, elements: list[Element], start: int) -> Gaussians:
    """Read the rows of a compressed `.ply`.

    Args:
        descriptor: open file.
        path: name for messages.
        elements: elements of its header.
        start: offset of the first row in bytes. The caller has compared the file's size with the header.

    Raises:
        BundleCorrupt: if the elements are not those of the layout, or bounds are not finite.
        BundleError: if the file needs more memory than is available.
    """
    chunks, vertices = elements[0], elements[1]
    harmonics = elements[2] if len(elements) > 2 else None
    _check_layout(path, chunks, vertices, harmonics)
    count, rest = vertices.count, 0 if harmonics is None else len(harmonics.names)
    check_memory(path, count * 4 * (14 + rest) + chunks.nbytes)
    bounds = np.zeros((chunks.count, len(BOUNDS)), np.float32)
    bounds[:, 15:18] = 1  # maximum of colours in early files without colour bounds; the minimum is 0

    def take_bounds(first: int, rows: NDArray[np.void]) -> None:
        for i, name in enumerate(chunks.names):
            bounds[first : first + len(rows), i] = rows[name]

    read_rows(descriptor, path, start, chunks.layout, chunks.count, take_bounds)
    bad = int(np.count_nonzero(~(np.abs(bounds) < MOST_BOUND)))
    if bad:
        raise BundleCorrupt(
            f"{path}: {bad} bounds of its chunks are NaN, infinite or beyond {MOST_BOUND:g}; export it again"
        )
    means, quats, log_scales = (np.empty((count, width), np.float32) for width in (3, 4, 3))
    logits, sh = np.empty(count, np.float32), np.empty((count, 1 + rest // 3, 3), np.float32)

    def take(first: int, rows: NDArray[np.void]) -> None:
        end = first + len(rows)
        of_rows = bounds[np.arange(first, end) // CHUNK]
        means[first:end] = _between(of_rows[:, 0:6], _unpacked_11_10_11(rows["packed_position"]))
        log_scales[first:end] = _between(of_rows[:, 6:12], _unpacked_11_10_11(rows["packed_scale"]))
        quats[first:end] = _unpacked_rotation(rows["packed_rotation"])
        colour = np.stack([(rows["packed_color"] >> shift) & 255 for shift in (24, 16, 8, 0)], 1)
        sh[first:end, 0] = (_between(of_rows[:, 12:18], (colour[:, :3] / 255.0).astype(np.float32)) - 0.5) / SH_C0
        logits[first:end] = logit_of_bytes(colour[:, 3])

    read_rows(descriptor, path, start + chunks.nbytes, vertices.layout, count, take)
    if harmonics is not None:

        def take_harmonics(first: int, rows: NDArray[np.void]) -> None:
            stored = rows.view(np.uint8).reshape(len(rows), 3, rest // 3)
            values = np.array([0, *((np.arange(1, 255) + 0.5) / 256), 1], np.float32)
            sh[first : first + len(rows), 1:] = ((values - 0.5) * (2 * MOST_SH))[stored].transpose(0, 2, 1)

        at = start + chunks.nbytes + vertices.nbytes
        read_rows(descriptor, path, at, harmonics.layout, count, take_harmonics)
    return gaussians_of(means, quats, log_scales, logits, sh)


def _check_layout(path: Path, chunks: Element, vertices: Element, harmonics: Element | None) -> None:
    if list(chunks.names) not in (BOUNDS, BOUNDS[:WITHOUT_COLOUR]) or not _all(chunks, "<f4"):
        raise BundleCorrupt(
            f"{path}: the chunks have the properties {', '.join(chunks.names)[:120]}, not the {len(BOUNDS)} bounds of a compressed ply"
        )
    if list(vertices.names) != PACKED or not _all(vertices, "<u4"):
        raise BundleCorrupt(
            f"{path}: the vertices have the properties {', '.join(vertices.names)[:120]}, not uint {', '.join(PACKED)}"
        )
    if chunks.count != -(-vertices.count // CHUNK):
        raise BundleCorrupt(
            f"{path}: {chunks.count} chunks for {vertices.count} Gaussians; {-(-vertices.count // CHUNK)} of {CHUNK} are expected"
        )
    if harmonics is None:
        return
    names = [f"f_rest_{i}" for i in range(len(harmonics.names))]
    if harmonics.count != vertices.count or len(names) not in COMPRESSED_REST_COUNTS or list(harmonics.names) != names:
        raise BundleCorrupt(
            f"{path}: harmonics of {harmonics.count} Gaussians with {len(names)} properties; {vertices.count} with {', '.join(map(str, COMPRESSED_REST_COUNTS))} are expected"
        )
    if not _all(harmonics, "u1"):
        raise BundleCorrupt(f"{path}: the harmonics are not of the type uchar; export it again")


def _all(element: Element, kind: str) -> bool:
    return all(element.layout[name] == np.dtype(kind) for name in element.names)


def _between(bounds: NDArray[np.float32], share: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return values at the share (0 to 1) between the minima (first three columns of `bounds`) and the maxima of their chunks."""
    return np.asarray(bounds[:, :3] * (1 - share) + bounds[:, 3:] * share, np.float32)


def _unpacked_11_10_11(packed: NDArray[np.uint32]) -> NDArray[np.float32]:
    steps = np.stack([packed >> 21, (packed >> 11) & 1023, packed & 2047], 1).astype(np.float32)
    return np.asarray(steps / np.array([2047, 1023, 2047], np.float32), np.float32)


def _unpacked_rotation(packed: NDArray[np.uint32]) -> NDArray[np.float32]:
    stored = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], 1).astype(np.float32)
    three = (stored / 1023 - 0.5) * np.float32(np.sqrt(2))
    largest = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    which = packed >> 30
    columns = [
        np.where(which == j, largest, np.where(which > j, three[:, min(j, 2)], three[:, max(j - 1, 0)]))
        for j in range(4)
    ]
    return np.stack(columns, 1)


def compressed_ply_pieces(gaussians: Gaussians) -> Iterator[bytes]:
    """Yield a compressed `.ply` of Gaussians on the CPU, in Morton order.

    Raises:
        ExportError: if the harmonics are of a degree above 3.
    """
    degree, rest = gaussians.sh_degree, 3 * (gaussians.sh.shape[1] - 1)
    if degree > 3:
        raise ExportError(
            f"the model's harmonics are of degree {degree}, and a compressed ply holds 3 at most; export it as .ply"
        )
    g = {name: tensor.detach().float().numpy() for name, tensor in gaussians.tensors().items()}
    order = morton_order(g["means"])
    count, chunks = len(order), -(-len(order) // CHUNK)
    padded = np.concatenate([order, np.repeat(order[-1:], chunks * CHUNK - count)])
    with np.errstate(over="ignore"):
        opacity = np.rint(255 / (1 + np.exp(-g["logit_opacities"][order].astype(np.float64)))).astype(np.uint32)
    position, position_bounds = _shares(g["means"][padded])
    scale, scale_bounds = _shares(np.clip(g["log_scales"], -MOST_LOG_SCALE, MOST_LOG_SCALE)[padded])
    colour, colour_bounds = _shares(0.5 + SH_C0 * g["sh"][:, 0][padded])
    packed = np.empty((count, len(PACKED)), "<u4")
    packed[:, 0], packed[:, 2] = _packed_11_10_11(position[:count]), _packed_11_10_11(scale[:count])
    packed[:, 1] = _packed_rotation(g["quats"][order])
    red, green, blue = np.rint(255 * colour[:count]).astype(np.uint32).T
    packed[:, 3] = red << 24 | green << 16 | blue << 8 | opacity
    elements = [
        ("chunk", chunks, [f"float {name}" for name in BOUNDS]),
        ("vertex", count, [f"uint {name}" for name in PACKED]),
    ]
    if rest:
        elements.append(("sh", count, [f"uchar f_rest_{i}" for i in range(rest)]))
    yield "\n".join(header_lines(elements)).encode()
    yield np.concatenate([position_bounds, scale_bounds, colour_bounds], 1).astype("<f4").tobytes()
    yield packed.tobytes()
    for first in range(0, count if rest else 0, CHUNK * CHUNK):
        higher = g["sh"][order[first : first + CHUNK * CHUNK], 1:].transpose(0, 2, 1)
        yield np.clip(np.floor((higher / (2 * MOST_SH) + 0.5) * 256), 0, 255).astype(np.uint8).tobytes()


def _shares(values: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return each value's position between the bounds of its chunk, and the bounds [chunks, 6]."""
    grouped = values.reshape(-1, CHUNK, 3).astype(np.float64)
    low, high = grouped.min(1, keepdims=True), grouped.max(1, keepdims=True)
    span = np.where(high > low, high - low, 1.0)
    bounds = np.concatenate([low[:, 0], high[:, 0]], 1).astype(np.float32)
    return ((grouped - low) / span).reshape(-1, 3), bounds


def _packed_11_10_11(share: NDArray[np.float64]) -> NDArray[np.uint32]:
    x, y, z = np.rint(share * [2047, 1023, 2047]).astype(np.uint32).T
    return np.asarray(x << 21 | y << 11 | z)


def _packed_rotation(quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Pack unit quaternions wxyz into 32 bits each; the sign is chosen so that the largest component is positive."""
    largest = np.abs(quats).argmax(1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    three = np.take_along_axis(quats * sign, others, 1)
    a, b, c = np.clip(np.rint((three * np.sqrt(0.5) + 0.5) * 1023), 0, 1023).astype(np.uint32).T
    return np.asarray(largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c)


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the order of points along a Z-curve with 21 bits per axis; neighbours in it are close in space."""
    if not len(means):
        return np.zeros(0, np.int64)
    low, high = means.min(0).astype(np.float64), means.max(0).astype(np.float64)
    cells = (means - low) / np.where(high > low, high - low, 1.0) * (2**21 - 1)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        spread = cells[:, axis].astype(np.uint64)
        for shift, mask in (
            (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
        ):  # fmt: skip
            spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
        code |= spread << np.uint64(axis)
    return np.argsort(code, kind="stable")


MAX_HEADER_BYTES = 1 << 16
MARK_LINE = "comment written by IntraSplat"
"""Header line that identifies a file written by this program."""
SCALAR_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
FOLLOWING = {None: ("vertex", "chunk"), "chunk": ("vertex",), "vertex": ("sh",)}
"""Names of the PLY elements that may follow an element, by that element's name; None stands for the start of the file."""


@dataclass(frozen=True)
class Element:
    """Element of a `.ply` file: rows of scalar properties."""

    name: str
    count: int
    layout: np.dtype[np.void]
    """Structured dtype of one row, with the property names."""

    @property
    def nbytes(self) -> int:
        """Total size in bytes of the element's rows."""
        return self.count * self.layout.itemsize

    @property
    def names(self) -> tuple[str, ...]:
        """Property names in the order of the file."""
        return self.layout.names or ()


def header_lines(elements: list[tuple[str, int, list[str]]]) -> list[str]:
    """Return the lines of a PLY file's header.

    Args:
        elements: name, number of rows, and properties such as `float x` of each element.
    """
    lines = ["ply", "format binary_little_endian 1.0", MARK_LINE]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return [*lines, "end_header", ""]


def read_header(file: BinaryIO, path: Path) -> list[Element]:
    """Parse the header of a PLY file and leave the file position at the first row.

    Returns:
        One element (`vertex`), or two to three (`chunk`, `vertex`, `sh`). Further elements are not read.

    Raises:
        BundleCorrupt: if the header is malformed or has no such elements.
    """
    lines = _lines(file, path)
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise BundleCorrupt(
            f"{path}: expected 'ply' and 'format binary_little_endian 1.0', got {[line[:80] for line in lines[:2]]}"
        )
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[2:]:
        last = found[-1][0] if found else None
        match line.split():
            case ["comment" | "obj_info", *_]:
                continue
            case ["element", name, number] if (
                name in FOLLOWING.get(last, ()) and number.isdecimal() and len(number) < 12
            ):
                if name == "sh" and found[0][0] != "chunk":
                    break
                found.append((name, int(number), []))
            case ["element", _, _] if last in ("vertex", "sh"):
                break
            case ["property", kind, name] if found and kind in SCALAR_TYPES:
                found[-1][2].append((name, SCALAR_TYPES[kind]))
            case _:
                raise BundleCorrupt(f"{path}: unexpected line in the header: {line[:80]!r}; vertices must come first")
    if not found or found[-1][0] == "chunk":
        raise BundleCorrupt(f"{path}: the header has no vertices; it is not a file of Gaussians")
    for name, _, properties in found:
        names = [each for each, _ in properties]
        if not names or len(set(names)) != len(names):
            raise BundleCorrupt(
                f"{path}: the element {name} has no properties or a property twice: {names[:80]}; export the file again"
            )
    return [Element(name, count, np.dtype(properties)) for name, count, properties in found]


def _lines(file: BinaryIO, path: Path) -> list[str]:
    lines: list[str] = []
    read = 0
    while not lines or lines[-1] != "end_header":
        line = file.readline(MAX_HEADER_BYTES - read + 1)
        read += len(line)
        if not line.endswith(b"\n") or read > MAX_HEADER_BYTES:
            raise BundleCorrupt(
                f"{path}: no 'end_header' in the first {min(read, MAX_HEADER_BYTES)} bytes; it is not a ply file"
            )
        try:
            lines.append(line.decode("ascii").strip())
        except UnicodeDecodeError as error:
            raise BundleCorrupt(f"{path}: the header holds bytes that are not ASCII: {line[:40]!r}") from error
    return lines[:-1]
