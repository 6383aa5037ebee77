"""Refinement of a camera pose by the photometric error of rendered Gaussians, with the renderer's
gradient by `viewmats`.

Each round renders once forward and backward, so the gradient is exact. The first Hessian is
Gauss-Newton's for pixels that move according to their depth (Baker and Matthews, "Lucas-Kanade 20
Years On", 2004). BFGS updates it after each step (Nocedal and Wright, 2006, section 6.1). The
update is needed because rotation and sideways translation look nearly alike in front of a flat
surface. A step is accepted only if the error falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.poses.se3 import exp
from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.threads import one_thread

SOFT = 0.05
"""Scale of the Charbonnier loss as a share of full brightness; residuals are squared well below it
and linear well above.
"""
COVERED = 0.5
"""Opacity from which a pixel shows the scene."""
LEAST_PIXELS = 64
DONE = 1e-5
"""Relative decrease of the error by a step below which the refinement ends."""


@dataclass(frozen=True)
class RefinedPose:
    """Camera refined to fit a picture."""

    camera: Camera
    before: float
    """Mean photometric error at the start pose, 0 to about 1."""
    after: float
    """Mean photometric error at the refined pose; never larger than `before`."""
    rounds: int


def refine_pose(
    gaussians: Gaussians,
    camera: Camera,
    image: NDArray[np.uint8],
    mask: NDArray[np.uint8] | None = None,
    *,
    rounds: int = 20,
) -> RefinedPose:
    """Refine a camera pose until the rendered Gaussians match a picture. The start must be within a
    few pixels of the solution.

    Args:
        gaussians: scene to render.
        camera: camera with the start pose.
        image: RGB uint8 [H, W, 3], of the camera's size.
        mask: [H, W], 0 = ignored; None to use all pixels.
        rounds: maximum number of steps tried.

    Raises:
        InvalidInput: for a picture or mask of another size, or with fewer than 64 comparable
            pixels.
    """
    size = (camera.height_px, camera.width_px)
    for name, plane in (("image", image), ("mask", mask)):
        if plane is not None and plane.shape[:2] != size:
            raise InvalidInput(f"{name} is {list(plane.shape)}, the camera sees {list(size)}")
    device = gaussians.device
    target = torch.as_tensor(image, device=device).float() / 255
    counted = torch.ones(size, dtype=torch.bool, device=device)
    if mask is not None:
        counted = torch.as_tensor(np.asarray(mask) != 0, device=device)
    viewmat, _ = camera.matrices(device)
    now = _compare(gaussians, camera, viewmat, target, counted)
    hessian = now.hessian
    first, damping, tried = now.error, 1e-3, 0
    for _ in range(rounds):
        tried += 1
        step = torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal() + 1e-12), -now.gradient)
        moved = exp(step.double()).to(viewmat) @ viewmat
        then = _compare(gaussians, camera, moved, target, counted)
        if not then.error < now.error:
            damping *= 10
            if damping > 1e6:
                break
            continue
        hessian = _improved(hessian, step, then.gradient - now.gradient)
        gained, now, viewmat = now.error - then.error, then, moved
        damping = max(damping / 5, 1e-6)
        if gained < DONE * now.error:
            break
    pose = viewmat.cpu().double().numpy()
    return RefinedPose(camera.with_pose(_rigid(pose)), first, now.error, tried)


@dataclass(frozen=True)
class _Comparison:
    error: float
    gradient: Tensor
    """Derivatives by a twist of the camera (`pose`), [6]."""
    hessian: Tensor
    """Gauss-Newton Hessian, [6, 6]."""


def _compare(gaussians: Gaussians, camera: Camera, viewmat: Tensor, target: Tensor, counted: Tensor) -> _Comparison:
    """Render a pose and return its photometric error with derivatives."""
    twist = torch.zeros(6, dtype=torch.float32, device=viewmat.device, requires_grad=True)
    intrinsics = camera.matrices(viewmat.device)[1]
    scene = {name: getattr(gaussians, name).detach() for name in ("means", "quats", "scales", "opacities")}
    with torch.enable_grad():
        colors, alphas, _ = rasterization(
            **scene, colors=gaussians.sh.detach(), viewmats=(exp(twist) @ viewmat)[None], Ks=intrinsics[None],
            width=camera.width_px, height=camera.height_px, sh_degree=gaussians.sh_degree, render_mode="RGB+ED",
            camera_model=camera.model,
        )  # fmt: skip
        picture, alpha = colors[0, ..., :3], alphas[0, ..., 0].detach()
        compared = counted & (alpha >= COVERED)
        pixels = int(compared.sum())
        if pixels < LEAST_PIXELS:
            raise InvalidInput(
                f"only {pixels} pixels of the picture can be compared with the scene; {LEAST_PIXELS} are needed"
            )
        residual = (picture - target)[compared]
        size = (residual.square() + SOFT**2).sqrt()
        with one_thread():
            error = (size - SOFT).mean()
        (gradient,) = torch.autograd.grad(error, twist)
    weight = 1 / (size.detach() * size.numel())
    by_twist = _by_twist(picture.detach(), colors[0, ..., 3].detach(), intrinsics)[compared]
    with one_thread():
        hessian = torch.einsum("nci,nc,ncj->ij", by_twist, weight, by_twist)
    return _Comparison(float(error.detach()), gradient, hessian)


def _improved(hessian: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """Return the Hessian after a BFGS update, or unchanged if it would not stay positive definite."""
    along = hessian @ step
    curvature = step @ change
    if not curvature > 1e-6 * step.norm() * change.norm():
        return hessian
    return hessian + torch.outer(change, change) / curvature - torch.outer(along, along) / (step @ along)


def _by_twist(picture: Tensor, depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Return the Jacobian [H, W, 3, 6] of each pixel's colour by a twist of the camera, assuming
    constant surface colour.
    """
    down, right = torch.gradient(picture, dim=(0, 1))
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    x = ((torch.arange(width, device=depth.device) + 0.5 - cx) / fx).expand(height, width)
    y = ((torch.arange(height, device=depth.device) + 0.5 - cy) / fy)[:, None].expand(height, width)
    near = 1 / depth.clamp(min=1e-6)
    zero = torch.zeros_like(x)
    # Pixel motion by a twist (t, w): Chaumette and Hutchinson, "Visual Servo Control", 2006,
    # equation 11.
    along_x = fx * torch.stack([near, zero, -x * near, -x * y, 1 + x * x, -y], -1)
    along_y = fy * torch.stack([zero, near, -y * near, -1 - y * y, x * y, x], -1)
    return -(right[..., None] * along_x[:, :, None] + down[..., None] * along_y[:, :, None])


def _rigid(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormalise the rotation, which products in float32 distort slightly."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = left @ right, pose[:3, 3]
    return exact
