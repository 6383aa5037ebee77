"""Real spherical harmonics up to degree 4 in plain torch (Sloan 2013, "Efficient Spherical Harmonic Evaluation")."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.arguments import check_spherical_harmonics_arguments


def spherical_harmonics_bases(degree: int, directions: Tensor) -> Tensor:
    """Evaluate the (degree + 1)² real basis functions [..., K] at unit directions [..., 3].

    Order and signs are those of 3DGS (Kerbl et al. 2023).
    """
    x, y, z = directions.unbind(-1)
    bases = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        bases += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        c2, s2 = xx - yy, 2 * x * y
        bases += [
            0.5462742152960395 * s2,
            -1.0925484305920792 * y * z,
            0.9461746957575601 * zz - 0.31539156525252005,
            -1.0925484305920792 * x * z,
            0.5462742152960395 * c2,
        ]
    if degree >= 3:
        c3, s3 = x * c2 - y * s2, x * s2 + y * c2
        lift = 0.4570457994644658 - 2.285228997322329 * zz
        bases += [
            -0.5900435899266435 * s3,
            1.445305721320277 * z * s2,
            lift * y,
            z * (1.865881662950577 * zz - 1.1195289977703462),
            lift * x,
            1.445305721320277 * z * c2,
            -0.5900435899266435 * c3,
        ]
    if degree >= 4:
        c4, s4 = x * c3 - y * s3, x * s3 + y * c3
        tilt = z * (2.0071396306718676 - 4.683325804901025 * zz)
        ring = 3.31161143515146 * zz - 0.47308734787878
        bases += [
            0.6258357354491761 * s4,
            -1.7701307697799304 * z * s3,
            ring * s2,
            tilt * y,
            0.10578554691520431 * (35 * zz * zz - 30 * zz + 3),
            tilt * x,
            ring * c2,
            -1.7701307697799304 * z * c3,
            0.6258357354491761 * c4,
        ]
    return torch.stack(bases, -1)


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Evaluate sums of spherical harmonics; see `gsplat_core.spherical_harmonics`."""
    check_spherical_harmonics_arguments(degrees_to_use, dirs, coeffs, masks)
    count = (degrees_to_use + 1) ** 2
    coeffs = coeffs[..., :count, :]
    if masks is not None:
        # Replace before any arithmetic, because a masked NaN would still reach the gradient.
        dirs = torch.where(masks[..., None], dirs, torch.ones_like(dirs))
        coeffs = torch.where(masks[..., None, None], coeffs, torch.zeros_like(coeffs))
    if degrees_to_use == 0:
        bases = torch.full_like(dirs[..., :1], 0.28209479177387814)
    else:
        bases = spherical_harmonics_bases(degrees_to_use, dirs / dirs.norm(dim=-1, keepdim=True))
    return (bases[..., None] * coeffs).sum(-2)
