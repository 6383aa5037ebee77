"""Export of a model to a file, at one or several times of its window.

`export_splats` returns splats as the bytes of a `.ply`, compressed `.ply` or `.splat` file, with gsplat's arguments."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Literal, get_args

import torch
from torch import Tensor

from gsplat_core.errors import BundleError, ExportError, InvalidInput, InvalidSetting
from gsplat_core.geometry.mesh import mesh_of
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.exports.files import (
    glb_pieces,
    mesh_glb_pieces,
    mesh_ply_pieces,
    rows_of,
    splat_bytes,
    unit_rotations,
)
from gsplat_core.io.exports.formats import ExportWish, format_of
from gsplat_core.io.files import PartialFile
from gsplat_core.io.model_sources import static_model
from gsplat_core.io.ply import compressed_ply_pieces, ply_pieces
from gsplat_core.io.spz import spz_pieces
from gsplat_core.models import Model
from gsplat_core.ops.arguments import require_shape
from gsplat_core.scene.gaussians import Gaussians, require_gaussians

TIMES_FILE = "times.json"
NODE_NAME = "reconstruction"
"""Object name in a `.glb`. Independent of the file name, so equal models give equal bytes."""
LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""Earliest timestamp that a zip archive can store, used so that equal models give equal bytes."""


def export_model(model: Model, path: Path, wish: ExportWish, *, overwrite: bool = False) -> int:
    """Export a model to a file, written atomically. Equal models and wishes give bit-identical files.

    Args:
        model: model to export.
        path: target file.
        wish: format, and the time or number of times to export.
        overwrite: replace an existing file.

    Returns:
        File size in bytes.

    Raises:
        InvalidSetting: if the time is outside the model's window.
        ExportError: if the format cannot represent the model, or if it is empty or was not trained by `alpha`.
        OSError: if the file cannot be written.
    """
    times_s = wish.times_in(model.time_window_s)
    if model.gaussians.count == 0:
        raise ExportError("the model has no Gaussians; there is nothing to export")
    if (renderer := model.trained_by.renderer) != "alpha":
        raise ExportError(
            f"the model was trained by renderer {renderer!r}, and viewers of {wish.format.name} blend by alpha; train with"
            " --renderer alpha to export it"
        )
    with PartialFile(path, overwrite=overwrite) as partial, torch.inference_mode():
        if wish.format.is_sequence:
            _write_sequence(model, partial.file, times_s)
        elif wish.format.is_surface:
            for piece in _surface_pieces(wish.format.name, model, times_s[0]):
                partial.file.write(piece)
        else:
            for piece in _pieces(wish.format.name, model.at(times_s[0]), times_s[0]):
                partial.file.write(piece)
        return partial.file.seek(0, io.SEEK_END)


def save_gaussians(gaussians: Gaussians, path: str | Path, *, overwrite: bool = False) -> None:
    """Save Gaussians that do not move: as a file by the ending of its name, or without an ending as a bundle.

    Args:
        gaussians: Gaussians to save.
        path: `.ply`, `.compressed.ply`, `.splat`, `.spz` or `.glb` file, or the folder of the bundle.
        overwrite: replace an existing file or bundle.

    Raises:
        InvalidSetting: for an ending without a format of Gaussians.
        ExportError: if the format cannot represent the Gaussians, or a value is not finite.
        BundleError: if the Gaussians cannot be shown, or there is a folder of this name.
        OSError: if the file cannot be written.
    """
    require_gaussians("save_gaussians", gaussians)
    path = Path(path)
    wrong = int((~gaussians.means.isfinite()).sum())
    if wrong:
        raise ExportError(f"means holds {wrong} values that are NaN or infinite; such a model is not exported")
    model = static_model(gaussians.detach().to("cpu", torch.float32), path)
    if path.suffix:
        wish = ExportWish(format_of(path))
        if wish.format.is_sequence or wish.format.is_surface:
            raise InvalidSetting(f"{path.name!r:.80} is no name for Gaussians; end it in .ply, .splat, .spz or .glb")
        export_model(model, path, wish, overwrite=overwrite)
    elif path.exists() and not overwrite:
        raise BundleError(f"{path} exists; choose another name, or overwrite it")
    else:
        save_bundle(model, path)


def _pieces(format_name: str, gaussians: Gaussians, time_s: float) -> Iterator[bytes]:
    rows = rows_of(gaussians)
    if format_name == "splat":
        yield splat_bytes(rows)
    elif format_name == "glb":
        yield from glb_pieces(rows, NODE_NAME, time_s)
    else:
        encoders = {"ply": ply_pieces, "compressed-ply": compressed_ply_pieces, "spz": spz_pieces}
        yield from encoders[format_name](with_unit_rotations(gaussians))


def _surface_pieces(format_name: str, model: Model, time_s: float) -> Iterator[bytes]:
    rows_of(model.at(time_s))  # raises for non-finite values
    mesh = mesh_of(model, time_s)
    unit = "millimetre" if model.metric else "relative"
    if format_name == "mesh-glb":
        yield from mesh_glb_pieces(mesh, NODE_NAME, time_s, unit)
    else:
        yield from mesh_ply_pieces(mesh, unit, with_triangles=format_name == "mesh-ply")


def with_unit_rotations(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians on the CPU in float32 with normalised quaternions."""
    on_host = gaussians.to("cpu", torch.float32)
    return replace(on_host, quats=torch.from_numpy(unit_rotations(on_host.quats.numpy())))


def _write_sequence(model: Model, file: BinaryIO, times_s: list[float]) -> None:
    """Write a zip archive with the model's Gaussians at several times, holding those of only one time in memory."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        names = [f"{index:04d}.ply" for index in range(len(times_s))]
        said = {"time_window_s": list(model.time_window_s), "files": dict(zip(names, times_s, strict=True))}
        archive.writestr(zipfile.ZipInfo(TIMES_FILE, LONG_AGO), json.dumps(said, indent=1))
        for name, time_s in zip(names, times_s, strict=True):
            gaussians = model.at(time_s)
            rows_of(gaussians)  # raises for non-finite values
            with archive.open(zipfile.ZipInfo(name, LONG_AGO), "w", force_zip64=True) as entry:
                for piece in ply_pieces(with_unit_rotations(gaussians)):
                    entry.write(piece)


SplatFormat = Literal["ply", "splat", "ply_compressed"]
LEAST_OPACITY = 1 / 255
"""Opacity below which splats are left out of compressed `.ply` files, as in gsplat."""


@torch.no_grad()
def export_splats(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    format: SplatFormat = "ply",
    save_to: str | None = None,
) -> bytes:
    """Return splats as the bytes of a file. Splats with a value that is not finite are left out.

    Args:
        means: centres [N, 3].
        scales: logarithms of the standard deviations [N, 3].
        quats: rotations wxyz [N, 4].
        opacities: logits [N].
        sh0: coefficients [N, 1, 3] of the constant spherical harmonic.
        shN: further coefficients [N, K, 3], K = 0, 3, 8, 15 or 24.
        format: "ply", "splat" (colours without view dependence) or "ply_compressed" (up to degree 3; splats of an opacity
            below 1/255 are left out).
        save_to: path to write the bytes to, too.

    Raises:
        InvalidInput: for wrong shapes or an unknown format.
        ExportError: if the format cannot represent the splats.
        OSError: if `save_to` cannot be written.
    """
    if format not in get_args(SplatFormat):
        raise InvalidInput(f"unknown format {format!r}; the formats are {', '.join(get_args(SplatFormat))}")
    count = means.shape[0]
    require_shape("opacities", opacities, (count,), "[N]")
    require_shape("sh0", sh0, (count, 1, 3), "[N, 1, 3]")
    if shN.dim() != 3 or shN.shape[0] != count or shN.shape[2] != 3:
        raise InvalidInput(f"shN must be [N, K, 3] with N = {count}, got {list(shN.shape)}")
    gaussians = Gaussians(means, quats, scales, opacities, torch.cat([sh0, shN], 1)).detach().to("cpu", torch.float32)
    kept = torch.ones(count, dtype=torch.bool)
    for tensor in gaussians.tensors().values():
        kept &= tensor.isfinite().flatten(1).all(1) if tensor.dim() > 1 else tensor.isfinite()
    if format == "ply_compressed":
        kept &= gaussians.opacities > LEAST_OPACITY
    gaussians = gaussians.select(kept)
    if format == "ply":
        data = b"".join(ply_pieces(gaussians))
    elif format == "splat":
        data = splat_bytes(rows_of(gaussians))
    else:
        data = b"".join(compressed_ply_pieces(with_unit_rotations(gaussians)))
    if save_to is not None:
        Path(save_to).write_bytes(data)
    return data
