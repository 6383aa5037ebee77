"""Experimental: Gaussians cut by Bézier curves, which show sharp edges (after Qu et al. 2024, "DisC-GS").

A splat has M cubic Bézier curves in the plane of its first two axes. Their control points, in standard deviations, are the
tensor `curves` [N, M, 4, 2] of `Gaussians.extra`. The splat shows on the positive side of all its projected curves. At a curve
its opacity falls from full to none across about a pixel, by the signed distance, so that edges are antialiased and
differentiable. Plain torch over tiles, on the CPU and on CUDA; memory grows with the longest tile list.

DisC-GS cuts by the sign of the implicit form (`implicit_form`), and its gradient follows from the smallest shift of a control
point that changes the sign. The sign of a straight curve depends on the spacing of its control points, and even spacing gives 0.
The kernel therefore cuts by the distance.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.flow import projected
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians, inert_gaussians, rotations

CURVES = "curves"
"""Key in `Gaussians.extra` of the control points of the splats' Bézier curves."""
BINOMIALS = (1.0, 3.0, 3.0, 1.0)
PAIRS = ((3, 2), (3, 1), (3, 0), (2, 1), (2, 0), (1, 0))
"""Pairs (i, j) of control points whose terms l_ij are the elements of the determinant in `implicit_form`."""
CHORDS = 8
"""Chords of a curve among which the search for the nearest point starts."""
REFINEMENTS = 2
"""Newton steps from the nearest chord to the nearest point of the curve. The error of the distance is of second order in that of
the parameter.
"""
LARGEST_STEP = 0.5 / CHORDS
"""Bound of a Newton step in the curve's parameter, which keeps the point near its chord at a cusp."""
TINY = 1e-20
"""Lower bound of squared lengths in divisions."""
TILE_SIZE, MAX_ALPHA, LEAST_ALPHA = 16, 0.99, 1 / 255


def implicit_form(points: Tensor, curves: Tensor) -> Tensor:
    """Return the implicit form f [...] of cubic Bézier curves [..., 4, 2] at points [..., 2] (Sederberg 1983).

    f = det [[l32, l31, l30], [l31, l30 + l21, l20], [l30, l20, l10]] with l_ij = C(3,i) C(3,j) det [p, p_i, p_j]. It is 0 on the
    curve, and everywhere if the curve is of degree 2 or 1. Differentiable.
    """
    x, y = points.unbind(-1)
    px, py = curves[..., 0].unbind(-1), curves[..., 1].unbind(-1)
    terms = {
        (i, j): BINOMIALS[i]
        * BINOMIALS[j]
        * (x * (py[i] - py[j]) - y * (px[i] - px[j]) + (px[i] * py[j] - px[j] * py[i]))
        for i, j in PAIRS
    }
    a, b, c = terms[3, 2], terms[3, 1], terms[3, 0]
    d, e, g = c + terms[2, 1], terms[2, 0], terms[1, 0]
    return a * (d * g - e * e) - b * (b * g - c * e) + c * (b * e - c * d)


class _Foot(NamedTuple):
    """Nearest points of curves to given points."""

    distance: Tensor
    """Signed distance, [...]; see `signed_distance`."""
    normal: tuple[Tensor, Tensor]
    """Derivatives of the distance by the two coordinates of the point, [...] each."""
    weights: tuple[Tensor, ...]
    """Weights [...] of the four control points whose sum is the nearest point of the curve."""


def _weights(t: Tensor) -> tuple[Tensor, ...]:
    """Return the weights of the control points at parameters t. Outside of 0 to 1 the curve continues along its tangent."""
    inner = t.clamp(0, 1)
    before, beyond = 3 * t.clamp(max=0), 3 * (t - 1).clamp(min=0)
    rest = 1 - inner
    return rest**3 - before, 3 * inner * rest * rest + before, 3 * inner * inner * rest - beyond, inner**3 + beyond


class _Powers(NamedTuple):
    """Coefficients c0 + c1 t + c2 t² + c3 t³ of one coordinate of cubic curves, [...] each."""

    c0: Tensor
    c1: Tensor
    c2: Tensor
    c3: Tensor

    @staticmethod
    def of(p: Tensor) -> _Powers:
        """Return the coefficients for one coordinate of the control points, [4, ...]."""
        return _Powers(p[0], 3 * (p[1] - p[0]), 3 * (p[2] - 2 * p[1] + p[0]), p[3] - p[0] + 3 * (p[1] - p[2]))

    def at(self, t: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the coordinate and its first two derivatives at parameters t in 0 to 1."""
        return (
            ((self.c3 * t + self.c2) * t + self.c1) * t + self.c0,
            (3 * self.c3 * t + 2 * self.c2) * t + self.c1,
            6 * self.c3 * t + 2 * self.c2,
        )


def _nearest(points: Tensor, curves: Tensor) -> _Foot:
    """Return the nearest points of curves [4, 2, ...] to points [2, ...], without autograd.

    The nearest of `CHORDS` chords and of the two tangents beyond the ends is refined by Newton's method.
    """
    x, y = points
    px, py = _Powers.of(curves[:, 0]), _Powers.of(curves[:, 1])
    places = [(px.at(k / CHORDS)[0], py.at(k / CHORDS)[0]) for k in range(CHORDS + 1)]
    (ax, ay), (bx, by) = places[0], places[-1]
    # Origin, direction, and range of the parameter of the tangent before the curve, the chords and the tangent after it.

    spans: list[tuple[Tensor, Tensor, Tensor, Tensor, float, float, float | None, float | None]] = [
        (ax, ay, px.c1, py.c1, 0.0, 1.0, None, 0.0)
    ]
    for k, ((ax, ay), (bx, by)) in enumerate(pairwise(places)):
        spans.append((ax, ay, bx - ax, by - ay, k / CHORDS, 1 / CHORDS, 0.0, 1.0))
    spans.append((bx, by, 3 * (bx - curves[2, 0]), 3 * (by - curves[2, 1]), 1.0, 1.0, 0.0, None))
    closest = t = torch.full_like(x * curves[0, 0], torch.inf)
    for ax, ay, ux, uy, first, length, least, most in spans:
        gx, gy = x - ax, y - ay
        share = ((gx * ux + gy * uy) / (ux * ux + uy * uy).clamp(min=TINY)).clamp(least, most)
        gap = (gx - share * ux).square() + (gy - share * uy).square()
        t = torch.where(gap < closest, first + length * share, t)
        closest = torch.minimum(closest, gap)
    for left in range(REFINEMENTS, -1, -1):
        inner = t.clamp(0, 1)
        (fx, sx, bx), (fy, sy, by) = px.at(inner), py.at(inner)
        beyond = t - inner
        gx, gy = x - fx - beyond * sx, y - fy - beyond * sy
        speed = sx * sx + sy * sy
        if left:
            bent = torch.where(beyond == 0, speed - gx * bx - gy * by, speed)
            step = (gx * sx + gy * sy) / torch.maximum(bent, 0.5 * speed).clamp(min=TINY)
            t = t + step.clamp(-LARGEST_STEP, LARGEST_STEP)
    # A curve has no tangent where control points coincide; its chord gives the direction there.
    still = speed <= TINY
    sx, sy = torch.where(still, curves[3, 0] - curves[0, 0], sx), torch.where(still, curves[3, 1] - curves[0, 1], sy)
    scale = (sx * sx + sy * sy).clamp(min=TINY).rsqrt()
    normal = -sy * scale, sx * scale
    return _Foot(gx * normal[0] + gy * normal[1], normal, _weights(t))


class _SignedDistance(torch.autograd.Function):
    """Autograd function of `signed_distance` for points [2, ...] and curves [4, 2, ...]."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, curves: Tensor) -> Tensor:
        found = _nearest(points, curves)
        ctx.save_for_backward(*found.normal, *found.weights)
        ctx.shapes = points.shape[1:], curves.shape[2:]
        return found.distance

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        # The nearest point moves along the curve only, which does not change the distance to first order.
        *normal, w0, w1, w2, w3 = ctx.saved_tensors
        of_points, of_curves = ctx.shapes
        moved = [gradient * each for each in normal]
        by_points = by_curves = None
        if ctx.needs_input_grad[0]:
            by_points = torch.stack([each.sum_to_size(of_points) for each in moved])
        if ctx.needs_input_grad[1]:
            by_curves = -torch.stack(
                [torch.stack([(w * each).sum_to_size(of_curves) for each in moved]) for w in (w0, w1, w2, w3)]
            )
        return by_points, by_curves


def signed_distance(points: Tensor, curves: Tensor) -> Tensor:
    """Return the signed distance [...] of points [..., 2] from cubic Bézier curves [..., 4, 2].

    The curves continue beyond their ends along the end tangents, so that each divides the plane. With y down, the distance is
    positive to the right of a curve's direction from its first to its last control point. Differentiable in points and curves:
    ∂d/∂point is the unit normal n at the nearest point Σ w_i p_i of the curve, and ∂d/∂p_i = -w_i n. Straight curves are not a
    special case. The distance from a curve whose control points all coincide is 0.
    """
    return _SignedDistance.apply(points.movedim(-1, 0), curves.movedim((-2, -1), (0, 1)))


class GaussianKernel:
    """Falloff of an ordinary Gaussian splat, not cut by curves."""

    name = "gaussian"
    extra: tuple[str, ...] = ()
    """Names of the tensors in `Gaussians.extra` that the kernel needs."""


class CutKernel(GaussianKernel):
    """Falloff of a Gaussian cut by Bézier curves: unchanged on the positive side of all its curves, 0 elsewhere.

    Args:
        width_px: width of an edge. The share of the opacity that shows is a logistic function of the signed distance, with slope
            1 / width_px at the curve. 1 suits antialiased pictures. Training starts with wider edges, whose gradients reach
            farther pixels.

    Raises:
        InvalidSetting: for a width that is not positive.
    """

    name = "cut"
    extra = (CURVES,)

    def __init__(self, width_px: float = 1.0) -> None:
        if not 0 < width_px < math.inf:
            raise InvalidSetting(f"width_px is {width_px}; it must be positive")
        self.width_px = width_px

    def factors(self, points: Tensor, curves: Tensor) -> Tensor:
        """Return the factors [E] of alpha at points [2, E] for control points [4, 2, M, E], all in pixels."""
        return torch.sigmoid(_SignedDistance.apply(points[:, None], curves) * (4 / self.width_px)).prod(0)


def with_curves(gaussians: Gaussians, count: int, random: torch.Generator, distance: float = 1.5) -> Gaussians:
    """Add `count` straight curves to each splat, `distance` standard deviations from its centre.

    The splat shows on the side of its centre. The directions of a splat's curves divide the circle equally from a random start.
    """
    n = gaussians.count
    along = torch.tensor([-3.0, -1.0, 1.0, 3.0]).expand(n, count, 4)
    first = torch.rand(n, 1, 1, generator=random)
    angle = 2 * math.pi * (first + torch.arange(count)[:, None] / count)
    across = torch.full_like(along, distance)
    curves = torch.stack([angle.cos() * across - angle.sin() * along, angle.sin() * across + angle.cos() * along], -1)
    curves = curves.to(gaussians.device, gaussians.dtype)
    return replace(gaussians, extra={**gaussians.extra, CURVES: curves})


def projected_curves(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return the control points [N, M, 4, 2] in pixels, in reverse order for splats that are seen from behind, which keeps the
    side on which they show.
    """
    curves = gaussians.extra[CURVES]
    rotation = rotations(gaussians.quats)
    axes = rotation[:, :, :2] * gaussians.scales[:, None, :2]
    places = gaussians.means[:, None, None] + torch.einsum("nij,nmkj->nmki", axes, curves)
    view, K = camera.matrices(gaussians.device, gaussians.dtype)
    local = places @ view[:3, :3].T + view[:3, 3]
    depth = torch.ones_like(local[..., 2:]) if camera.model == "ortho" else local[..., 2:].clamp(min=1e-6)
    pixels = local[..., :2] / depth * K.diagonal()[:2] + K[:2, 2]
    normals = rotation[:, :, 2] @ view[:3, :3].T
    rays = (
        normals.new_tensor([0.0, 0, 1]) if camera.model == "ortho" else gaussians.means @ view[:3, :3].T + view[:3, 3]
    )
    return torch.where(((normals * rays).sum(1) < 0)[:, None, None, None], pixels.flip(-2), pixels)


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
    if not gaussians.count:
        # The lists of tiles are padded with the first splat, which must exist.
        gaussians = inert_gaussians(gaussians, 1)
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
    shown = listed[:, None] & (sigma >= 0) & (alpha >= LEAST_ALPHA)
    if isinstance(kernel, CutKernel):
        factors = _cut_factors(kernel, projected_curves(gaussians, camera), shown, lists, pixels)
        alpha = alpha * factors
        shown = shown & (alpha >= LEAST_ALPHA)
    alpha = torch.where(shown, alpha, 0)
    after = torch.cumprod(1 - alpha, -1)
    through = torch.cat([torch.ones_like(after[..., :1]), after], -1)
    colours = (gaussians.sh[:, 0] * SH_C0 + 0.5).clamp_min(0)
    values = ((alpha * through[..., :-1])[..., None] * colours[lists][:, None]).sum(2)
    if background is not None:
        values = values + through[..., -1:] * background
    picture = values.reshape(grid.tile_height, grid.tile_width, TILE_SIZE, TILE_SIZE, 3).transpose(1, 2)
    return picture.reshape(grid.tile_height * TILE_SIZE, -1, 3)[: camera.height_px, : camera.width_px]


def _cut_factors(kernel: CutKernel, curves: Tensor, shown: Tensor, lists: Tensor, pixels: Tensor) -> Tensor:
    """Return the kernel's factors of alpha [T, P, L] where `shown`, 0 elsewhere. Synchronises with the device.

    Args:
        curves: control points in pixels, [N, M, 4, 2].
        shown: bool [T, P, L].
        lists: splats of each tile, int64 [T, L].
        pixels: pixel centres of each tile, [T, P, 2].
    """
    tile, pixel, place = torch.nonzero(shown, as_tuple=True)
    # The backward pass of `embedding` is faster on the CPU than that of indexing.
    each = torch.nn.functional.embedding(lists[tile, place], curves.flatten(1))
    planes = each.T.contiguous().unflatten(0, curves.shape[1:]).movedim(0, 2)
    found = kernel.factors(pixels[tile, pixel].T, planes)
    return torch.zeros_like(shown, dtype=found.dtype).masked_scatter(shown, found)


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
