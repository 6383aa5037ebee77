"""Separate steps of the projection of Gaussians in plain torch: world to camera, and camera to picture.

Any floating dtype and device, differentiable. `fully_fused_projection` does both in one op.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import FOV_MARGIN, require_same_kind, require_shape, require_trailing

FISHEYE_SERIES_BELOW = 0.01
"""Bound of tan θ below which the fisheye's quotients by r use their Taylor series."""


def _pinhole(p: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Project with the pinhole model.

    Returns image points [..., C, N, 2] and Jacobians [..., C, N, 2, 3] of camera-space points [..., C, N, 3].
    """
    x, y, z = p.unbind(-1)
    fx, fy, cx, cy = (Ks[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    # The linearisation diverges far off axis, so it is evaluated at the border of a slightly larger view.
    slope_x = torch.minimum(torch.maximum(x / z, -(cx / fx + margin_x)), (width - cx) / fx + margin_x)
    slope_y = torch.minimum(torch.maximum(y / z, -(cy / fy + margin_y)), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(x)
    jacobian = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], -1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    return means2d, jacobian.unflatten(-1, (2, 3))


def _ortho(p: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    x, y, _ = p.unbind(-1)
    fx, fy, cx, cy = (Ks[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    zero = torch.zeros_like(x)
    jacobian = torch.stack([fx.expand_as(x), zero, zero, zero, fy.expand_as(x), zero], -1)
    return torch.stack([fx * x + cx, fy * y + cy], -1), jacobian.unflatten(-1, (2, 3))


def _fisheye(p: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Project with the equidistant fisheye model, in which the image radius is f θ.

    With s = θ/r and q = (dθ/dr - s)/r², du/dx = fx (s + q x²). Results have the shapes of `_pinhole`.
    """
    x, y, z = p.unbind(-1)
    fx, fy, cx, cy = (Ks[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    near_axis = (x * x + y * y < (FISHEYE_SERIES_BELOW * z) ** 2) & (z > 0)
    r2 = torch.where(near_axis, torch.ones_like(x), x * x + y * y)
    r = r2.sqrt()
    squared = r2 + z * z
    s_far = torch.atan2(r, z) / r
    q_far = (z / squared - s_far) / r2
    z_near = torch.where(near_axis, z, torch.ones_like(z))
    t2 = torch.where(near_axis, (x * x + y * y) / (z_near * z_near), torch.zeros_like(x))
    s_near = (1 - t2 / 3 + t2**2 / 5 - t2**3 / 7) / z_near
    q_near = (-2 / 3 + 4 / 5 * t2 - 6 / 7 * t2**2 + 8 / 9 * t2**3) / z_near**3
    s, q = torch.where(near_axis, s_near, s_far), torch.where(near_axis, q_near, q_far)
    inverse = 1 / (x * x + y * y + z * z)
    jacobian = torch.stack(
        [
            fx * (s + q * x * x),
            fx * q * x * y,
            -fx * x * inverse,
            fy * q * x * y,
            fy * (s + q * y * y),
            -fy * y * inverse,
        ],
        -1,
    )
    return torch.stack([fx * x * s + cx, fy * y * s + cy], -1), jacobian.unflatten(-1, (2, 3))


PROJECTIONS = {"pinhole": _pinhole, "ortho": _ortho, "fisheye": _fisheye}
"""Image points and Jacobians of each camera model."""


def proj(
    means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int, camera_model: str = "pinhole"
) -> tuple[Tensor, Tensor]:
    """Project Gaussians in camera axes to the picture by EWA splatting (Zwicker et al. 2001), without blur and culling.

    Args:
        means: centres [..., C, N, 3].
        covars: covariances [..., C, N, 3, 3].
        Ks: intrinsic matrices [..., C, 3, 3].
        width: width of the picture in pixels. Only pinhole cameras use the size, for the limit of the linearisation.
        height: height of the picture in pixels.
        camera_model: "pinhole", "ortho" or "fisheye".

    Returns:
        Centres [..., C, N, 2] in pixels, and covariances [..., C, N, 2, 2] in pixels².

    Raises:
        InvalidInput: for wrong shapes or an unknown camera model.
    """
    leading = require_trailing("means", means, (3,), "[..., C, N, 3]")
    if len(leading) < 2:
        raise InvalidInput(f"means must be [..., C, N, 3], got {list(means.shape)}")
    require_shape("covars", covars, (*leading, 3, 3), "[..., C, N, 3, 3]")
    require_shape("Ks", Ks, (*leading[:-1], 3, 3), "[..., C, 3, 3]")
    require_same_kind(means=means, covars=covars, Ks=Ks)
    if camera_model not in PROJECTIONS:
        raise InvalidInput(f"proj has no camera model {camera_model!r}; the models are {', '.join(PROJECTIONS)}")
    means2d, jacobian = PROJECTIONS[camera_model](means, Ks, width, height)
    return means2d, jacobian @ covars @ jacobian.mT


def world_to_cam(means: Tensor, covars: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres [..., C, N, 3] and covariances [..., C, N, 3, 3] in the axes of each camera.

    Args:
        means: centres [..., N, 3] in world axes.
        covars: covariances [..., N, 3, 3].
        viewmats: world-to-camera matrices [..., C, 4, 4].

    Raises:
        InvalidInput: for wrong shapes.
    """
    leading = require_trailing("means", means, (3,), "[..., N, 3]")
    require_shape("covars", covars, (*leading, 3, 3), "[..., N, 3, 3]")
    cameras = require_trailing("viewmats", viewmats, (4, 4), "[..., C, 4, 4]")
    if not leading or not cameras or cameras[:-1] != leading[:-1]:
        raise InvalidInput(
            f"viewmats must be [..., C, 4, 4] with ... = {list(leading[:-1])}, got {list(viewmats.shape)}"
        )
    require_same_kind(means=means, covars=covars, viewmats=viewmats)
    rotation = viewmats[..., None, :3, :3]
    turned = (rotation @ means[..., None, :, :, None])[..., 0] + viewmats[..., None, :3, 3]
    return turned, rotation @ covars[..., None, :, :, :] @ rotation.mT
