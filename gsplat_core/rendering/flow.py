"""Optical flow and occlusion between two states of a scene, rendered from its Gaussians, with gradients.

A splat carries the surface that it shows in a pixel by the affine motion of its neighbourhood. The motion's matrix F is
the deformation gradient of continuum mechanics: the least-squares map from the offsets of the nearest splats at the
first time to their offsets at the second, regularised towards the splat's own rotation. It follows rotation, stretch and
shear, which the motion of the mean alone does not.

`mode="gaussianflow"` offers the published map B2 B1⁻¹ between screen ellipses (Gao et al. 2024, "GaussianFlow"). It
misses rotation: a round ellipse looks the same after it.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.ops.arguments import DenseProjection, TileGrid
from gsplat_core.ops.flow_blending import blend_flow
from gsplat_core.ops.neighbour_motion import neighbour_motion
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.splat_rays import RAY_NUMBERS, splat_rays
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.settings import TILE_SIZE
from gsplat_core.rendering.surface import COVERED, render_rays
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians, rotations

FlowMode = Literal["neighbours", "gaussianflow"]
NEIGHBOURS = 12
"""Number of nearest splats from which a splat's affine motion is estimated."""
STIFFNESS = 1e-3
"""Weight of the splat's own rotation relative to the mean square of the neighbours' offsets.

It decides the motion across a surface, where the neighbours have no offsets.
"""


class RenderedFlow(NamedTuple):
    """Motion of the surface in each pixel of the first picture; 0 where it is not `observed`."""

    flow: Tensor
    """Displacement in pixels to the right and down, [H, W, 2]."""
    depth: Tensor
    """Depth z in the second camera's axes to which the surface of each first-camera pixel moves, [H, W]."""
    alpha: Tensor
    """Accumulated opacity [H, W] of the splats that arrive in front of the second camera."""

    @property
    def observed(self) -> Tensor:
        """Mask [H, W], True for pixels whose opacity is high enough for a flow."""
        return self.alpha >= COVERED


def render_flow(
    gaussians_1: Gaussians,
    gaussians_2: Gaussians,
    camera_1: Camera,
    camera_2: Camera,
    *,
    mode: FlowMode = "neighbours",
    neighbours: Tensor | None = None,
) -> RenderedFlow:
    """Render the motion of each pixel's surface from the first to the second time.

    Differentiable in the means and rotations of `gaussians_2` (with `gaussianflow` also in its scales). The first state
    and the blending weights have no gradient.

    Args:
        gaussians_1: Gaussians at the first time, float32.
        gaussians_2: the same Gaussians at the second time, in the same order.
        camera_1: pinhole camera of the result.
        camera_2: pinhole camera at the second time.
        mode: map from the surface around a splat at the first time to the second: affine motion of the neighbouring splats,
            or `gaussianflow` between screen ellipses.
        neighbours: indices int64 [N, K] of the splats around each splat; None to search them (`nearest_splats`), which
            synchronises with the device.

    Raises:
        InvalidInput: for different numbers of Gaussians, or cameras other than pinholes.
        InvalidSetting: for an unknown mode.
    """
    if mode not in get_args(FlowMode):
        raise InvalidSetting(f"the mode of the flow is {mode!r}; choose {' or '.join(get_args(FlowMode))}")
    if gaussians_1.count != gaussians_2.count:
        raise InvalidInput(
            f"flow needs the same Gaussians at both times, got {gaussians_1.count} and {gaussians_2.count}"
        )
    for camera in (camera_1, camera_2):
        if camera.model != "pinhole":
            raise InvalidInput(f"flow is rendered for pinhole cameras, got {camera.model!r}; use a pinhole camera")
    first = gaussians_1.detach()
    with torch.no_grad():
        rows = projected(first, camera_1)
    if mode == "gaussianflow":
        rays = rows.depths.new_zeros(first.count, RAY_NUMBERS)
        rays[:, 0] = 1
        planes = _screen_planes(rows, projected(gaussians_2, camera_2), camera_1, camera_2)
    else:
        if neighbours is None:
            neighbours = nearest_splats(first)
        with torch.no_grad():
            view, K = camera_1.matrices(first.device, first.dtype)
            rays = splat_rays(first.means, first.quats, first.scales, view, K, camera_1.model).rays
        gradients = deformation_gradients(first, gaussians_2, neighbours)
        planes = _moved_planes(first.means, gaussians_2.means, gradients, camera_1, camera_2)
    opacities = first.opacities
    grid = TileGrid(TILE_SIZE, -(-camera_1.width_px // TILE_SIZE), -(-camera_1.height_px // TILE_SIZE))
    with torch.no_grad():
        _, ids, starts = bin_splats(
            rows.means2d[None], rows.radii[None], rows.depths[None], grid, conics=rows.conics[None],
            opacities=opacities[None],
        )  # fmt: skip
    tiles = starts.reshape(grid.tile_height, grid.tile_width)
    blended = blend_flow(rows.means2d, rows.conics, opacities, rays, planes, camera_1, camera_2, tiles, ids)
    weight = blended[..., 3]
    known = blended[..., :3] / weight.clamp(min=1e-10)[..., None]
    known = torch.where((weight >= COVERED)[..., None], known, 0)
    return RenderedFlow(known[..., :2], known[..., 2], weight.detach())


def render_depth(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return the expected z [H, W] along the rays, differentiable; 0 where nothing is observed."""
    rays = render_rays(gaussians, camera)
    return torch.where(rays.alphas >= COVERED, rays.depths, 0)


@torch.no_grad()
def render_motion(
    gaussians_1: Gaussians, gaussians_2: Gaussians, camera: Camera, neighbours: Tensor | None = None
) -> dict[str, Tensor]:
    """Return the outputs `flow` [H, W, 2] and `occlusion` [H, W] for one camera at two times."""
    if neighbours is None:
        neighbours = nearest_splats(gaussians_1)
    forward = render_flow(gaussians_1, gaussians_2, camera, camera, neighbours=neighbours)
    backward = render_flow(gaussians_2, gaussians_1, camera, camera, neighbours=neighbours)
    hidden = occluded(forward, backward, render_depth(gaussians_2, camera))
    return {"flow": forward.flow, "occlusion": hidden.to(forward.flow.dtype)}


NOT_BEHIND = 0.02
"""Largest distance behind the visible surface, relative to its depth, at which a point counts as visible."""
CONSISTENT_PX = 1.0
"""Largest difference in pixels between a point's position and the position after moving there and back."""


@torch.no_grad()
def occluded(forward: RenderedFlow, backward: RenderedFlow, depth_2: Tensor) -> Tensor:
    """Return the pixels, bool [H, W], whose surface is not visible at the second time.

    It is hidden if it arrives more than 2 % behind the depth at its new pixel, if the backward flow does not return to
    within 1 px of the pixel, or if it arrives outside of the second picture. Unobserved pixels are not occluded.

    Args:
        forward: flow from the first picture to the second.
        backward: flow from the second picture to the first.
        depth_2: depth of the second picture [h, w], 0 where unknown.
    """
    height, width = forward.alpha.shape
    y, x = torch.meshgrid(
        torch.arange(height, device=depth_2.device), torch.arange(width, device=depth_2.device), indexing="ij"
    )
    there = torch.stack([x, y], -1) + 0.5 + forward.flow
    size = there.new_tensor([depth_2.shape[1], depth_2.shape[0]])
    outside = ((there < 0) | (there > size)).any(-1)
    planes = torch.cat([backward.flow, depth_2[..., None]], -1)
    seen = sampled(planes, there)
    behind = (seen[..., 2] > 0) & (forward.depth > (1 + NOT_BEHIND) * seen[..., 2])
    inconsistent = (forward.flow + seen[..., :2]).norm(dim=-1) > CONSISTENT_PX
    return forward.observed & (outside | behind | inconsistent)


def sampled(planes: Tensor, pixels: Tensor) -> Tensor:
    """Sample planes [h, w, C] bilinearly at pixel coordinates [H, W, 2], clamped at the edge. Returns [H, W, C]."""
    size = pixels.new_tensor([planes.shape[1], planes.shape[0]])
    grid = (2 * pixels / size - 1).clamp(-2, 2)
    read = torch.nn.functional.grid_sample(
        planes.permute(2, 0, 1)[None], grid[None], padding_mode="border", align_corners=False
    )
    return read[0].permute(1, 2, 0)


def projected(gaussians: Gaussians, camera: Camera) -> DenseProjection:
    """Return the projection of Gaussians to one camera, with tensors [N, ...] that have no camera dimension."""
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    dense = fully_fused_projection(
        gaussians.means, None, gaussians.quats, gaussians.scales, viewmat[None], intrinsics[None], camera.width_px,
        camera.height_px, camera_model=camera.model, opacities=gaussians.opacities,
    )  # fmt: skip
    assert isinstance(dense, DenseProjection)
    return DenseProjection(*(None if column is None else column[0] for column in dense))  # type: ignore[arg-type]


def nearest_splats(gaussians: Gaussians) -> Tensor:
    """Return the indices int64 [N, K] of the splats around each splat, K at most `NEIGHBOURS`. Synchronises."""
    return nearest_others(gaussians.means, NEIGHBOURS)


def deformation_gradients(first: Gaussians, second: Gaussians, neighbours: Tensor) -> Tensor:
    """Return the matrices F [N, 3, 3] of the affine motion around each Gaussian between two times.

    F = (Σ d2 d1ᵀ / K + λ R2 R1ᵀ) (Σ d1 d1ᵀ / K + λ I)⁻¹, with d the offsets of the K neighbours and λ a thousandth of the
    trace of Σ d1 d1ᵀ / K. Without neighbours, or with all of them at one place, F is the Gaussian's rotation.
    """
    turned = rotations(second.quats) @ rotations(first.quats).transpose(1, 2)
    if neighbours.shape[1] == 0:
        return turned
    if turned.is_cpu and turned.dtype == torch.float32:
        return neighbour_motion(first.means.detach(), second.means, turned, neighbours.int(), STIFFNESS)
    count = neighbours.shape[1]
    before = (first.means[neighbours] - first.means[:, None]).detach()
    after = second.means[neighbours] - second.means[:, None]
    spread = (before.square().sum((1, 2)) / count)[:, None, None]
    apart = spread > 0
    # Divided by the sum of the neighbours' squared distances, so that no product is too small for float32.
    unit = torch.where(apart, count * spread, 1)
    moments = before.transpose(1, 2) @ before / unit
    moments.diagonal(dim1=1, dim2=2).add_(STIFFNESS)
    both = after.transpose(1, 2) @ before / unit + STIFFNESS * turned
    # In double precision, because neighbours on a line or plane leave small determinants.
    return torch.where(apart, both @ _inverse(moments.double()).to(both.dtype), turned)


def _inverse(matrices: Tensor) -> Tensor:
    """Invert symmetric positive definite matrices [N, 3, 3] by their adjugates, faster than LAPACK for many."""
    a, b, c = matrices.unbind(1)
    adjugate = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 2)
    return adjugate / (a * adjugate[:, :, 0]).sum(1)[:, None, None]


def _moved_planes(means_1: Tensor, means_2: Tensor, gradients: Tensor, camera_1: Camera, camera_2: Camera) -> Tensor:
    """Return the motion X -> means_2 + F (X - means_1) as X -> a + B X in camera coordinates: a and B by rows, [N, 12]."""
    view_1, _ = camera_1.matrices(means_1.device, means_1.dtype)
    view_2, _ = camera_2.matrices(means_1.device, means_1.dtype)
    local_1 = means_1 @ view_1[:3, :3].T + view_1[:3, 3]
    local_2 = means_2 @ view_2[:3, :3].T + view_2[:3, 3]
    B = view_2[:3, :3] @ gradients @ view_1[:3, :3].T
    return torch.cat([local_2 - (B @ local_1[..., None])[..., 0], B.flatten(1)], 1)


def _screen_planes(first: DenseProjection, second: DenseProjection, camera_1: Camera, camera_2: Camera) -> Tensor:
    """Return the map between screen ellipses as X -> a + B X from points at depth 1 on the first camera's rays to the
    second camera's coordinates: a and B by rows, [N, 12]; NaN for a splat that is not in both pictures.
    """
    _, K_1 = camera_1.matrices(first.depths.device, first.depths.dtype)
    _, K_2 = camera_2.matrices(first.depths.device, first.depths.dtype)
    focal, centre = K_2[[0, 1], [0, 1]], K_2[:2, 2]
    seen = (first.radii > 0).all(-1) & (second.radii > 0).all(-1)
    round_ = first.conics.new_tensor([1, 0, 1])
    of_first, of_second = (torch.where(seen[:, None], rows.conics, round_) for rows in (first, second))
    # An ellipse's covariance is the inverse of its conic.
    M = _inverse_2x2(_square_root(of_second)) @ _square_root(of_first)
    means_1, means_2, z = (
        torch.where(seen[:, None], each, 1) for each in (first.means2d, second.means2d, second.depths[:, None])
    )
    offset = (means_2 - (M @ means_1[..., None])[..., 0] - centre) / focal
    a = torch.cat([offset, torch.ones_like(z)], 1) * z
    B = torch.cat([M @ K_1[:2] / focal[:, None], torch.zeros_like(M[:, :1, [0, 0, 0]])], 1) * z[..., None]
    return torch.where(seen[:, None], torch.cat([a, B.flatten(1)], 1), torch.nan)


def _square_root(triangles: Tensor) -> Tensor:
    """Return the symmetric square roots [N, 2, 2] of positive definite matrices given as upper triangles [N, 3]."""
    xx, xy, yy = triangles.unbind(1)
    root = (xx * yy - xy * xy).clamp(min=1e-20).sqrt()
    scale = (xx + yy + 2 * root).sqrt()
    return torch.stack([xx + root, xy, xy, yy + root], 1).unflatten(1, (2, 2)) / scale[:, None, None]


def _inverse_2x2(matrices: Tensor) -> Tensor:
    a, b, c, d = matrices.flatten(1).unbind(1)
    return torch.stack([d, -b, -c, a], 1).unflatten(1, (2, 2)) / (a * d - b * c)[:, None, None]
