"""Gaussians as compressed `.ply`, the layout of PlayCanvas and SuperSplat: 16 bytes each, plus one byte per coefficient.

Rows are grouped into chunks of 256. The element `chunk` has the bounds of position, log-scale and colour of each chunk
as floats. The element `vertex` has four `uint` properties: `packed_position` and `packed_scale` (11, 10 and 11 bits
between the bounds), `packed_rotation` (index of the largest component of wxyz, then the other three with 10 bits),
`packed_color` (red, green, blue, opacity, 8 bits each). The optional element `sh` has the higher harmonics,
channel-major, as `uchar` from -4 to 4. Early files have no colour bounds; their colours are between 0 and 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, ExportError
from gsplat_core.io.model_files import check_memory, gaussians_of, logit_of_bytes, read_rows
from gsplat_core.io.ply_header import Element, header_lines
from gsplat_core.scene.gaussians import SH_C0, Gaussians

CHUNK = 256
"""Number of Gaussians with common bounds."""
BOUNDS = [
    *(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
]
WITHOUT_COLOUR = 12
"""Number of bounds in files without colour bounds."""
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
REST_COUNTS = {9: 1, 24: 2, 45: 3}
"""SH degree by number of `sh` properties."""
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
    bounds[:, 15:18] = 1  # colours of files without colour bounds

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
    if harmonics.count != vertices.count or len(names) not in REST_COUNTS or list(harmonics.names) != names:
        raise BundleCorrupt(
            f"{path}: harmonics of {harmonics.count} Gaussians with {len(names)} properties; {vertices.count} with {', '.join(map(str, REST_COUNTS))} are expected"
        )
    if not _all(harmonics, "u1"):
        raise BundleCorrupt(f"{path}: the harmonics are not of the type uchar; export it again")


def _all(element: Element, kind: str) -> bool:
    return all(element.layout[name] == np.dtype(kind) for name in element.names)


def _between(bounds: NDArray[np.float32], share: NDArray[np.float32]) -> NDArray[np.float32]:
    """Interpolate between minima (first three columns) and maxima of each chunk."""
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
    """Pack unit quaternions wxyz; the sign is chosen so that the largest component is positive."""
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
