"""Initialisation, losses and schedule of gsplat's trainer of surgical scenes, under gsplat's names.

gsplat has them in `init_utils`, `losses`, `regularizers` and `training`. They follow G-SHARP. Masks are 1 where a pixel counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.ops.ssim import fused_ssim

LEAST_VARIANCE = 1e-12
"""Minimum product of both sums of squares in the correlation of depths."""
COUNT_EPSILON = 1e-8


def multi_frame_depth_unprojection(
    images: Tensor,
    depths: Tensor,
    masks: Tensor,
    poses: Tensor,
    intrinsics: Tensor,
    max_points: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the points in the world of all pixels with depth, and their colours.

    Pixel (column i, row j) has the coordinates (i, j), as in gsplat, not those of its centre.

    Args:
        images: RGB [N, H, W, 3], uint8, or float in 0..1.
        depths: z [N, H, W], 0 for unknown.
        masks: [N, H, W], 0 for pixels to leave out.
        poses: camera to world [N, 4, 4].
        intrinsics: [N, 3, 3].
        max_points: number of points to choose at random from more; None for all.

    Returns:
        Positions [P, 3] and colours [P, 3] in 0..1.

    Raises:
        ValueError: if the numbers of frames differ.
    """
    counts = {"depths": len(depths), "masks": len(masks), "poses": len(poses), "intrinsics": len(intrinsics)}
    wrong = {name: count for name, count in counts.items() if count != len(images)}
    if wrong:
        raise InvalidInput(f"leading dim mismatch: images has {len(images)} frames, got {wrong}")
    depths = depths.float()
    frame, row, column = ((masks != 0) & (depths > 0)).nonzero(as_tuple=True)
    z, K = depths[frame, row, column], intrinsics.float()[frame]
    x = (column - K[:, 0, 2]) * z / K[:, 0, 0]
    y = (row - K[:, 1, 2]) * z / K[:, 1, 1]
    pose = poses.float()[frame]
    points = (pose[:, :3, :3] @ torch.stack([x, y, z], -1)[..., None])[..., 0] + pose[:, :3, 3]
    colours = images[frame, row, column].float() / (255 if images.dtype == torch.uint8 else 1)
    if max_points is not None and len(points) > max_points:
        chosen = torch.randperm(len(points), device=points.device)[:max_points]
        return points[chosen], colours[chosen]
    return points, colours


def knn_scale_init(xyz: Tensor, k: int = 3, eps: float = 1e-7, chunk_size: int = 1024) -> Tensor:
    """Return the logarithm of the root mean squared distance of each point to its nearest others, [N].

    Args:
        xyz: points [N, 3].
        k: number of neighbours.
        eps: minimum distance.
        chunk_size: not used; neighbours are found by a tree.

    Raises:
        ValueError: if there are not more than `k` points.
    """
    if len(xyz) <= k:
        raise InvalidInput(f"knn_scale_init needs at least k+1={k + 1} points, got {len(xyz)}")
    distances = xyz[nearest_others(xyz, k)] - xyz[:, None]
    return distances.square().sum(-1).mean(-1).sqrt().clamp_min(eps).log()


def masked_l1(pred: Tensor, gt: Tensor, mask: Tensor) -> Tensor:
    """Return the mean absolute difference where `mask`, broadcast to the images, is not 0; 0 if it is 0 everywhere.

    Raises:
        ValueError: if both shapes differ.
    """
    _require_same("masked_l1", pred, gt)
    chosen = (pred - gt).abs()[(mask != 0).expand_as(pred)]
    return chosen.mean() if chosen.numel() else 0 * pred.sum()


def masked_ssim(pred: Tensor, gt: Tensor, mask: Tensor) -> Tensor:
    """Return 1 - SSIM of images [B, C, H, W] multiplied by `mask`. The mean is over all pixels.

    Raises:
        ValueError: if both shapes differ.
    """
    _require_same("masked_ssim", pred, gt)
    return 1 - fused_ssim(pred * mask, gt * mask)


def binocular_disparity_l1(
    pred_depth: Tensor, gt_depth: Tensor, mask: Tensor | None = None, eps: float = 1e-7
) -> Tensor:
    """Return the mean absolute difference of inverse depths where both magnitudes exceed `eps` and `mask` is not 0.

    Raises:
        ValueError: if both shapes differ.
    """
    _require_same("binocular_disparity_l1", pred_depth, gt_depth)
    known = (pred_depth.abs() > eps) & (gt_depth.abs() > eps)
    own, other = (torch.where(known, depth, 1).reciprocal() for depth in (pred_depth, gt_depth))
    return masked_l1(own, other, known if mask is None else known & (mask != 0))


def pearson_depth_loss(pred_depth: Tensor, gt_depth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return 1 minus the correlation of depths where `mask` is not 0; 0 with fewer than two values.

    Raises:
        ValueError: if both shapes differ.
    """
    _require_same("pearson_depth_loss", pred_depth, gt_depth)
    own, other = pred_depth.flatten(), gt_depth.flatten()
    if mask is not None:
        chosen = (mask != 0).expand_as(pred_depth).flatten()
        own, other = own[chosen], other[chosen]
    if own.numel() < 2:
        return 0 * pred_depth.sum()
    own, other = own - own.mean(), other - other.mean()
    variance = (own.square().sum() * other.square().sum()).clamp_min(LEAST_VARIANCE)
    return 1 - (own * other).sum() / variance.sqrt()


def compute_tv_loss_targeted(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the anisotropic total variation of images [B, C, H, W].

    Args:
        image: the images.
        mask: [B, 1, H, W] of 0 and 1: pixels whose differences to the previous row and column count. None for all; the sum is
            then divided by the number of values.

    Raises:
        ValueError: if the images are not 4D.
    """
    if image.dim() != 4:
        raise InvalidInput(f"expected a 4D image [B, C, H, W], got {list(image.shape)}")
    down, across = image.diff(dim=-2).abs(), image.diff(dim=-1).abs()
    if mask is None:
        return (down.sum() + across.sum()) / image.numel()
    both = ((down, mask[..., 1:, :]), (across, mask[..., 1:]))
    terms = [(values * m).sum() / (m.sum() * image.shape[1] + COUNT_EPSILON) for values, m in both]
    return terms[0] + terms[1]


def _require_same(name: str, own: Tensor, other: Tensor) -> None:
    if own.shape != other.shape:
        raise InvalidInput(f"{name}: shapes must match, got {list(own.shape)} and {list(other.shape)}")


@dataclass
class TwoStageScheduleStep:
    """Stage and frame of a training step."""

    stage: Literal["coarse", "fine"]
    frame_index: int
    shuffle: bool
    """True in the fine stage, in which a data loader may choose frames at random instead of in turn."""


class TwoStageScheduler:
    """Schedule of two stages: one frame first, then all frames in turn."""

    def __init__(self, coarse_steps: int, fine_steps: int, coarse_frame_index: int = 0) -> None:
        """Store the numbers of coarse and fine steps and the frame of the coarse steps.

        Args:
            coarse_steps: number of steps of the first stage.
            fine_steps: intended number of steps of the second stage, which has no end.
            coarse_frame_index: frame of the first stage.

        Raises:
            ValueError: if a number is negative.
        """
        for name, value in (("coarse_steps", coarse_steps), ("fine_steps", fine_steps)):
            if value < 0:
                raise InvalidInput(f"{name} must be non-negative, got {value}")
        self.coarse_steps, self.fine_steps, self.coarse_frame_index = coarse_steps, fine_steps, coarse_frame_index

    def step(self, global_step: int, num_frames: int) -> TwoStageScheduleStep:
        """Return stage and frame of step `global_step`, counted from 0, of a training on `num_frames` frames.

        Raises:
            ValueError: if a number is out of range.
        """
        if global_step < 0 or num_frames <= 0:
            raise InvalidInput(
                f"global_step must be non-negative and num_frames positive, got {global_step} and {num_frames}"
            )
        if not 0 <= self.coarse_frame_index < num_frames:
            raise InvalidInput(f"coarse_frame_index is {self.coarse_frame_index}, out of the {num_frames} frames")
        if global_step < self.coarse_steps:
            return TwoStageScheduleStep("coarse", self.coarse_frame_index, False)
        return TwoStageScheduleStep("fine", (global_step - self.coarse_steps) % num_frames, True)
