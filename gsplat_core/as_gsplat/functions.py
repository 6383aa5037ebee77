"""Small functions of `gsplat.utils`, in plain torch and differentiable."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_trailing
from gsplat_core.errors import InvalidInput
from gsplat_core.io.exports.export import export_splats
from gsplat_core.scene.gaussians import SH_C0
from gsplat_core.training.strategies.operations import draw


def normalized_quat_to_rotmat(quat: Tensor) -> Tensor:
    """Return the rotation matrices [..., 3, 3] of unit quaternions wxyz [..., 4]."""
    require_trailing("quat", quat, (4,), "[..., 4]")
    vector = quat[..., 1:]
    w = quat[..., :1, None]
    outer = vector[..., :, None] * vector[..., None, :]
    identity = torch.eye(3, dtype=quat.dtype, device=quat.device)
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    square = (vector * vector).sum(-1)[..., None, None]
    return identity + 2 * (outer - square * identity + w * cross)


def log_transform(x: Tensor) -> Tensor:
    """Return sign(x) log(1 + |x|)."""
    return torch.sign(x) * torch.log1p(x.abs())


def inverse_log_transform(y: Tensor) -> Tensor:
    """Return the value whose `log_transform` is `y`."""
    return torch.sign(y) * torch.expm1(y.abs())


def get_projection_matrix(
    znear: float, zfar: float, fovX: float, fovY: float, device: torch.device | str | None = None
) -> Tensor:
    """Return the projection matrix [4, 4] of a camera with its axis along +z, with depth from 0 to 1.

    Args:
        znear: z of the near plane.
        zfar: z of the far plane.
        fovX: horizontal field of view in radians.
        fovY: vertical field of view in radians.
        device: device of the matrix; None for the default device of torch.
    """
    matrix = torch.zeros(4, 4, device=device)
    matrix[0, 0] = 1 / math.tan(0.5 * fovX)
    matrix[1, 1] = 1 / math.tan(0.5 * fovY)
    matrix[2, 2] = zfar / (zfar - znear)
    matrix[2, 3] = -zfar * znear / (zfar - znear)
    matrix[3, 2] = 1
    return matrix


def save_ply(splats: Mapping[str, Tensor], dir: str, colors: Tensor | None = None) -> None:
    """Write splats to a `.ply` file.

    Args:
        splats: tensors means [N, 3], scales [N, 3] (logarithms), quats [N, 4], opacities [N] (logits), sh0 [N, 1, 3] and
            shN [N, K, 3].
        dir: path of the file.
        colors: colours [N, 3] from 0 to 1 that replace the spherical harmonics.
    """
    sh0, shN = splats.get("sh0"), splats.get("shN")
    if colors is not None:
        sh0, shN = ((colors - 0.5) / SH_C0)[:, None], colors.new_zeros(len(colors), 0, 3)
    if sh0 is None or shN is None:
        raise InvalidInput("splats must hold sh0 and shN, or give colors")
    export_splats(
        splats["means"], splats["scales"], splats["quats"], splats["opacities"], sh0, shN, format="ply", save_to=dir
    )


def _multinomial_sample(weights: Tensor, n: int, replacement: bool = True) -> Tensor:
    """Draw `n` indices in proportion to `weights` [N], int64 [n]; forks of MCMC import it from `gsplat.strategy.ops`."""
    return draw(weights, n) if replacement else torch.multinomial(weights, n, replacement=False)
