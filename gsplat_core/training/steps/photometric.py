"""Loss of a rendered frame and its gradient at the Gaussians, for alpha blending computed directly by ops without autograd, for
other renderers by autograd.

Both eyes of a stereo scope train the geometry. Each eye's colours are trained by its own pictures only, because
view-dependent differences such as highlights would otherwise pull every colour back and forth. Temporal colour changes
are learned from the left eye and apply to both.

Colours can also be corrected with fixed geometry. A picture is linear in the colours of its splats: I_p = sum_k w_kp c_k, with
blending weights w. A live stream corrects colours from the residual of a picture by SIRT (Gilbert 1972), an iteration from
tomography without a learning rate. Each colour moves by the weighted mean of the residual over the pixels that show it. The
weights of a pixel sum to at most 1, so the squared error never grows for a relaxation up to 2. Low-frequency residuals vanish
in the first step, and colours without residual do not move. `colour_change` repeats the iteration to fit a whole picture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.ops.correct_colours import correct_colours
from gsplat_core.ops.frame_gradients import ColourCorrection
from gsplat_core.ops.image_loss import STEEP_AS_L1, image_loss
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.spherical_harmonics import spherical_harmonics
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.pipeline import ColoredSplats, Geometry, RenderedSplats, StepOperations, render_splats
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.settings import EPS2D, RenderSettings
from gsplat_core.scene.cameras import CAMERA_MODELS, Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import Observation

MOST_RELAXATION = 2.0
"""Upper bound of the relaxation of colour corrections, at which the repeated correction need no longer converge."""
LEAST_WEIGHT_PX = 0.3
"""Offset in pixels, added to a splat's sum of blending weights before the splat's summed residual is divided by that sum.
Barely visible splats are thus corrected less.
"""


def colour_correction(colours: Tensor, residuals: Tensor, weights: Tensor, relaxation: float) -> Tensor:
    """Return the correction of `colours` [N, 3], which are displayed clamped at 0.

    Args:
        colours: unclamped colours [N, 3]. Negative ones can rise but do not fall further.
        residuals: [N, 3], sum over tissue pixels of blending weight times (target - picture).
        weights: [N], sum over tissue pixels of blending weight.
        relaxation: share of the mean residual to apply, above 0 and below `MOST_RELAXATION`.

    Returns:
        [N, 3], at most `relaxation` times the largest residual of a pixel, and 0 for splats outside the tissue.
    """
    wanted = relaxation * residuals / (weights + LEAST_WEIGHT_PX)[:, None]
    return torch.maximum(wanted, -colours.clamp(min=0))


class ResidualTarget:
    """Target picture for the residual of a captured step, at fixed addresses."""

    def __init__(self, image: Tensor) -> None:
        """Allocate buffers for pictures of the size and device of `image` [H, W, 3]."""
        shape = (*image.shape[:2], 4)
        self._wanted = torch.zeros(shape, device=image.device)
        self._tissue = torch.zeros(shape, device=image.device)
        """Weights [H, W, 4]: the tissue mask in the three colour channels, 0 in the depth channel."""

    def take(self, image: Tensor, mask: Tensor) -> None:
        """Queue the copy of the next observation: uint8 picture [H, W, 3] and mask [H, W]."""
        tissue = (mask != 0).float()[..., None]
        self._tissue[..., :3].copy_(tissue.expand(-1, -1, 3))
        self._wanted[..., :3].copy_(image.float().div_(255).mul_(tissue))
        self._wanted[..., 3:].copy_(tissue)

    def correction(self, shown: Tensor, relaxation: Tensor) -> ColourCorrection:
        """Return the correction for a picture `shown` [H, W, 4], whose fourth channel is ignored."""
        return ColourCorrection(torch.addcmul(self._wanted, shown, self._tissue, value=-1), relaxation)


def check_colours(relaxation: float, config: ReconstructorConfig, device: torch.device) -> None:
    """Check that colours can be corrected with this relaxation.

    Raises:
        InvalidSetting: for view-dependent colours on a GPU.
    """
    if relaxation == 0:
        return
    if device.type == "cuda" and config.sh_degree > 0:
        raise InvalidSetting(
            f"colour_relaxation is {relaxation} with sh_degree {config.sh_degree}: on a GPU view-dependent colours are"
            " not corrected; set sh_degree or colour_relaxation to 0"
        )


LEAST_WEIGHT = 1e-6
"""Smallest sum of blending weights in pixels; avoids a division by zero for invisible Gaussians."""


def colour_change(gaussians: Gaussians, camera: Camera, picture: Tensor, counts: Tensor, steps: int) -> Tensor:
    """Return the change of the constant colour coefficients [N, 3] that fits a picture.

    The update of `colour_correction` is repeated with Nesterov's momentum. No step size is needed,
    since the weights of a pixel sum to at most 1. A few steps remove large errors; further steps
    only improve detail smaller than a Gaussian.

    Args:
        gaussians: scene.
        camera: viewpoint.
        picture: target float [H, W, 3], 0 to 1.
        counts: weights [H, W], 1 for pixels to fit.
        steps: number of iterations.
    """
    weights = _gathered(gaussians, gaussians.sh[:, 0], camera, torch.ones_like)
    per_weight = 1 / (SH_C0 * weights.clamp(min=LEAST_WEIGHT))
    reached = ahead = gaussians.sh[:, 0].detach()
    for step in range(steps):
        towards = _gathered(gaussians, ahead, camera, lambda image: (picture - image) * counts[..., None])
        before, reached = reached, ahead + towards * per_weight
        ahead = reached + step / (step + 3) * (reached - before)
    return reached - gaussians.sh[:, 0].detach()


def _gathered(gaussians: Gaussians, constant: Tensor, camera: Camera, of_pixels: Callable[[Tensor], Tensor]) -> Tensor:
    """Return pixel values [H, W, 3], computed from the rendered picture, summed for each Gaussian
    [N, 3] with its blending weights.
    """
    leaf = constant.detach().requires_grad_()
    with torch.enable_grad():
        sh = torch.cat([leaf[:, None], gaussians.sh[:, 1:]], dim=1)
        image = render(replace(gaussians, sh=sh), camera, depth=False).image
    (gathered,) = torch.autograd.grad(image, leaf, of_pixels(image.detach()))
    return gathered


LEFT, RIGHT = "sh", "right_sh"
"""Tensor names of the eyes' colours in `Gaussians`. The right eye sees the sum of both."""


def with_eye(gradients: Mapping[str, Tensor], of_right: bool) -> dict[str, Tensor]:
    """Return the gradients of a picture extended to the colours of both eyes, with 0 for the other eye."""
    nothing = torch.zeros_like(gradients[LEFT])
    colours = (nothing, gradients[LEFT]) if of_right else (gradients[LEFT], nothing)
    return {**gradients, **dict(zip((LEFT, RIGHT), colours, strict=True))}


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss (1 - ssim) L1 + ssim (1 - SSIM) + depth * inverse-depth L1, each over tissue pixels."""

    ssim: float = 0.0
    depth: float = 0.0
    squared: bool = False
    """Use the squared error instead of L1, see `image_loss`."""

    @property
    def show_residuals(self) -> bool:
        """True if the loss gradient by a pixel's colour is proportional to its residual (squared error without SSIM)."""
        return self.squared and self.ssim == 0


class ScreenGradients(NamedTuple):
    """Gradients of a loss by the projected centres of the Gaussians, with their radii and the picture's size."""

    means2d: Tensor
    """Gradients [N, 2] of the loss by the Gaussians' projected centres in pixels."""
    radii: Tensor
    """Radii in pixels, int32 [N, 2]; 0 for Gaussians that are not in the picture."""
    width: int
    """Width of the picture in pixels."""
    height: int
    """Height of the picture in pixels."""


class Compared(NamedTuple):
    """Result of comparing a rendered frame with an observation."""

    loss: Tensor
    """Loss, [] on the device; reading it synchronises."""
    gradients: dict[str, Tensor]
    """Gradients of the loss by each of the Gaussians' five raw tensors."""
    colour_change: Tensor | None = None
    """Correction [N, 3] of the colours of degree 0, `sh[:, 0]`, whose gradient is then 0; None without a correction."""
    screen: ScreenGradients | None = None
    """Gradients of the loss by the projected Gaussians; None for renderers other than alpha blending."""


@torch.no_grad()
def loss_and_gradients(
    gaussians: Gaussians,
    observation: Observation,
    weights: LossWeights,
    colour_relaxation: float = 0.0,
    corrections_before: int = 0,
) -> Compared:
    """Compute the loss against an observation and its gradients.

    The result equals `render`, `image_loss` and `backward()` without the cost of an autograd graph.

    Args:
        gaussians: scene at the observation's time.
        observation: target.
        weights: weights of the loss terms.
        colour_relaxation: above 0, the same passes also compute the colour correction (`colour_correction`).
        corrections_before: number of corrections before the comparison, on the CPU. Loss and gradients are then those of
            the corrected colours, and the returned correction includes all.
    """
    camera = observation.camera
    viewmat, intrinsics = (matrix[None] for matrix in camera.matrices(gaussians.device))
    scales, opacities = gaussians.scales, gaussians.opacities
    use_depth = weights.depth > 0 and observation.depth is not None
    settings = RenderSettings(
        width=camera.width_px, height=camera.height_px, sh_degree=gaussians.sh_degree,
        render_mode="RGB+D" if use_depth else "RGB", camera_model=camera.model,
    )  # fmt: skip
    geometry = Geometry(gaussians.means, None, gaussians.quats, scales, opacities, viewmat, intrinsics)
    initial, directions = _colours(gaussians, camera.position)
    unclamped = initial

    def corrected(coloured: ColoredSplats, offsets: Tensor, ids: Tensor) -> Tensor:
        nonlocal unclamped
        rows = coloured.rows
        unclamped = correct_colours(
            rows.means2d[0], rows.conics[0], initial, coloured.opacities[0], offsets[0], ids, observation.image,
            observation.mask, steps=corrections_before, relaxation=colour_relaxation, least_weight=LEAST_WEIGHT_PX,
        )  # fmt: skip
        return torch.cat([unclamped.clamp(min=0)[None], coloured.channels[..., 3:]], -1)

    recolouring = corrected if colour_relaxation > 0 and corrections_before else None
    splats = render_splats(
        _STEPS, geometry, lambda dense: (initial.clamp(min=0)[None], dense), None, settings, recolouring
    )

    loss, v_picture, v_alphas = _loss_of_picture(splats, observation, weights, use_depth)
    tissue = (observation.mask != 0).float() if colour_relaxation > 0 else None
    weighed = None if tissue is None else _to_weigh(splats, observation, weights, tissue)
    v_means2d, v_conics, v_channels, v_opacities = _composite_backward(splats, v_picture, v_alphas, settings, weighed)
    v_depths = v_channels[:, 3].contiguous()[None, None] if use_depth else None
    v_means, _, v_quats, v_scales, _ = torch.ops.gsplat_core.project_gaussians_backward(
        gaussians.means[None], None, gaussians.quats[None], scales[None], viewmat[None], intrinsics[None],
        splats.rows.radii[None], v_means2d[None, None], v_depths, v_conics[None, None], None, settings.width,
        settings.height, EPS2D, CAMERA_MODELS.index(camera.model), False,
    )  # fmt: skip
    v_colours = v_channels[:, :3] * (unclamped > 0)
    v_means, v_sh = v_means[0], v_colours[:, None] * SH_C0
    if directions is not None:
        v_directions, v_sh = torch.ops.gsplat_core.spherical_harmonics_backward(
            gaussians.sh_degree, directions[None], gaussians.sh, None, v_colours.contiguous()[None], True
        )
        v_means = v_means + v_directions[0]
    colour_change = None
    if tissue is not None:
        if weights.show_residuals:
            residuals = v_channels[:, :3] * (-3 * STEEP_AS_L1 * tissue.sum())
        else:
            residuals = v_channels[:, -4:-1].contiguous()
        last = colour_correction(unclamped, residuals, v_channels[:, -1], colour_relaxation)
        colour_change = (unclamped - initial + last) / SH_C0
        v_sh[:, 0] = 0
    gradients = {
        "means": v_means,
        "quats": v_quats[0],
        "log_scales": v_scales[0] * scales,
        "logit_opacities": v_opacities * opacities * (1 - opacities),
        "sh": v_sh,
    }
    screen = ScreenGradients(v_means2d, splats.rows.radii[0], settings.width, settings.height)
    return Compared(loss, gradients, colour_change, screen)


class ComparedByAutograd(NamedTuple):
    """Result of comparing the picture of a differentiable renderer with an observation."""

    loss: Tensor
    """Loss, [] on the device."""
    gradients: dict[str, Tensor]
    """Gradients of the loss by the Gaussians' tensors; tensors without an effect are missing."""
    values: dict[str, Tensor]
    """Gradients of the loss by the renderer's values for the scene; those without an effect are missing."""


def loss_by_autograd(
    gaussians: Gaussians,
    values: Mapping[str, Tensor],
    observation: Observation,
    weights: LossWeights,
    picture: Callable[[Gaussians, Mapping[str, Tensor], bool], RenderOutput],
    losses: Callable[[Gaussians], Tensor | None],
) -> ComparedByAutograd:
    """Compute the loss of a differentiable renderer against an observation and its gradients.

    Args:
        gaussians: scene at the observation's time.
        values: values of the renderer for the scene, leaves of the gradient.
        observation: target.
        weights: weights of the loss terms.
        picture: function that renders a scene with values, with or without depth.
        losses: further losses of the scene; None as its result adds nothing.
    """
    use_depth = weights.depth > 0 and observation.depth is not None
    with torch.enable_grad():
        scene = gaussians.detach().requires_grad_()
        leaves = {name: value.detach().requires_grad_() for name, value in values.items()}
        output = picture(scene, leaves, use_depth)
        loss = image_loss(
            output.image, observation.image, observation.mask, output.depth if use_depth else None,
            observation.depth if use_depth else None, weights.ssim, weights.depth, weights.squared,
        ).loss  # fmt: skip
        further = losses(scene)
        loss = loss if further is None else loss + further
    tensors = {**scene.tensors(), **{f"value {name}": value for name, value in leaves.items()}}
    found = torch.autograd.grad(loss, list(tensors.values()), allow_unused=True)
    gradients = {name: gradient for name, gradient in zip(tensors, found, strict=True) if gradient is not None}
    of_values = {name: gradients.pop(f"value {name}") for name in leaves if f"value {name}" in gradients}
    return ComparedByAutograd(loss.detach(), gradients, of_values)


def with_losses(compared: Compared, gaussians: Gaussians, losses: Callable[[Gaussians], Tensor | None]) -> Compared:
    """Add the value and the gradients of further losses.

    Args:
        compared: result of `loss_and_gradients`. If colours are corrected, their gradient of degree 0 remains 0.
        gaussians: the same scene.
        losses: differentiable function of the scene; None as its result adds nothing.
    """
    with torch.enable_grad():
        scene = gaussians.detach().requires_grad_()
        value = losses(scene)
    if value is None or not value.requires_grad:
        return compared
    tensors = scene.tensors()
    found = torch.autograd.grad(value, list(tensors.values()), allow_unused=True)
    gradients = dict(compared.gradients)
    for name, gradient in zip(tensors, found, strict=True):
        if gradient is not None:
            gradients[name] = gradients[name] + gradient if name in gradients else gradient
    if compared.colour_change is not None:
        gradients["sh"] = gradients["sh"].clone()
        gradients["sh"][:, 0] = 0
    return compared._replace(loss=compared.loss + value.detach(), gradients=gradients)


def _loss_of_picture(
    splats: RenderedSplats, observation: Observation, weights: LossWeights, use_depth: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the loss, and its gradients by the blended channels [1, H, W, D] and alphas [1, H, W, 1]."""
    picture, alphas = splats.image, splats.alphas
    image, alpha = picture[0, ..., :3].contiguous(), alphas[0, ..., 0]
    expected = picture[0, ..., 3] / alpha.clamp(min=1e-10) if use_depth else None
    result = image_loss(
        image, observation.image, observation.mask, expected, observation.depth if use_depth else None,
        weights.ssim, weights.depth, weights.squared,
    )  # fmt: skip
    v_picture, v_alphas = result.grad_image, torch.zeros_like(alphas)
    if expected is not None and result.grad_depth is not None:
        v_depth = result.grad_depth / alpha.clamp(min=1e-10)
        v_picture = torch.cat([v_picture, v_depth[..., None]], -1)
        v_alphas = (-expected * v_depth).reshape(alphas.shape)
    return result.loss, v_picture.reshape(picture.shape), v_alphas


def _to_weigh(splats: RenderedSplats, observation: Observation, weights: LossWeights, tissue: Tensor) -> Tensor:
    """Return the pictures [H, W, D] to sum per splat for `colour_correction`: the tissue mask,
    preceded by the residuals unless the loss gradient contains them.
    """
    if weights.show_residuals:
        return tissue[..., None]
    residuals = (observation.image.float() / 255 - splats.image[0, ..., :3]) * tissue[..., None]
    return torch.cat([residuals, tissue[..., None]], -1)


def _composite(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int, tile_size: int,
    isect_offsets: Tensor, flatten_ids: Tensor, **_: object,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Composite one image. Return colours, alphas and, for the gradient, the last blended splat of every pixel."""
    splats = (means2d[0], conics[0], colors[0], opacities[0])
    return torch.ops.gsplat_core.composite(
        *splats, isect_offsets, flatten_ids, None, None, None, width, height, tile_size
    )


def _composite_backward(
    splats: RenderedSplats, v_picture: Tensor, v_alphas: Tensor, settings: RenderSettings, weighed: Tensor | None
) -> tuple[Tensor, ...]:
    """Return gradients of the splats' means2d [N, 2], conics [N, 3], channels [N, D] and opacities [N].

    With `weighed` [H, W, E], E channels are appended: sums over pixels of blending weight times each of these pictures.
    """
    channels = splats.channels[0]
    if weighed is not None:
        # Appended channels are 0 for every splat, so they do not affect other gradients.
        channels = torch.nn.functional.pad(channels, (0, weighed.shape[-1]))
        v_picture = torch.cat([v_picture, weighed[None]], -1)
    blended = (splats.rows.means2d[0], splats.rows.conics[0], channels, splats.opacities[0])
    lists = (splats.isect_offsets, splats.flatten_ids)
    size = (settings.width, settings.height, settings.tile_size)
    (last,) = splats.rest
    return torch.ops.gsplat_core.composite_backward(
        *blended, *lists, None, None, *size, splats.alphas, last, v_picture, v_alphas, False
    )[:4]


_STEPS = StepOperations(fully_fused_projection, spherical_harmonics, bin_splats, _composite)


def _colours(gaussians: Gaussians, position: object) -> tuple[Tensor, Tensor | None]:
    """Return unclamped colours [N, 3], and the viewing directions [N, 3] if colours depend on them."""
    if gaussians.sh_degree == 0:
        return gaussians.sh[:, 0] * SH_C0 + 0.5, None
    centre = torch.as_tensor(position, dtype=torch.float32).to(gaussians.device, non_blocking=True)
    directions = gaussians.means - centre
    colours = torch.ops.gsplat_core.spherical_harmonics(gaussians.sh_degree, directions[None], gaussians.sh, None)[0]
    return colours + 0.5, directions
