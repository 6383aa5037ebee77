"""Projection of 3D Gaussians through distorted lenses and rolling shutters, by the unscented transform (3DGUT, Wu et al. 2025).

Compiled kernels run with gradients of means, rotations and scales. The implementation in plain torch supports any
floating dtype and device. It is the reference for tests of the kernels, and runs where other gradients are needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import (
    ALPHA_CUTOFF,
    COMPENSATION_FLOOR,
    MAX_EXTENT_SIGMAS,
    MAX_RADIUS_PX,
    DenseProjection,
    check_projection_tensors,
    require_kernels,
    require_same_kind,
    require_shape,
)
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient
from gsplat_core.poses.se3 import RollingShutterType, Shutter
from gsplat_core.scene.cameras import CAMERA_MODELS
from gsplat_core.scene.distortion import FThetaCameraDistortionParameters, Lens


@dataclass
class UnscentedTransformParameters:
    """Sigma points and validity of the unscented transform (Wan and van der Merwe 2000).

    Raises:
        InvalidInput: for an alpha or a spread that is not positive, or a negative margin.
    """

    alpha: float = 0.1
    """Factor of the spread: the sigma points are `alpha` √(3 + `kappa`) standard deviations from the mean."""
    beta: float = 2.0
    """Summand of the central sigma point's weight in the covariance (`center_weight`); 2 is optimal for Gaussians."""
    kappa: float = 0.0
    """Constant κ in the distance α √(3 + κ) of the sigma points from the mean, in standard deviations."""
    in_image_margin_factor: float = 0.1
    """Margin around the picture in which sigma points are valid, as a share of its size."""
    require_all_sigma_points_valid: bool = True
    """Cull Gaussians with any sigma point outside the picture and its margin. False culls only those with all of them outside.

    A sigma point behind the camera or in a part of the lens that folds over culls the Gaussian in both cases.
    """

    def __post_init__(self) -> None:
        if not (self.alpha > 0 and 3 + self.kappa > 0 and math.isfinite(self.alpha * (3 + self.kappa) + self.beta)):
            raise InvalidInput(
                f"ut_params: alpha must be positive and kappa above -3, got alpha={self.alpha}, kappa={self.kappa}"
            )
        if not self.in_image_margin_factor >= 0:
            raise InvalidInput(
                f"ut_params: in_image_margin_factor must not be negative, got {self.in_image_margin_factor}"
            )

    @property
    def spread(self) -> float:
        """Distance of a sigma point from the mean in standard deviations along its axis."""
        return self.alpha * math.sqrt(3 + self.kappa)

    @property
    def weight(self) -> float:
        """Weight of each outer sigma point in mean and covariance."""
        return 0.5 / self.spread**2

    @property
    def center_weight(self) -> float:
        """Weight of the central sigma point in the covariance; its weight in the mean is 1 less the other six."""
        return 1 - 6 * self.weight + 1 - self.alpha**2 + self.beta


SHUTTER_STEPS = 10
"""Fixed-point steps for the read-out time of a point, as in gsplat. Each step multiplies the error by about the image
motion in pixels per row.
"""


class Limits(NamedTuple):
    """Picture size, blur, clipping planes and lower limits of a projection, as in `fully_fused_projection`."""

    width: int
    height: int
    eps2d: float
    near_plane: float
    far_plane: float
    radius_clip: float
    compensation_floor: float


def project_unscented(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor | None,
    shutter: Shutter,
    Ks: Tensor,
    lens: Lens,
    parameters: UnscentedTransformParameters,
    limits: Limits,
    calc_compensations: bool,
) -> DenseProjection:
    """Project Gaussians by the unscented transform in plain torch; see `fully_fused_projection_with_ut`."""
    with torch.no_grad():
        usable = means.isfinite().all(-1) & quats.isfinite().all(-1) & scales.isfinite().all(-1)
        usable &= (quats != 0).any(-1)
        if opacities is not None:
            usable &= opacities.isfinite()
    # Replace unusable means before the projection, because a masked NaN would reach the gradient.
    means = torch.where(usable[..., None], means, torch.zeros_like(means))
    quats = torch.where(usable[..., None], quats, torch.ones_like(quats))
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    offsets = sigma_offsets(quats, scales) * parameters.spread
    sigma = torch.cat([means[..., None, :], means[..., None, :] + offsets, means[..., None, :] - offsets], -2)
    count = means.shape[-2]
    world = sigma.flatten(-3, -2)[..., None, :, :]
    pixels, seen, inside = _pixels(world, shutter, Ks, lens, limits, parameters.in_image_margin_factor)
    pixels, inside = pixels.unflatten(-2, (count, 7)), inside.unflatten(-1, (count, 7))
    depths = shutter.to_camera(means[..., None, :, :])[..., 2]
    with torch.no_grad():
        valid = usable[..., None, :] & (depths >= limits.near_plane) & (depths <= limits.far_plane)
        valid = valid & seen.unflatten(-1, (count, 7)).all(-1)
        valid = valid & (inside.all(-1) if parameters.require_all_sigma_points_valid else inside.any(-1))
    # Differences to the centre's pixel. The weights are large and of both signs, so absolute positions would cancel.
    center = pixels[..., 0, :]
    apart = torch.where(
        valid[..., None, None], pixels[..., 1:, :] - center[..., None, :], torch.zeros_like(pixels[..., 1:, :])
    )
    moved = parameters.weight * apart.sum(-2)
    covars = parameters.center_weight * moved[..., :, None] * moved[..., None, :]
    rest = apart - moved[..., None, :]
    covars = covars + parameters.weight * (rest[..., :, None] * rest[..., None, :]).sum(-3)
    return _ellipses(center + moved, covars, depths, valid, opacities, limits, calc_compensations)


def sigma_offsets(quats: Tensor, scales: Tensor) -> Tensor:
    """Return the principal axes of Gaussians times their standard deviations, [..., N, 3 axes, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axes = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        *(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        *(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(axes, -1).unflatten(-1, (3, 3)) * scales[..., None]


def _pixels(
    world: Tensor, shutter: Shutter, Ks: Tensor, lens: Lens, limits: Limits, margin: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return pixels [..., C, M, 2] of world points [..., 1, M, 3], and two masks [..., C, M].

    The first mask is True for points that the lens sees, the second for pixels in the picture or its margin.
    """
    projected = lens.project(shutter.to_camera(world), Ks)
    if shutter.rolls:
        for _ in range(SHUTTER_STEPS):
            # Limit the times to the read-out and a margin. Other times would only be reached by points far outside the
            # picture.
            times = shutter.times(projected.points, limits.width, limits.height).clamp(-1, 2)
            projected = lens.project(shutter.to_camera(world, times), Ks)
    x, y = projected.points.detach().unbind(-1)
    across, down = margin * limits.width, margin * limits.height
    inside = (x >= -across) & (x < limits.width + across) & (y >= -down) & (y < limits.height + down)
    return projected.points, projected.valid, inside


def _ellipses(
    means2d: Tensor,
    covars: Tensor,
    depths: Tensor,
    valid: Tensor,
    opacities: Tensor | None,
    limits: Limits,
    calc_compensations: bool,
) -> DenseProjection:
    """Blur the covariances [..., C, N, 2, 2], invert them, and cull; as in `fully_fused_projection`."""
    one, zero = torch.ones_like(depths), torch.zeros_like(depths)
    a0, b, c0 = covars[..., 0, 0], covars[..., 0, 1], covars[..., 1, 1]
    a, c = a0 + limits.eps2d, c0 + limits.eps2d
    det = a * c - b * b
    valid = valid & (det > 0)
    det = torch.where(valid, det, one)
    conics = torch.stack([c / det, -b / det, a / det], -1)
    ratio = (a0 * c0 - b * b) / det
    above = ratio > limits.compensation_floor**2
    compensations = torch.where(above, torch.where(above, ratio, one).sqrt(), one * limits.compensation_floor)
    with torch.no_grad():
        extent = torch.full_like(depths, MAX_EXTENT_SIGMAS)
        if opacities is not None:
            reached = opacities[..., None, :] * (compensations if calc_compensations else 1)
            valid = valid & (reached >= ALPHA_CUTOFF)
            extent = extent.minimum((2 * (reached / ALPHA_CUTOFF).clamp(min=1).log()).sqrt())
        half = (extent[..., None] * torch.stack([a, c], -1).clamp(min=0).sqrt()).ceil().clamp(max=MAX_RADIUS_PX)
        x, y = means2d.unbind(-1)
        valid = valid & means2d.isfinite().all(-1) & conics.isfinite().all(-1) & (half > limits.radius_clip).any(-1)
        valid = valid & (x + half[..., 0] > 0) & (x - half[..., 0] < limits.width)
        valid = valid & (y + half[..., 1] > 0) & (y - half[..., 1] < limits.height)
    kept = valid[..., None]
    return DenseProjection(
        radii=torch.where(kept, half, zero[..., None]).to(torch.int32),
        means2d=torch.where(kept, means2d, zero[..., None]),
        depths=torch.where(valid, depths, zero),
        conics=torch.where(kept, conics, zero[..., None]),
        compensations=torch.where(valid, compensations, zero) if calc_compensations else None,
    )


@in_plain_mode
def fully_fused_projection_with_ut(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    ut_params: UnscentedTransformParameters | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: FThetaCameraDistortionParameters | None = None,
    rolling_shutter: RollingShutterType | None = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
    *,
    compensation_floor: float = COMPENSATION_FLOOR,
) -> DenseProjection:
    """Project 3D Gaussians to 2D image Gaussians by the unscented transform (Wan and van der Merwe 2000; Wu et al. 2025).

    Names and results are those of gsplat 1.5.3, with these differences. The result is differentiable in all tensors,
    cameras and coefficients included. Gaussians are culled where the lens folds over, not where its radial factor falls
    to 0.8. The read-out time is continuous instead of rounded to rows. `camera_model` may be "ortho".

    Compiled kernels project float32 Gaussians if no tensor of the camera needs a gradient. Otherwise, and for "ftheta", the
    same is computed in torch operations.

    Args:
        means: floating point [..., N, 3]; `...` are any batch dimensions, common to all inputs.
        quats: [..., N, 4] wxyz, of any non-zero length.
        scales: [..., N, 3], standard deviations.
        opacities: [..., N]; as in `fully_fused_projection`.
        viewmats: world-to-camera [..., C, 4, 4], OpenCV axes; at the start of the read-out for a rolling shutter.
        Ks: intrinsics [..., C, 3, 3] in pixels, without skew.
        width, height: image size in pixels.
        eps2d, near_plane, far_plane, radius_clip, calc_compensations, compensation_floor: as in `fully_fused_projection`.
        camera_model: "pinhole", "ortho", "fisheye" or "ftheta".
        ut_params: parameters of the unscented transform; None for its defaults.
        radial_coeffs: OpenCV's k1 to k6 [..., C, 6] for "pinhole", k1 to k4 [..., C, 4] for "fisheye".
        tangential_coeffs: OpenCV's p1, p2 [..., C, 2]; "pinhole" only.
        thin_prism_coeffs: OpenCV's s1 to s4 [..., C, 4]; "pinhole" only.
        ftheta_coeffs: parameters of "ftheta", common to all cameras.
        rolling_shutter: read-out order.
        viewmats_rs: world-to-camera [..., C, 4, 4] at the end of the read-out.

    Returns:
        radii, means2d, depths (z at the middle of the read-out), conics and compensations; zero where culled.

    Raises:
        InvalidInput: for wrong shapes, dtypes, devices or options.
    """
    batch_dims = check_projection_tensors(means, None, quats, scales, opacities, viewmats, Ks)
    if width < 1 or height < 1:
        raise InvalidInput(f"the image must be at least 1x1 px, got width={width}, height={height}")
    lens, shutter = checked_camera(
        (*batch_dims, viewmats.shape[-3]), viewmats, Ks, camera_model, radial_coeffs, tangential_coeffs,
        thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs,
    )  # fmt: skip
    limits = Limits(width, height, eps2d, near_plane, far_plane, radius_clip, compensation_floor)
    parameters = UnscentedTransformParameters() if ut_params is None else ut_params
    opacities = None if opacities is None else opacities.detach()
    compiled = means.dtype == torch.float32 and compiled_applies(means, quats, scales, shutter, Ks, lens)
    project = project_compiled if compiled else project_unscented
    return project(means, quats, scales, opacities, shutter, Ks, lens, parameters, limits, calc_compensations)


def checked_camera(
    image_dims: tuple[int, ...],
    viewmats: Tensor,
    Ks: Tensor,
    camera_model: str,
    radial_coeffs: Tensor | None,
    tangential_coeffs: Tensor | None,
    thin_prism_coeffs: Tensor | None,
    ftheta_coeffs: FThetaCameraDistortionParameters | None,
    rolling_shutter: RollingShutterType | None,
    viewmats_rs: Tensor | None,
) -> tuple[Lens, Shutter]:
    """Return lens and shutter of cameras with the leading dimensions `image_dims` = [..., C].

    Raises:
        InvalidInput: for coefficients of other shapes, dtypes or devices than the cameras, or that the model does not have.
    """
    coefficients = {
        "radial_coeffs": radial_coeffs,
        "tangential_coeffs": tangential_coeffs,
        "thin_prism_coeffs": thin_prism_coeffs,
    }
    lens = Lens(camera_model, radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs)
    for name, value in coefficients.items():
        if value is not None:
            require_shape(name, value, (*image_dims, value.shape[-1]), "[..., C, coefficients]")
    require_same_kind(viewmats=viewmats, Ks=Ks, viewmats_rs=viewmats_rs, **coefficients)
    return lens, Shutter.of(viewmats, viewmats_rs, rolling_shutter)


CAMERA_COLUMNS = 35
"""Number of values that describe a camera to the kernels: intrinsics, lens coefficients, fold-over limit of the lens, pose and
motion during the read-out (`unscented_projection.h`).
"""


def compiled_applies(means: Tensor, quats: Tensor, scales: Tensor, shutter: Shutter, Ks: Tensor, lens: Lens) -> bool:
    """Return True unless the camera needs a gradient, or has no kernels (f-theta, other dtypes)."""
    camera = (shutter.first, shutter.shift, shutter.turn, Ks, lens.radial, lens.tangential, lens.thin_prism)
    if torch.is_grad_enabled() and any(each is not None and each.requires_grad for each in camera):
        return False
    return lens.model in CAMERA_MODELS and all(each.dtype == torch.float32 for each in (means, quats, scales, Ks))


@torch.no_grad()
def camera_rows(shutter: Shutter, Ks: Tensor, lens: Lens) -> Tensor:
    """Return the values that describe each camera to the kernels, [..., C, 35]; see `CAMERA_COLUMNS`."""
    dims = Ks.shape[:-2]
    row = lambda value, columns: (
        Ks.new_zeros(*dims, columns)
        if value is None
        else torch.nn.functional.pad(value, (0, columns - value.shape[-1]))
    )
    limit = lens.fold_limit(Ks)
    return torch.cat(
        [
            Ks.diagonal(dim1=-2, dim2=-1)[..., :2],
            Ks[..., :2, 2],
            row(lens.radial, 6),
            row(lens.tangential, 2),
            row(lens.thin_prism, 4),
            (limit * limit if lens.model == "pinhole" else limit).expand(*dims, 1),
            shutter.first[..., :3, :3].flatten(-2),
            shutter.first[..., :3, 3],
            row(shutter.shift, 3),
            row(shutter.turn, 3),
        ],
        -1,
    )


def project_compiled(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor | None,
    shutter: Shutter,
    Ks: Tensor,
    lens: Lens,
    parameters: UnscentedTransformParameters,
    limits: Limits,
    calc_compensations: bool,
) -> DenseProjection:
    """Project Gaussians by the compiled kernels, with the result of `project_unscented` in plain torch.

    The caller has checked that `compiled_applies`.
    """
    require_kernels("fully_fused_projection_with_ut", "means", means)
    batch_dims, n, c = means.shape[:-2], means.shape[-2], Ks.shape[-3]
    batches = math.prod(batch_dims)
    means2d, depths, conics, compensations, radii = torch.ops.gsplat_core.project_unscented(
        means.reshape(batches, n, 3), quats.reshape(batches, n, 4), scales.reshape(batches, n, 3),
        None if opacities is None else opacities.reshape(batches, n),
        camera_rows(shutter, Ks, lens).reshape(batches, c, CAMERA_COLUMNS), CAMERA_MODELS.index(lens.model),
        shutter.kind.value, lens.distorted, limits.width, limits.height, limits.eps2d, limits.near_plane, limits.far_plane,
        limits.radius_clip, calc_compensations, limits.compensation_floor, parameters.spread, parameters.weight,
        parameters.center_weight, parameters.in_image_margin_factor, parameters.require_all_sigma_points_valid,
    )  # fmt: skip
    rows = (*batch_dims, c, n)
    return DenseProjection(
        radii.reshape(*rows, 2), means2d.reshape(*rows, 2), depths.reshape(rows), conics.reshape(*rows, 3),
        compensations.reshape(rows) if calc_compensations else None,
    )  # fmt: skip


@torch.library.register_fake("gsplat_core::project_unscented")
def _fake(*arguments: Any) -> tuple[Tensor, ...]:
    means, cameras, compensate = arguments[0], arguments[4], arguments[14]
    b, n, _ = means.shape
    c = cameras.shape[1]
    return (
        means.new_empty((b, c, n, 2)),
        means.new_empty((b, c, n)),
        means.new_empty((b, c, n, 3)),
        means.new_empty((b, c, n) if compensate else (0,)),
        means.new_empty((b, c, n, 2), dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::project_unscented_backward")
def _fake_backward(means: Tensor, quats: Tensor, scales: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    return means.new_empty(means.shape), quats.new_empty(quats.shape), scales.new_empty(scales.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    means, quats, scales, _, cameras, model, shutter, distorted, width, height, eps2d, *rest = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(means, quats, scales, cameras, output[4])
    ctx.compensate = rest[3]
    ctx.options = (model, shutter, distorted, width, height, eps2d, *rest[4:8])


def _backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
    v_means2d, v_depths, v_conics, v_compensations, _ = v
    v_means, v_quats, v_scales = torch.ops.gsplat_core.project_unscented_backward(
        *ctx.saved_tensors, v_means2d, v_depths, v_conics, v_compensations if ctx.compensate else None, *ctx.options
    )
    needs = ctx.needs_input_grad
    gradients = [value if needed else None for value, needed in zip((v_means, v_quats, v_scales), needs, strict=False)]
    return (*gradients, *[None] * 18)


register_gradient("gsplat_core::project_unscented", _backward, setup_context=_setup_context)
