"""Experimental: Gaussians cut by Bézier curves, which show sharp edges (Qu et al. 2024, "DisC-GS").

A splat has M cubic Bézier curves in the plane of its first two axes. Their control points, in standard deviations, are the
tensor `curves` [N, M, 4, 2] of `Gaussians.extra`. The splat shows at a pixel only where the implicit forms of all its
projected curves are positive. Plain torch over tiles, on the CPU and on CUDA; memory grows with the longest tile list.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.flow import projected
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians, rotations

CURVES = "curves"
"""Key in `Gaussians.extra` of the control points of the splats' Bézier curves."""
BINOMIALS = (1.0, 3.0, 3.0, 1.0)
PAIRS = ((3, 2), (3, 1), (3, 0), (2, 1), (2, 0), (1, 0))
"""Pairs (i, j) of control points whose terms l_ij are the elements of the determinant in `implicit_form`."""
FARTHEST_FLIP = 0.5
"""Largest shift of a control point, in standard deviations of the splat, that is assumed to move a pixel to the other
side of the curve (a flip).
"""
SMALLEST_FLIP = 0.15
"""Lower bound, in standard deviations, of the shift to a flip in the gradient, which is inversely proportional to the shift."""
BEND = 1.0
"""Initial bend of a curve in standard deviations of the splat. Nearly straight curves have an ill-conditioned implicit form."""
TILE_SIZE, MAX_ALPHA, LEAST_ALPHA = 16, 0.99, 1 / 255


class Implicit(NamedTuple):
    """Implicit form of cubic Bézier curves at points, and its derivatives."""

    value: Tensor
    """Value f [...] of the implicit form; 0 on the curve, with different signs on both sides."""
    slopes: Tensor
    """Derivatives ∂f / ∂(control point) of the implicit form by the four control points, [..., 4, 2]."""


def implicit_form(points: Tensor, curves: Tensor) -> Implicit:
    """Evaluate the implicit form of curves [..., 4, 2] at points [..., 2] by Bézout's determinant (Sederberg 1983).

    f = det [[l32, l31, l30], [l31, l30 + l21, l20], [l30, l20, l10]] with l_ij = C(3,i) C(3,j) det [p, p_i, p_j].
    """
    x, y = points.unbind(-1)
    px, py = curves[..., 0].unbind(-1), curves[..., 1].unbind(-1)
    terms = {}
    for i, j in PAIRS:
        determinant = x * (py[i] - py[j]) - y * (px[i] - px[j]) + (px[i] * py[j] - px[j] * py[i])
        terms[i, j] = BINOMIALS[i] * BINOMIALS[j] * determinant
    a, b, c = terms[3, 2], terms[3, 1], terms[3, 0]
    d, e, g = c + terms[2, 1], terms[2, 0], terms[1, 0]
    value = a * (d * g - e * e) - b * (b * g - c * e) + c * (b * e - c * d)
    by_term = {
        (3, 2): d * g - e * e,
        (3, 1): 2 * (c * e - b * g),
        (3, 0): 2 * (b * e - c * d) + a * g - c * c,
        (2, 1): a * g - c * c,
        (2, 0): 2 * (b * c - a * e),
        (1, 0): a * d - b * b,
    }
    slopes = [[torch.zeros_like(value) for _ in range(2)] for _ in range(4)]
    for (i, j), slope in by_term.items():
        each = BINOMIALS[i] * BINOMIALS[j] * slope
        slopes[i][0] = slopes[i][0] + each * (py[j] - y)
        slopes[i][1] = slopes[i][1] + each * (x - px[j])
        slopes[j][0] = slopes[j][0] + each * (y - py[i])
        slopes[j][1] = slopes[j][1] + each * (px[i] - x)
    return Implicit(value, torch.stack([torch.stack(pair, -1) for pair in slopes], -2))


class _Side(torch.autograd.Function):
    """Autograd function: 1 where the implicit form is positive, else 0. The gradient assumes the smallest shift of a
    control point that flips the result.
    """

    @staticmethod
    def forward(ctx: Any, points: Tensor, curves: Tensor) -> Tensor:
        value, slopes = implicit_form(points, curves)
        inside = value > 0
        # To first order, the smallest shift of one coordinate of one control point by which the curve reaches the pixel.
        flat = slopes.flatten(-2)
        largest, which = flat.abs().max(-1)
        shift = torch.where(largest > 0, -value / flat.gather(-1, which[..., None])[..., 0], torch.inf)
        ctx.save_for_backward(inside, which, shift)
        ctx.shape = curves.shape
        return inside.to(points.dtype)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:
        inside, which, shift = ctx.saved_tensors
        near = (shift.abs() <= FARTHEST_FLIP) & shift.isfinite()
        size = shift.abs().clamp(min=SMALLEST_FLIP)
        # A pixel that crosses the curve changes the result by 1 - 2 inside; divided by the shift this is the gradient.
        change = torch.where(inside, -gradient, gradient)
        slope = torch.where(near, change * torch.where(shift < 0, -1.0, 1.0) / size, 0)
        full = slope.new_zeros(*slope.shape, 8).scatter_(-1, which[..., None], slope[..., None])
        return None, full.unflatten(-1, (4, 2)).sum_to_size(ctx.shape)


def side(points: Tensor, curves: Tensor) -> Tensor:
    """Return 1 for points [..., 2] on the positive side of curves [..., 4, 2], else 0.

    Differentiable in the curves: the gradient at a point belongs to the one coordinate of a control point whose shift moves the
    point to the other side first. Its size is the change of the loss per shift. Points farther than `FARTHEST_FLIP` have none.
    """
    return _Side.apply(points, curves)


class GaussianKernel:
    """Falloff of an ordinary Gaussian splat, not cut by curves."""

    name = "gaussian"
    extra: tuple[str, ...] = ()
    """Names of the tensors in `Gaussians.extra` that the kernel needs."""

    def factors(self, offsets: Tensor, curves: Tensor | None) -> Tensor | None:
        """Return the factors by which a splat's alpha is multiplied at offsets [T, P, L, 2] from its mean; None for 1 everywhere."""
        return None


class CutKernel(GaussianKernel):
    """Falloff of a Gaussian cut by Bézier curves: unchanged on the positive side of all its curves, 0 elsewhere."""

    name = "cut"
    extra = (CURVES,)

    def factors(self, offsets: Tensor, curves: Tensor | None) -> Tensor | None:
        """Return the factors of alpha, 0 or 1, at offsets [T, P, L, 2] from the splats' means. `curves` are the
        projected control points [T, L, M, 4, 2] relative to the means.
        """
        assert curves is not None
        return side(offsets[..., None, :], curves[:, None]).prod(-1)


def with_curves(gaussians: Gaussians, count: int, random: torch.Generator, distance: float = 1.0) -> Gaussians:
    """Add `count` curves to each splat, at random directions and `distance` standard deviations from its centre.

    The splat shows on the side of its centre. The curves are bent, because the implicit form of a straight line of four control
    points is 0 everywhere.
    """
    n = gaussians.count
    along = torch.tensor([-3.0, -1.0, 1.0, 3.0]).expand(n, count, 4)
    bend = BEND * torch.randn(n, count, 1, generator=random).sign() * torch.tensor([-1.0, 1.0, -1.0, 1.0])
    angle = 2 * math.pi * torch.rand(n, count, 1, generator=random)
    across = distance + bend
    curves = torch.stack([angle.cos() * across - angle.sin() * along, angle.sin() * across + angle.cos() * along], -1)
    centre = implicit_form(torch.zeros(n, count, 2), curves).value
    curves = torch.where((centre < 0)[..., None, None], curves.flip(-2), curves).to(gaussians.device, gaussians.dtype)
    return replace(gaussians, extra={**gaussians.extra, CURVES: curves})


def projected_curves(gaussians: Gaussians, camera: Camera, means2d: Tensor) -> Tensor:
    """Return the control points [N, M, 4, 2] in pixels relative to the projected means [N, 2]."""
    curves = gaussians.extra[CURVES]
    axes = rotations(gaussians.quats)[:, :, :2] * gaussians.scales[:, None, :2]
    places = gaussians.means[:, None, None] + torch.einsum("nij,nmkj->nmki", axes, curves)
    view, K = camera.matrices(gaussians.device, gaussians.dtype)
    local = places @ view[:3, :3].T + view[:3, 3]
    depth = torch.ones_like(local[..., 2:]) if camera.model == "ortho" else local[..., 2:].clamp(min=1e-6)
    return local[..., :2] / depth * K.diagonal()[:2] + K[:2, 2] - means2d[:, None, None]


def render_kernel(
    gaussians: Gaussians, camera: Camera, kernel: GaussianKernel, background: Tensor | None = None
) -> Tensor:
    """Render the picture [H, W, 3] of splats with a kernel by alpha blending; differentiable.

    Args:
        gaussians: float32 Gaussians with colours of degree 0 and the kernel's tensors.
        camera: pinhole or orthographic camera.
        kernel: instance of an entry of `KERNELS`.
        background: colour [3]; None for black.

    Raises:
        InvalidInput: for a fisheye camera, view-dependent colours, or without the kernel's tensors.
    """
    if camera.model == "fisheye":
        raise InvalidInput(
            "kernels are for pinhole and orthographic cameras, this one is fisheye; rectify the pictures"
        )
    if gaussians.sh_degree != 0:
        raise InvalidInput(f"kernels are for colours of degree 0, got degree {gaussians.sh_degree}")
    missing = [name for name in kernel.extra if name not in gaussians.extra]
    if missing:
        raise InvalidInput(
            f"the kernel {kernel.name!r} needs Gaussians with {', '.join(missing)}; add them by with_curves"
        )
    rows = projected(gaussians, camera)
    opacities = gaussians.opacities
    grid = TileGrid(TILE_SIZE, -(-camera.width_px // TILE_SIZE), -(-camera.height_px // TILE_SIZE))
    with torch.no_grad():
        _, ids, starts = bin_splats(
            rows.means2d[None], rows.radii[None], rows.depths[None], grid, conics=rows.conics[None],
            opacities=opacities[None],
        )  # fmt: skip
        lists, listed = _padded(starts.reshape(-1), ids)
        pixels = _tile_pixels(grid, gaussians.device)
    offsets = pixels[:, :, None] - rows.means2d[lists][:, None]
    a, b, c = rows.conics[lists][:, None].unbind(-1)
    dx, dy = offsets.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[lists][:, None] * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
    if CURVES in kernel.extra:
        # Divide offsets by the splat's standard deviation, so that the limits of a flip do not depend on its size.
        spread = rows.conics.detach()[:, [0, 2]].sum(1).clamp(min=1e-12).mul(0.5).rsqrt()[lists]
        curves = projected_curves(gaussians, camera, rows.means2d)[lists] / spread[:, :, None, None, None]
        factors = kernel.factors(offsets.detach() / spread[:, None, :, None], curves)
    else:
        factors = kernel.factors(offsets, None)
    if factors is not None:
        alpha = alpha * factors
    alpha = torch.where(listed[:, None] & (sigma >= 0) & (alpha >= LEAST_ALPHA), alpha, 0)
    after = torch.cumprod(1 - alpha, -1)
    through = torch.cat([torch.ones_like(after[..., :1]), after], -1)
    colours = (gaussians.sh[:, 0] * SH_C0 + 0.5).clamp_min(0)
    values = ((alpha * through[..., :-1])[..., None] * colours[lists][:, None]).sum(2)
    if background is not None:
        values = values + through[..., -1:] * background
    picture = values.reshape(grid.tile_height, grid.tile_width, TILE_SIZE, TILE_SIZE, 3).transpose(1, 2)
    return picture.reshape(grid.tile_height * TILE_SIZE, -1, 3)[: camera.height_px, : camera.width_px]


def _padded(starts: Tensor, ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return the tiles' lists of splats padded to equal length, int64 [T, L], and a mask that is False on the padding.

    Synchronises with the device.
    """
    counts = torch.diff(starts.long(), append=starts.new_full((1,), len(ids)).long())
    longest = max(int(counts.max()) if len(counts) else 0, 1)
    place = torch.arange(longest, device=ids.device)
    listed = place < counts[:, None]
    if not len(ids):
        return torch.zeros_like(listed, dtype=torch.int64), listed
    return torch.where(listed, ids.long()[(starts.long()[:, None] + place).clamp(max=len(ids) - 1)], 0), listed


def _tile_pixels(grid: TileGrid, device: torch.device) -> Tensor:
    """Return the pixel centres of each tile, [T, 256, 2]."""
    side_px = torch.arange(TILE_SIZE, device=device) + 0.5
    y, x = torch.meshgrid(side_px, side_px, indexing="ij")
    inside = torch.stack([x, y], -1).reshape(1, -1, 2)
    row, column = torch.meshgrid(
        torch.arange(grid.tile_height, device=device), torch.arange(grid.tile_width, device=device), indexing="ij"
    )
    return inside + TILE_SIZE * torch.stack([column, row], -1).reshape(-1, 1, 2)
