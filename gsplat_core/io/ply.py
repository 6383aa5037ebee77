"""Gaussians as `.ply`, in the layout of the INRIA trainer that viewers and editors read.

The file has one `vertex` element, binary little endian, with `float` properties: x y z nx ny nz f_dc_0..2 f_rest_*
opacity scale_0..2 rot_0..3. Opacity is a logit, scales are logarithms, rotations are wxyz. `f_rest_*` is channel-major:
all higher coefficients of red, then of green, then of blue. Normals are written as zero and ignored when read.

Files are read and written in blocks of rows, so the memory beside the tensors does not grow with the file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt
from gsplat_core.io.compressed_ply import read_compressed
from gsplat_core.io.files import replace_durably, write_durably
from gsplat_core.io.model_files import BLOCK_BYTES, check_memory, gaussians_of, open_model_file, read_rows
from gsplat_core.io.ply_header import Element, header_lines, read_header
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, Gaussians

POSITION, COLOUR = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1))


def save_ply(gaussians: Gaussians, path: str | Path) -> None:
    """Write Gaussians to a `.ply` file atomically.

    Raises:
        OSError: if it cannot be written.
    """
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

    The compressed layout of PlayCanvas (`gsplat_core.io.compressed_ply`) is recognised by its header.

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
    """Return all properties as columns [N, P], without a copy if all are float32."""
    names = rows.dtype.names or ()
    if all(rows.dtype[name] == np.dtype("<f4") for name in names):
        return rows.view("<f4").reshape(len(rows), len(names))
    table = np.empty((len(rows), len(names)), np.float32)
    for i, name in enumerate(names):
        # A double beyond the range of float32 becomes infinite, which is refused afterwards.
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
