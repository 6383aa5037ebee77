"""Updates that strategies make in every training step, in place: statistics of gradients, and noise on positions."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.ops.arguments import require_float32, require_shape


def accumulate_gradient_norms_(
    gradients: Tensor,
    radii: Tensor,
    scale: tuple[float, float],
    extent_scale: float,
    sums: Tensor,
    counts: Tensor,
    largest: Tensor | None = None,
) -> None:
    """Add the lengths of screen gradients to the statistics of adaptive density control (Kerbl et al. 2023, section 5.2).

    Images are added in their order. A Gaussian is visible in an image if both of its radii are above 0.

    Args:
        gradients: gradients [C, N, 2] of the loss by the projected centres, float32.
        radii: radii [C, N, 2] in pixels, int32.
        scale: factors of the gradients along x and y.
        extent_scale: factor of the radii.
        sums: float32 [N], incremented by the sum of the lengths of the scaled gradients over the images that show a Gaussian.
        counts: float32 [N], incremented by the number of these images.
        largest: float32 [N], raised to the largest scaled radius in these images.

    Raises:
        InvalidInput: for wrong shapes or dtypes; `gsplat_core.reference.accumulate_gradient_norms_` accepts float64.
    """
    if gradients.ndim != 3 or gradients.shape[2] != 2:
        raise InvalidInput(f"gradients must be [C, N, 2], got {list(gradients.shape)}")
    require_shape("radii", radii, tuple(gradients.shape), "[C, N, 2]")
    if radii.dtype != torch.int32:
        raise InvalidInput(f"radii must be int32, got {radii.dtype}")
    given = {"sums": sums, "counts": counts} | ({} if largest is None else {"largest": largest})
    for name, tensor in given.items():
        require_shape(name, tensor, (gradients.shape[1],), "[N]")
    require_float32("accumulate_gradient_norms_", gradients=gradients, **given)
    torch.ops.gsplat_core.accumulate_gradient_norms_(gradients, radii, *scale, extent_scale, sums, counts, largest)


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
    """Move each Gaussian by Σ ε times `scale`, less for visible ones (Kheradmand et al. 2024, equation 10).

    Σ is its covariance and ε its noise. The factor sigmoid(-k (o - t)) spares Gaussians with an opacity o above t. A
    Gaussian whose new position would not be finite, or whose quaternion has the length zero, stays where it is.

    Args:
        means: positions [N, 3], float32 and contiguous.
        quats: rotations [N, 4] wxyz, of any other length.
        log_scales: logarithms of the standard deviations [N, 3].
        logits: logits of the opacities [N].
        noise: ε [N, 3].
        scale: factor of all displacements.
        opacity_at_half: the opacity t.
        steepness: k.

    Raises:
        InvalidInput: for wrong shapes or dtypes; `gsplat_core.reference.diffuse_positions_` accepts float64.
    """
    count = len(means)
    for name, tensor, shape in (
        ("means", means, (count, 3)), ("quats", quats, (count, 4)), ("log_scales", log_scales, (count, 3)),
        ("logits", logits, (count,)), ("noise", noise, (count, 3)),
    ):  # fmt: skip
        require_shape(name, tensor, shape, f"[N, {shape[1]}]" if len(shape) > 1 else "[N]")
    require_float32("diffuse_positions_", means=means, quats=quats, log_scales=log_scales, logits=logits, noise=noise)
    if not means.is_contiguous():
        raise InvalidInput(f"means must be contiguous, got strides {list(means.stride())}; call contiguous()")
    torch.ops.gsplat_core.diffuse_positions_(means, quats, log_scales, logits, noise, scale, opacity_at_half, steepness)


@torch.library.register_fake("gsplat_core::accumulate_gradient_norms_")
def _accumulate_fake(*arguments: object) -> None: ...


@torch.library.register_fake("gsplat_core::diffuse_positions_")
def _diffuse_fake(*arguments: object) -> None: ...
