"""Covariance and precision matrices from rotations and scales (Zwicker et al. 2001; Kerbl et al. 2023, equation 6)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import check_covariance_arguments

TRIU_ROWS = (0, 0, 0, 1, 1, 2)
TRIU_COLUMNS = (0, 1, 2, 1, 2, 2)


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Convert quaternions [..., 4] (wxyz, any non-zero length) to rotation matrices [..., 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def matrix_to_triu(matrix: Tensor) -> Tensor:
    """Return the upper triangles (xx, xy, xz, yy, yz, zz) [..., 6] of matrices [..., 3, 3]."""
    return matrix[..., TRIU_ROWS, TRIU_COLUMNS]


def triu_to_matrix(triu: Tensor) -> Tensor:
    """Return symmetric matrices [..., 3, 3] from upper triangles [..., 6]."""
    return triu[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*triu.shape[:-1], 3, 3)


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Compute covariances R S S Rᵀ and precisions R S⁻¹ S⁻¹ Rᵀ (Kerbl et al. 2023, eq. 6).

    See `gsplat_core.quat_scale_to_covar_preci`.
    """
    check_covariance_arguments(quats, scales)
    rotation = quat_to_rotmat(quats)

    def outer(factors: Tensor) -> Tensor:
        half = rotation * factors[..., None, :]
        matrix = half @ half.transpose(-1, -2)
        return matrix_to_triu(matrix) if triu else matrix

    return outer(scales) if compute_covar else None, outer(1 / scales) if compute_preci else None
