"""Projection of 3D Gaussians through distorted lenses and rolling shutters, by the unscented transform (3DGUT, Wu et al. 2025)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_same_kind, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.projection.arguments import COMPENSATION_FLOOR, DenseProjection, check_projection_tensors
from gsplat_core.ops.unscented_projection.parameters import UnscentedTransformParameters
from gsplat_core.ops.unscented_projection.plain_torch import Limits, project_unscented
from gsplat_core.poses.rolling_shutter import RollingShutterType, Shutter
from gsplat_core.scene.distortion import FThetaCameraDistortionParameters, Lens


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
    project = project_unscented
    if means.dtype == torch.float32:
        # Loaded when it is first needed, so that float64 works without the compiled library.
        from gsplat_core.ops.unscented_projection.compiled import compiled_applies, project_compiled

        if compiled_applies(means, quats, scales, shutter, Ks, lens):
            project = project_compiled
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
