"""Gaussians as `.ply`, in the layout of the INRIA trainer that viewers and editors read.

The file has one `vertex` element, binary little endian, with `float` properties: x y z nx ny nz f_dc_0..2 f_rest_*
opacity scale_0..2 rot_0..3. Opacity is a logit, scales are logarithms, rotations are wxyz. `f_rest_*` is channel-major:
all higher coefficients of red, then of green, then of blue. Normals are written as zero and ignored when read.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt
from gsplat_core.io.files import replace_durably, write_durably
from gsplat_core.io.model_files import check_memory, open_model_file
from gsplat_core.scene.gaussians import MAX_SH_DEGREE, Gaussians

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


def ply_pieces(gaussians: Gaussians) -> list[bytes]:
    """Return header and body of a `.ply` file."""
    g = {name: t.detach().cpu().to(torch.float32).numpy() for name, t in gaussians.tensors().items()}
    rest = g["sh"][:, 1:].transpose(0, 2, 1).reshape(gaussians.count, 3 * (g["sh"].shape[1] - 1))
    columns = [
        g["means"], np.zeros_like(g["means"]), g["sh"][:, 0], rest,
        g["logit_opacities"][:, None], g["log_scales"], g["quats"],
    ]  # fmt: skip
    names = [*POSITION, "nx", "ny", "nz", *COLOUR, *(f"f_rest_{i}" for i in range(rest.shape[1]))]
    names += ["opacity", *SCALE, *ROTATION]
    header = ["ply", "format binary_little_endian 1.0", MARK_LINE, f"element vertex {gaussians.count}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    body = np.concatenate(columns, axis=1).astype("<f4")
    return ["\n".join(header).encode(), body.tobytes()]


def load_ply(path: str | Path) -> Gaussians:
    """Read Gaussians of SH degree 0 to 4; unused properties are skipped.

    Raises:
        BundleCorrupt: if the file has another format, is truncated, or contains NaN or infinity.
        BundleError: if it is missing, not a regular file, or larger than the available memory.
    """
    path = Path(path)
    with open_model_file(path) as file:
        layout, count = _read_header(file, path)
        needed, left = count * layout.itemsize, os.fstat(file.fileno()).st_size - file.tell()
        if left < needed:
            raise BundleCorrupt(
                f"{path}: {count} Gaussians take {needed} bytes, only {left} follow the header; the file was cut short"
            )
        check_memory(path, 4 * needed)  # rows, columns, and the tensors made from them
        content = file.read(needed)
    if len(content) < needed:
        raise BundleCorrupt(f"{path} became shorter while it was read; copy it again")
    rows = np.frombuffer(content, dtype=layout)
    names = set(layout.names or ())
    rest_count = sum(name.startswith("f_rest_") for name in names)
    rest = [f"f_rest_{i}" for i in range(rest_count)]
    missing = [n for n in (*POSITION, *COLOUR, *rest, "opacity", *SCALE, *ROTATION) if n not in names]
    if missing:
        raise BundleCorrupt(
            f"{path}: no property {', '.join(missing[:5])}; it is not a file of Gaussians in the INRIA layout"
        )
    if rest_count not in REST_COUNTS:
        raise BundleCorrupt(
            f"{path}: {rest_count} f_rest properties; SH degrees 0 to {MAX_SH_DEGREE} have {REST_COUNTS}"
        )
    higher = _columns(rows, rest, path).reshape(count, 3, rest_count // 3).transpose(0, 2, 1)
    sh = np.concatenate([_columns(rows, COLOUR, path)[:, None], higher], axis=1)
    tensors = (
        _columns(rows, POSITION, path), _columns(rows, ROTATION, path), _columns(rows, SCALE, path),
        _columns(rows, ("opacity",), path)[:, 0], sh,
    )  # fmt: skip
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array)) for array in tensors))


def _columns(rows: NDArray[np.void], names: tuple[str, ...] | list[str], path: Path) -> NDArray[np.float32]:
    columns = np.empty((len(rows), len(names)), dtype=np.float32)
    for i, name in enumerate(names):
        # A double beyond the range of float32 becomes infinite. The check below rejects it.
        with np.errstate(over="ignore"):
            columns[:, i] = rows[name]
        bad = int(np.count_nonzero(~np.isfinite(columns[:, i])))
        if bad:
            raise BundleCorrupt(f"{path}: property {name} holds {bad} of {len(rows)} values that are NaN or infinite")
    return columns


def _read_header(file: BinaryIO, path: Path) -> tuple[np.dtype[np.void], int]:
    """Parse the header and leave the file at the first vertex.

    Returns:
        Structured dtype of one vertex, and the number of vertices.
    """
    lines = _header_lines(file, path)
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise BundleCorrupt(
            f"{path}: expected 'ply' and 'format binary_little_endian 1.0', got {[line[:80] for line in lines[:2]]}"
        )
    count: int | None = None
    properties: list[tuple[str, str]] = []
    for line in lines[2:]:
        match line.split():
            case ["comment" | "obj_info", *_]:
                continue
            case ["element", "vertex", number] if count is None and number.isdecimal() and len(number) < 12:
                count = int(number)
            case ["element", _, _] if count is not None:
                break  # elements after the vertices are not read
            case ["property", kind, name] if count is not None and kind in SCALAR_TYPES:
                properties.append((name, SCALAR_TYPES[kind]))
            case _:
                raise BundleCorrupt(f"{path}: unexpected line in the header: {line[:80]!r}; vertices must come first")
    names = [name for name, _ in properties]
    if count is None or not properties or len(set(names)) != len(names):
        raise BundleCorrupt(f"{path}: the header has no vertices, no properties or a property twice: {names[:80]}")
    return np.dtype(properties), count


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
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
