"""Splats as bytes of `.ply`, compressed `.ply` and `.splat` files, with gsplat's arguments."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.io.compressed_ply import compressed_ply_pieces
from gsplat_core.io.exports.export import with_unit_rotations
from gsplat_core.io.exports.files import rows_of, splat_bytes
from gsplat_core.io.ply import ply_pieces
from gsplat_core.scene.gaussians import Gaussians

SplatFormat = Literal["ply", "splat", "ply_compressed"]
LEAST_OPACITY = 1 / 255
"""Splats of a lower opacity are left out of compressed files, as in gsplat."""


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
    """
    if format not in get_args(SplatFormat):
        raise InvalidInput(f"unknown format {format!r}; the formats are {', '.join(get_args(SplatFormat))}")
    count = means.shape[0]
    require_shape("sh0", sh0, (count, 1, 3), "[N, 1, 3]")
    if shN.dim() != 3 or shN.shape[0] != count or shN.shape[2] != 3:
        raise InvalidInput(f"shN must be [N, K, 3] with N = {count}, got {list(shN.shape)}")
    gaussians = Gaussians(means, quats, scales, opacities, torch.cat([sh0, shN], 1)).detach().to("cpu", torch.float32)
    kept = torch.ones(count, dtype=torch.bool)
    for tensor in gaussians.tensors().values():
        kept &= tensor.reshape(count, -1).isfinite().all(1)
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
