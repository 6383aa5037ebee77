"""The loss of one rendered frame and its gradient at the Gaussians, straight through the ops."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.ops.image_loss.image_loss import image_loss
from gsplat_core.rendering.settings import EPS2D, FAR_PLANE, NEAR_PLANE, TILE_SIZE
from gsplat_core.scene.cameras import CAMERA_MODELS
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.observations import Observation


@dataclass(frozen=True)
class LossWeights:
    """(1 - ssim) L1 + ssim (1 - SSIM) + depth * inverse-depth L1, each over tissue pixels."""

    ssim: float = 0.0
    depth: float = 0.0


def loss_and_gradients(
    gaussians: Gaussians, observation: Observation, weights: LossWeights
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss [] against `observation`, and its gradient for each of the Gaussians' five raw tensors, by name.

    The loss stays on the device: whoever wants the number waits for it. The same as `render`, `image_loss` and `backward()`, without building a graph: this is the inner loop of training.
    """
    ops = torch.ops.gsplat_core
    camera = observation.camera
    width, height = camera.width_px, camera.height_px
    model = CAMERA_MODELS.index(camera.model)
    viewmat, intrinsics = (matrix[None, None] for matrix in camera.matrices(gaussians.device))
    means, quats = gaussians.means[None], gaussians.quats[None]
    scales, opacities = gaussians.scales, gaussians.opacities
    use_depth = weights.depth > 0 and observation.depth is not None

    means2d, depths, conics, _, radii = ops.project_gaussians(
        means, None, quats, scales[None], opacities[None], viewmat, intrinsics,
        width, height, EPS2D, NEAR_PLANE, FAR_PLANE, 0.0, False, model,
    )  # fmt: skip
    radii, means2d, depths, conics = radii[0], means2d[0, 0], depths[0, 0], conics[0, 0]
    unclamped, directions = _colours(gaussians, camera.position)
    colours = unclamped.clamp(min=0)
    channels = torch.cat([colours, depths[:, None]], 1) if use_depth else colours
    columns, rows = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
    _, flatten_ids, offsets = ops.bin_splats(
        means2d[None], radii, depths[None], conics[None], opacities[None], None, 1, TILE_SIZE, columns, rows
    )
    splats = (means2d, conics, channels, opacities, offsets, flatten_ids, None, None)
    picture, alphas, last = ops.composite(*splats, None, width, height, TILE_SIZE)

    image, alpha = picture[0, ..., :3].contiguous(), alphas[0].reshape(height, width)
    expected = picture[0, ..., 3] / alpha.clamp(min=1e-10) if use_depth else None
    result = image_loss(
        image, observation.image, observation.mask, expected, observation.depth if use_depth else None,
        weights.ssim, weights.depth,
    )  # fmt: skip
    v_picture, v_alphas = result.grad_image, torch.zeros_like(alphas)
    if expected is not None:
        v_depth = result.grad_depth / alpha.clamp(min=1e-10)
        v_picture = torch.cat([v_picture, v_depth[..., None]], -1)
        v_alphas = (-expected * v_depth).reshape(alphas.shape)
    v_means2d, v_conics, v_channels, v_opacities, _, _ = ops.composite_backward(
        *splats, width, height, TILE_SIZE, alphas, last, v_picture.reshape(picture.shape), v_alphas, False
    )
    v_depths = v_channels[:, 3].contiguous()[None, None] if use_depth else None
    v_means, _, v_quats, v_scales, _ = ops.project_gaussians_backward(
        means, None, quats, scales[None], viewmat, intrinsics, radii[None], v_means2d[None, None], v_depths,
        v_conics[None, None], None, width, height, EPS2D, model, False,
    )  # fmt: skip
    v_colours = v_channels[:, :3] * (unclamped > 0)
    v_means, v_sh = v_means[0], v_colours[:, None] * SH_C0
    if directions is not None:
        v_directions, v_sh = ops.spherical_harmonics_backward(
            gaussians.sh_degree, directions[None], gaussians.sh, None, v_colours.contiguous()[None], True
        )
        v_means = v_means + v_directions[0]
    return result.loss, {
        "means": v_means,
        "quats": v_quats[0],
        "log_scales": v_scales[0] * scales,
        "logit_opacities": v_opacities * opacities * (1 - opacities),
        "sh": v_sh,
    }


def _colours(gaussians: Gaussians, position: object) -> tuple[Tensor, Tensor | None]:
    """Colours [N, 3] before they are clamped at 0, and the viewing directions [N, 3] that they depend on, if they do."""
    if gaussians.sh_degree == 0:
        return gaussians.sh[:, 0] * SH_C0 + 0.5, None
    centre = torch.as_tensor(position, dtype=torch.float32).to(gaussians.device, non_blocking=True)
    directions = gaussians.means - centre
    colours = torch.ops.gsplat_core.spherical_harmonics(gaussians.sh_degree, directions[None], gaussians.sh, None)[0]
    return colours + 0.5, directions
