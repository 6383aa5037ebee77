"""Real spherical harmonics in torch at any floating dtype, and their rotation; the order of coefficients is that of `Gaussians.sh`."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def harmonic_bases(degree: int, dirs: Tensor) -> Tensor:
    """Evaluate the basis functions of degrees 0 to `degree` in unit directions (Sloan 2013).

    A basis function of degree l and order m is a polynomial in z times the real (m >= 0) or imaginary part of
    (x + iy)^|m|. The polynomials are associated Legendre functions by their recursion, with the phase (-1)^m.

    Args:
        degree: highest degree.
        dirs: unit vectors [..., 3].

    Returns:
        Values [..., (degree + 1)²], by degree, then by order from -l to l.
    """
    x, y, z = dirs.unbind(-1)
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        a, b = real[-1], imaginary[-1]
        real.append(x * a - y * b)
        imaginary.append(x * b + y * a)
    legendre: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(z, (-1) ** m * math.prod(range(1, 2 * m, 2)))
        for l in range(m + 1, degree + 1):
            before = legendre[l - 2, m] * (l + m - 1) if l > m + 1 else 0.0
            legendre[l, m] = ((2 * l - 1) * z * legendre[l - 1, m] - before) / (l - m)
    bases = []
    for l in range(degree + 1):
        for order in range(-l, l + 1):
            m = abs(order)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            part = imaginary[m] if order < 0 else real[m]
            bases.append(norm * (math.sqrt(2) if m else 1) * legendre[l, m] * part)
    return torch.stack(bases, -1)


def rotated_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Return the coefficients of a function on the sphere after the rotation of the sphere.

    The matrix of each degree follows from the basis functions in some directions and in the same directions rotated
    back, by least squares in float64.

    Args:
        sh: coefficients [N, K, 3], K = (degree + 1)².
        rotation: rotation matrix [3, 3].

    Returns:
        Coefficients [N, K, 3], whose values in direction d are those of `sh` in the direction `rotation.T @ d`.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    generator = torch.Generator().manual_seed(0)
    dirs = torch.randn(8 * (2 * degree + 1), 3, generator=generator, dtype=torch.float64)
    dirs = torch.nn.functional.normalize(dirs, dim=-1)
    turned = rotation.detach().to("cpu", torch.float64)
    after, before = harmonic_bases(degree, dirs), harmonic_bases(degree, dirs @ turned)
    bands = [sh[:, :1]]
    for l in range(1, degree + 1):
        band = slice(l * l, (l + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, band], before[:, band]).solution.to(sh.device, sh.dtype)
        bands.append(torch.einsum("ij,njc->nic", matrix, sh[:, band]))
    return torch.cat(bands, 1)
