"""Ops of training in plain torch, for any floating dtype: losses of pictures, Adam, the statistics of strategies, and
penalties of feature planes.

The penalties are the test reference of `hexplane_planes_adam_` (K-Planes, Fridovich-Keil et al. 2023, section 3.4). Planes
are [V, U, C]. A plane too small for a difference along an axis has a penalty of 0 there, with zero gradient.

The image loss and its terms are differentiable by autograd. A term without any pixel (no tissue, no valid depth) is 0 with
zero gradient, never NaN. Structural similarity (Wang et al. 2004): 11x11 Gaussian window of sigma 1.5, zero padding,
C1 = 0.01^2, C2 = 0.03^2, values in 0..1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import ImageLoss
from gsplat_core.reference.projection import quat_scale_to_covar_preci


@torch.no_grad()
def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    row_size: int = 1,
) -> int:
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1); see `gsplat_core.ops.adam.adam_step`."""
    beta1, beta2 = betas
    usable = gradient.square().isfinite().reshape(-1, row_size).all(dim=1, keepdim=True)
    keep = usable.expand(-1, row_size).reshape(gradient.shape)
    first = first_moment + (1 - beta1) * (gradient - first_moment)
    second = second_moment + (1 - beta2) * (gradient * gradient - second_moment)
    denominator = second.sqrt() / math.sqrt(1 - beta2**step) + epsilon
    moved = parameter - learning_rate / (1 - beta1**step) * first / denominator
    for tensor, updated in ((first_moment, first), (second_moment, second), (parameter, moved)):
        tensor.copy_(torch.where(keep, updated, tensor))
    return int((~usable).sum())


@torch.no_grad()
def accumulate_gradient_norms_(
    gradients: Tensor,
    radii: Tensor,
    scale: tuple[float, float],
    extent_scale: float,
    sums: Tensor,
    counts: Tensor,
    largest: Tensor | None = None,
) -> None:
    """Add each visible Gaussian's screen gradient length to `sums` and its views to `counts` (Kerbl et al. 2023, section
    5.2), and update its `largest` extent.
    """
    visible = (radii > 0).all(-1)
    lengths = (gradients * gradients.new_tensor(scale)).norm(dim=-1)
    sums += torch.where(visible, lengths, 0).sum(0)
    counts += visible.sum(0)
    if largest is not None and len(radii):
        extents = torch.where(visible, radii.amax(-1), 0).amax(0).to(largest.dtype) * extent_scale
        largest.copy_(torch.maximum(largest, extents))


@torch.no_grad()
def diffuse_positions_(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    noise: Tensor,
    scale: float,
    opacity_at_half: float,
    steepness: float,
) -> None:
    """Move each Gaussian by its covariance times noise (Kheradmand et al. 2024, equation 10)."""
    share = torch.sigmoid(-steepness * (logits.sigmoid() - opacity_at_half))
    covars, _ = quat_scale_to_covar_preci(quats, log_scales.exp(), compute_preci=False)
    moved = means + torch.einsum("nij,nj->ni", covars, noise * (scale * share)[:, None])
    valid = (moved.isfinite().all(-1) & (quats.norm(dim=-1) > 0))[:, None]
    means.copy_(torch.where(valid, moved, means))


def total_variation(plane: Tensor) -> Tensor:
    """Return the mean squared difference of neighbours along both axes (eq. 5)."""
    return _mean_or_zero(plane.diff(dim=0).square()) + _mean_or_zero(plane.diff(dim=1).square())


def second_difference_in_time(plane: Tensor) -> Tensor:
    """Return the mean squared second difference along V, the time axis of a time plane (eq. 6)."""
    return _mean_or_zero(plane.diff(n=2, dim=0).square())


def distance_from_one(plane: Tensor) -> Tensor:
    """Return the mean of |1 - plane|; a time plane of ones has no effect on its features (eq. 7)."""
    return (1 - plane).abs().mean()


def mean_over_planes(penalty: Callable[[Tensor], Tensor], planes: Sequence[Tensor]) -> Tensor:
    """Return the mean of a penalty over several planes."""
    return torch.stack([penalty(plane) for plane in planes]).mean()


def _mean_or_zero(values: Tensor) -> Tensor:
    return values.mean() if values.numel() else values.sum()


WINDOW_RADIUS_PX = 5
WINDOW_SIGMA_PX = 1.5
C1 = 0.01**2
C2 = 0.03**2


def gaussian_window() -> Tensor:
    """Return the 11 taps of SSIM's separable Gaussian window, float64, with sum 1."""
    offsets = torch.arange(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1, dtype=torch.float64)
    taps = torch.exp(-0.5 * (offsets / WINDOW_SIGMA_PX) ** 2)
    return taps / taps.sum()


def _blur(planes: Tensor) -> Tensor:
    """Filter planes [P, H, W] with the Gaussian window of SSIM and zero padding."""
    height, width = planes.shape[1:]
    taps = gaussian_window().tolist()
    padded = torch.nn.functional.pad(planes, (WINDOW_RADIUS_PX,) * 4)
    rows = sum(
        (tap * padded[:, k : k + height] for k, tap in enumerate(taps)), start=torch.zeros_like(padded[:, :height])
    )
    return sum((tap * rows[:, :, k : k + width] for k, tap in enumerate(taps)), start=torch.zeros_like(planes))


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural similarity of each pixel and channel (Wang et al. 2004, equation 13).

    Args:
        image: [H, W, C], values in 0..1.
        target: [H, W, C], same dtype.

    Returns:
        [H, W, C], in -1..1.
    """
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_x, mean_y, square_x, square_y, product = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    variances = square_x + square_y - mean_x * mean_x - mean_y * mean_y
    covariance = product - mean_x * mean_y
    similarity = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    similarity = similarity / ((mean_x * mean_x + mean_y * mean_y + C1) * (variances + C2))
    return similarity.permute(1, 2, 0)


STEEP_AS_L1 = 0.01
"""Colour difference, for values in 0..1, at which the scaled squared error has the same slope as L1."""


def _mean_where(values: Tensor, keep: Tensor) -> Tensor:
    """Return the mean of the kept values, or 0 if none is kept. NaN in other values has no effect."""
    return torch.where(keep, values, torch.zeros_like(values)).sum() / keep.sum().clamp(min=1)


def _tissue(mask: Tensor | None, like: Tensor) -> Tensor:
    """Broadcast the mask to booleans [H, W, C], all True for None. Raises InvalidInput for another size."""
    if mask is None:
        return torch.ones_like(like, dtype=torch.bool)
    if mask.shape != like.shape[:2]:
        raise InvalidInput(f"mask must be [H, W] = {list(like.shape[:2])}, got {list(mask.shape)}")
    return (mask != 0)[..., None].expand_as(like)


def _same_shape(a: Tensor, b: Tensor, names: str) -> None:
    if a.shape != b.shape:
        raise InvalidInput(f"{names} must have one shape, got {list(a.shape)} and {list(b.shape)}")


def masked_l1(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute error over tissue pixels and channels.

    Args:
        image: [H, W, C].
        target: [H, W, C].
        mask: [H, W], non-zero = tissue; None = all.

    Returns:
        Scalar loss.
    """
    _same_shape(image, target, "image and target")
    keep = _tissue(mask, image)
    # Mask both images before the difference, because abs would pass a masked NaN to the gradient.
    zero = torch.zeros_like(image)
    return _mean_where((torch.where(keep, image, zero) - torch.where(keep, target, zero)).abs(), keep)


def masked_squared_error(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of d² / (2 STEEP_AS_L1) over tissue pixels; arguments as in `masked_l1`."""
    _same_shape(image, target, "image and target")
    keep = _tissue(mask, image)
    zero = torch.zeros_like(image)
    difference = torch.where(keep, image, zero) - torch.where(keep, target, zero)
    return _mean_where(difference.square() / (2 * STEEP_AS_L1), keep)


def masked_ssim_loss(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return 1 - mean SSIM (Wang et al. 2004) of the masked images over tissue pixels.

    Arguments are those of `masked_l1`.
    """
    _same_shape(image, target, "image and target")
    keep = _tissue(mask, image)
    zero = torch.zeros_like(image)
    return _mean_where(1 - ssim_map(torch.where(keep, image, zero), torch.where(keep, target, zero)), keep)


def valid_depth(depth: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mask [H, W] of tissue pixels where both depths are known (> 0)."""
    _same_shape(depth, target, "depth and target depth")
    valid = (depth > 0) & (target > 0)
    if mask is not None:
        _same_shape(depth, mask, "depth and mask")
        valid = valid & (mask != 0)
    return valid


def inverse_depth_l1(depth: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of |1/depth - 1/target| over tissue pixels where both are known (> 0).

    An error in inverse depth is proportional to an error in stereo disparity.

    Args:
        depth: [H, W] in mm, 0 = unknown.
        target: [H, W] in mm, 0 = unknown.
        mask: [H, W], non-zero = tissue; None = all.

    Returns:
        Scalar loss.
    """
    valid = valid_depth(depth, target, mask)
    one = torch.ones_like(depth)
    return _mean_where((1 / torch.where(valid, depth, one) - 1 / torch.where(valid, target, one)).abs(), valid)


def image_loss(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    depth: Tensor | None = None,
    target_depth: Tensor | None = None,
    ssim_weight: float = 0.0,
    depth_weight: float = 0.0,
    squared: bool = False,
) -> ImageLoss:
    """Compute the loss of `gsplat_core.ops.image_loss` for any floating dtype."""
    if target.dtype == torch.uint8:
        target = target.to(image.dtype) / 255
    with torch.enable_grad():
        x = image if image.requires_grad else image.detach().requires_grad_()
        z = depth if depth is None or depth.requires_grad else depth.detach().requires_grad_()
        zero = image.new_zeros(())
        colour = (masked_squared_error if squared else masked_l1)(x, target, mask)
        ssim = masked_ssim_loss(x, target, mask) if ssim_weight else zero
        inverse_depth = inverse_depth_l1(z, target_depth, mask) if z is not None and target_depth is not None else zero
        loss = (1 - ssim_weight) * colour + ssim_weight * ssim + depth_weight * inverse_depth
        wanted = [x] if z is None else [x, z]
        gradients = torch.autograd.grad(loss, wanted, retain_graph=True, materialize_grads=True)
    terms = torch.stack([colour, ssim, inverse_depth]).detach()
    differentiable = image.requires_grad or (depth is not None and depth.requires_grad)
    return ImageLoss(
        loss if differentiable else loss.detach(), terms, gradients[0], gradients[1] if z is not None else None
    )


def frame_loss(
    image: Tensor,
    alphas: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    target_depth: Tensor | None = None,
    ssim_weight: float = 0.0,
    depth_weight: float = 0.0,
    squared: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute `gsplat_core.ops.image_loss` for any floating dtype.

    Returns:
        Loss, its terms, dL/dimage and dL/dalphas.
    """
    with torch.enable_grad():
        x, alpha = image.detach().requires_grad_(), alphas.detach().requires_grad_()
        depth = None if target_depth is None else x[..., 3] / alpha.clamp(min=1e-10)
        result = image_loss(x[..., :3], target, mask, depth, target_depth, ssim_weight, depth_weight, squared)
        v_image, v_alphas = torch.autograd.grad(result.loss, [x, alpha], materialize_grads=True)
    return result.loss.detach(), result.terms, v_image, v_alphas
