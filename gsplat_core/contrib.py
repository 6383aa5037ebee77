"""Parts of gsplat 1.6's trainers under its names, for training loops of library users: example, surgical and dynamic
trainer.

Example trainer, in gsplat's `losses` and `color_correct`: losses and colour corrections.

Surgical trainer, in `init_utils`, `losses`, `regularizers` and `training`: initialisation, losses and schedule. They
follow G-SHARP. Masks are 1 where a pixel counts.

Dynamic trainer, in `contrib.dynamic`: HexPlane field, network, strategy and regularisers of deforming Gaussians. A
training loop evaluates `HexPlaneField` at positions and time, passes the features to `DeformNetwork`, and renders the
deformed Gaussians. Parameters have gsplat's names and shapes, so its checkpoints load. For new work, the fields of
`gsplat_core.deformation` are faster and normalise time as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import torch
from torch import Tensor

from gsplat_core.deformation.field import ops_for
from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.ops import hexplane as compiled
from gsplat_core.ops import plain_torch
from gsplat_core.ops.ssim import fused_ssim
from gsplat_core.training.strategies.adc import DefaultStrategy
from gsplat_core.training.strategies.strategy import Optimizers, Params

SSIM_WINDOW_PX = 11
"""Side in pixels of the Gaussian window of `ssim_loss`; no other size is supported."""
LEAST_SLOPE = 1e-8
"""Lower bound of a channel's variance in the colour fit; a fitted slope of smaller magnitude is replaced by 1."""


def l1_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return the absolute difference of each value, in the shape of `pred`."""
    return torch.nn.functional.l1_loss(pred, target, reduction="none")


def mse_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return the squared difference of each value, in the shape of `pred`."""
    return torch.nn.functional.mse_loss(pred, target, reduction="none")


def ssim_loss(img1: Tensor, img2: Tensor, window_size: int = SSIM_WINDOW_PX) -> Tensor:
    """Return 1 minus the mean structural similarity of pictures [B, C, H, W] from 0 to 1.

    The mean is over all pixels on the CPU, and over those with a whole window on CUDA, as in gsplat.

    Args:
        img1: pictures.
        img2: pictures to compare with, without a gradient.
        window_size: side of the window in pixels, 11.

    Raises:
        InvalidInput: for other shapes or another window.
    """
    if window_size != SSIM_WINDOW_PX:
        raise InvalidInput(f"window_size must be {SSIM_WINDOW_PX} pixels, got {window_size!r}")
    return 1 - fused_ssim(img1, img2, padding="valid" if img1.is_cuda else "same")


def depth_l1_loss(pred_depth: Tensor, gt_depth: Tensor, scene_scale: float = 1.0) -> Tensor:
    """Return the mean absolute difference of inverse depths times `scene_scale`; depths of 0 and below have the inverse 0."""
    own, other = (
        torch.where(depth > 0, torch.where(depth > 0, depth, 1).reciprocal(), 0) for depth in (pred_depth, gt_depth)
    )
    return (own - other).abs().mean() * scene_scale


def opacity_reg_loss(opacities: Tensor) -> Tensor:
    """Return the mean of the opacities, which are given as logits."""
    return opacities.sigmoid().mean()


def scale_reg_loss(scales: Tensor) -> Tensor:
    """Return the mean of the standard deviations, which are given as logarithms (`scales`)."""
    return scales.exp().mean()


def total_variation_loss(x: Tensor) -> Tensor:
    """Return the sum, over the dimensions from the third on, of the mean squared difference of neighbours.

    Args:
        x: values [B, C, ...], for example bilateral grids [B, 12, L, H, W].
    """
    terms = [x.diff(dim=i).square().mean() for i in range(2, x.dim()) if x.shape[i] > 1]
    return torch.stack(terms).sum() if terms else 0 * x.sum()


def color_correct_affine(img: Tensor, ref: Tensor) -> Tensor:
    """Return the pictures `img` with their colours adapted to those of `ref`, by an affine map of each channel.

    Each channel of `img` is fitted by a scaled and shifted channel of `ref` (least squares); the map is then inverted.

    Args:
        img: pictures [..., C] from 0 to 1.
        ref: pictures of the same shape.

    Raises:
        InvalidInput: if the shapes differ.
    """
    _require_same("color_correct_affine", img, ref)
    own, other = img.reshape(-1, img.shape[-1]), ref.reshape(-1, ref.shape[-1])
    apart = other - other.mean(0)
    slope = (apart * own).mean(0) / apart.square().mean(0).clamp(min=LEAST_SLOPE)
    shift = own.mean(0) - slope * other.mean(0)
    slope = torch.where(slope.abs() < LEAST_SLOPE, 1, slope)
    return ((own - shift) / slope).clamp(0, 1).reshape(img.shape)


def color_correct_quadratic(img: Tensor, ref: Tensor, num_iters: int = 5, eps: float = 0.5 / 255) -> Tensor:
    """Return the pictures `img` with their colours adapted to those of `ref`, by repeated quadratic maps of all channels.

    Each round fits the channels of `ref` by the quadratic polynomials of the current colours that fit best (least squares).
    Pixels that are saturated in `img`, in `ref` or in the current colours do not count.

    Args:
        img: pictures [..., C] from 0 to 1.
        ref: pictures of the same shape.
        num_iters: number of rounds.
        eps: colours closer to 0 or 1 are saturated.

    Raises:
        InvalidInput: if the shapes differ.
    """
    _require_same("color_correct_quadratic", img, ref)
    channels = img.shape[-1]
    current, other = img.reshape(-1, channels).double(), ref.reshape(-1, channels).double()
    unsaturated = lambda values: (values >= eps) & (values <= 1 - eps)
    first, second = torch.triu_indices(channels, channels, device=img.device)
    counts = unsaturated(current) & unsaturated(other)
    for _ in range(num_iters):
        terms = torch.cat([current[:, first] * current[:, second], current, torch.ones_like(current[:, :1])], 1)
        counted = (counts & unsaturated(current)).double()
        # Solve the normal equations of each channel by the pseudo-inverse, because those of pictures with few colours are singular.
        squares = torch.stack([terms.mT @ (terms * weights[:, None]) for weights in counted.unbind(1)])
        found = (
            torch.linalg.pinv(squares, hermitian=True) @ torch.einsum("pc,pi->ci", counted * other, terms)[..., None]
        )
        current = (terms @ found[..., 0].mT).clamp(0, 1)
    return current.to(img.dtype).reshape(img.shape)


def _require_same(name: str, own: Tensor, other: Tensor) -> None:
    if own.shape != other.shape:
        raise InvalidInput(f"{name}: shapes must match, got {list(own.shape)} and {list(other.shape)}")


LEAST_VARIANCE = 1e-12
"""Lower bound of the product of the two depth maps' sums of squares, by whose root their correlation is divided."""
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
    """Return the logarithm of the root mean squared distance of each point to its `k` nearest neighbours, [N].

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


@dataclass
class TwoStageScheduleStep:
    """Stage (coarse or fine) and video frame to train on of one optimiser step."""

    stage: Literal["coarse", "fine"]
    frame_index: int
    shuffle: bool
    """True in the fine stage, in which a data loader may choose frames at random instead of in turn."""


class TwoStageScheduler:
    """Schedule of optimiser steps in two stages: on one frame first, then on all frames in turn."""

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


AXES = tuple(combinations(range(4), 2))
"""Axes of gsplat's planes in its order: xy, xz, xt, yz, yt, zt."""
ORDER = tuple(AXES.index(axes) for axes in plain_torch.PLANE_AXES)
"""Indices by which the six planes in gsplat's order are put into the order that `hexplane_features` takes."""
SPACE = tuple(place for place, axes in enumerate(AXES) if 3 not in axes)
"""Indices, in gsplat's order of the six planes, of the three without the time axis."""
TIME = tuple(place for place, axes in enumerate(AXES) if 3 in axes)
"""Indices, in gsplat's order of the six planes, of the three with the time axis."""
PLANES_CONFIG: Mapping[str, Any] = {
    "grid_dimensions": 2,
    "input_coordinate_dim": 4,
    "output_coordinate_dim": 32,
    "resolution": [64, 64, 64, 25],
}
"""Default of the argument `planes_config` of `HexPlaneField`: numbers of axes and features, and the resolution."""
LEAST_CURVED = 3
"""Smallest number of rows of a HexPlane plane that has second differences; lower planes have no smoothness term."""


class HexPlaneField(torch.nn.Module):
    """Features of positions and times: products of bilinear samples of six planes, at several resolutions.

    Positions are divided by `-bounds`, as in gsplat, and clamped to -1..1. Time is taken as it is, and clamped to -1..1.
    """

    def __init__(
        self,
        bounds: float = 1.6,
        planes_config: Mapping[str, Any] | None = None,
        multires: Sequence[int] | None = None,
    ) -> None:
        """Create planes. Space planes start uniform in 0.1..0.5, time planes at 1.

        Args:
            bounds: half the side of the cube of positions.
            planes_config: `output_coordinate_dim`, the number of features, and `resolution` of x, y, z and t.
                `grid_dimensions` and `input_coordinate_dim` must be 2 and 4.
            multires: factors on the resolution of x, y and z, one for each level; (1, 2) by default.

        Raises:
            InvalidInput: if `planes_config` describes no six planes.
        """
        super().__init__()
        config = {**PLANES_CONFIG, **(planes_config or {})}
        if (config["grid_dimensions"], config["input_coordinate_dim"]) != (2, 4) or len(config["resolution"]) != 4:
            raise InvalidInput(
                f"planes_config must have grid_dimensions 2, input_coordinate_dim 4 and four values in resolution, got {config}"
            )
        self.bounds, self.grid_config = float(bounds), config
        self.multires = list(multires or (1, 2))
        corner = torch.full((3,), self.bounds)
        self.aabb = torch.nn.Parameter(torch.stack([corner, -corner]), requires_grad=False)
        self.grids = torch.nn.ModuleList(self._new_level(level) for level in self.multires)
        self.feat_dim = config["output_coordinate_dim"] * len(self.multires)

    def _new_level(self, level: int) -> torch.nn.ParameterList:
        features = self.grid_config["output_coordinate_dim"]
        *space, times = self.grid_config["resolution"]
        sizes = [*(level * size for size in space), times]
        planes = []
        for u, v in AXES:
            plane = torch.empty(1, features, sizes[v], sizes[u])
            plane = plane.fill_(1) if v == 3 else plane.uniform_(0.1, 0.5)
            # Store planes channels-last in memory, as the ops read them, so that they need no copy.
            planes.append(torch.nn.Parameter(plane.contiguous(memory_format=torch.channels_last)))
        return torch.nn.ParameterList(planes)

    def forward(self, xyzt: Tensor) -> Tensor:
        """Return the features of all levels [N, feat_dim].

        Args:
            xyzt: positions in world units and time, [..., 4]; leading dimensions are flattened.

        Raises:
            ValueError: if the last dimension is not 4.
        """
        if xyzt.shape[-1] != 4:
            raise InvalidInput(f"the last dim of xyzt must be 4 (x, y, z, t), got {list(xyzt.shape)}")
        first, last = self.aabb[0], self.aabb[1]
        space = (xyzt[..., :3] - first) * (2 / (last - first)) - 1
        coordinates = torch.cat([space, xyzt[..., 3:]], -1).reshape(-1, 4)
        features = ops_for(coordinates, compiled, plain_torch).hexplane_features
        return torch.cat([features(coordinates, *self._channels_last(level)) for level in self.grids], -1)

    @staticmethod
    def _channels_last(level: torch.nn.Module) -> list[Tensor]:
        """Return the planes of a level [V, U, C], in the order of `hexplane_features`."""
        planes = list(level.parameters())
        return [planes[place][0].permute(1, 2, 0).contiguous() for place in ORDER]

    def spatial_planes(self) -> list[Tensor]:
        """Return the planes without time (xy, xz and yz) of all resolution levels."""
        return self._chosen(SPACE)

    def temporal_planes(self) -> list[Tensor]:
        """Return the planes with time (xt, yt and zt) of all resolution levels."""
        return self._chosen(TIME)

    def _chosen(self, places: Sequence[int]) -> list[Tensor]:
        levels = [list(level.parameters()) for level in self.grids]
        return [planes[place] for planes in levels for place in places]


class DeformNetwork(torch.nn.Module):
    """MLP from HexPlane features to changes of means, rotations and opacities. Its heads start at zero, so that nothing deforms."""

    def __init__(self, feature_dim: int, hidden_dim: int = 64, num_layers: int = 3) -> None:
        """Create the MLP's layers.

        Args:
            feature_dim: number of features, `HexPlaneField.feat_dim`.
            hidden_dim: width of the layers.
            num_layers: number of layers before the heads.

        Raises:
            ValueError: if `feature_dim` or `num_layers` is below 1.
        """
        super().__init__()
        for name, value in (("feature_dim", feature_dim), ("num_layers", num_layers)):
            if value < 1:
                raise InvalidInput(f"{name} must be at least 1, got {value}")
        self.feature_dim, self.hidden_dim, self.num_layers = feature_dim, hidden_dim, num_layers
        layers: list[torch.nn.Module] = []
        for layer in range(num_layers):
            layers += [torch.nn.Linear(hidden_dim if layer else feature_dim, hidden_dim), torch.nn.ReLU()]
        self.trunk = torch.nn.Sequential(*layers)
        self.pos_head, self.quat_head, self.opacity_head = (torch.nn.Linear(hidden_dim, size) for size in (3, 4, 1))
        for head in (self.pos_head, self.quat_head, self.opacity_head):
            torch.nn.init.zeros_(head.weight)
            torch.nn.init.zeros_(head.bias)

    def forward(
        self, means: Tensor, quats: Tensor, opacities: Tensor, t: Tensor, plane_features: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Add the changes to means, rotations and opacities.

        Args:
            means: [N, 3].
            quats: [N, 4].
            opacities: [N, 1], as logits or as values.
            t: not used, because the features depend on time already.
            plane_features: features [N, feature_dim].

        Returns:
            Means, rotations and opacities, of the shapes given.

        Raises:
            ValueError: if numbers of rows, features or dtypes do not fit together.
        """
        given = {"means": means, "quats": quats, "opacities": opacities, "plane_features": plane_features}
        if len({tensor.shape[0] for tensor in given.values()}) > 1:
            shapes = {name: list(tensor.shape) for name, tensor in given.items()}
            raise InvalidInput(f"batch dim mismatch: all tensors must have one number of rows, got {shapes}")
        if plane_features.shape[-1] != self.feature_dim:
            raise InvalidInput(
                f"plane_features must have feature_dim {self.feature_dim} columns, got {list(plane_features.shape)}"
            )
        if len({tensor.dtype for tensor in given.values()}) > 1:
            raise InvalidInput(f"dtype mismatch: { ({name: tensor.dtype for name, tensor in given.items()}) }")
        hidden = self.trunk(plane_features)
        return means + self.pos_head(hidden), quats + self.quat_head(hidden), opacities + self.opacity_head(hidden)


class DynamicStrategy(DefaultStrategy):
    """`DefaultStrategy` whose state marks the Gaussians that deform.

    `state["dynamic_mask"]`, bool [N], follows duplicated, split and removed rows. Planes and network are not part of
    `params`; they have optimisers of their own.
    """

    def initialize_state(
        self,
        scene_scale: float = 1.0,
        num_gaussians: int = 0,
        device: torch.device | str | None = None,
        init_dynamic: bool = True,
    ) -> dict[str, Any]:
        """Return empty statistics and the mask of deforming Gaussians.

        Args:
            scene_scale: size of the scene, as in `DefaultStrategy`.
            num_gaussians: number of Gaussians.
            device: device of the mask; None for the CPU.
            init_dynamic: value of all rows of the mask.
        """
        state = super().initialize_state(scene_scale=scene_scale)
        state["dynamic_mask"] = torch.full((num_gaussians,), bool(init_dynamic), device=device)
        return state

    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Refine as `DefaultStrategy.step_post_backward` does.

        Raises:
            RuntimeError: if `state` has no mask.
        """
        if "dynamic_mask" not in state:
            raise RuntimeError(
                "state has no dynamic_mask; call initialize_state(num_gaussians=N) of DynamicStrategy before training"
            )
        super().step_post_backward(params, optimizers, state, step, info, packed=packed)


def plane_smoothness(planes: Sequence[Tensor]) -> Tensor:
    """Return the mean squared second difference along the height of each plane [B, C, H, W], summed over the planes.

    Planes lower than 3 do not count.

    Raises:
        ValueError: if a plane is not 4D.
    """
    for plane in planes:
        if plane.dim() != 4:
            raise InvalidInput(f"planes must be 4D [B, C, H, W], got {list(plane.shape)}")
    return _summed(
        [plane for plane in planes if plane.shape[-2] >= LEAST_CURVED],
        lambda plane: plane.diff(n=2, dim=-2).square().mean(),
        planes,
    )


def time_smoothness(planes: Sequence[Tensor]) -> Tensor:
    """Return `plane_smoothness` of planes with time, whose height is the time."""
    return plane_smoothness(planes)


def time_l1(planes: Sequence[Tensor]) -> Tensor:
    """Return the mean absolute deviation of each plane's values from 1, summed over the planes."""
    return _summed(planes, lambda plane: (plane - 1).abs().mean(), planes)


def hexplane_regularization(
    field: HexPlaneField,
    lambda_plane_smooth: float = 1.0,
    lambda_time_smooth: float = 1.0,
    lambda_time_l1: float = 1.0,
) -> Tensor:
    """Return the weighted sum of `plane_smoothness`, `time_smoothness` and `time_l1` over the planes of a field."""
    space, time = field.spatial_planes(), field.temporal_planes()
    return (
        lambda_plane_smooth * plane_smoothness(space)
        + lambda_time_smooth * time_smoothness(time)
        + lambda_time_l1 * time_l1(time)
    )


def _summed(counted: Sequence[Tensor], term: Callable[[Tensor], Tensor], planes: Sequence[Tensor]) -> Tensor:
    """Return the sum of `term` over the planes `counted`; if there are none, a zero on the device of `planes`."""
    if counted:
        return torch.stack([term(plane) for plane in counted]).sum()
    return planes[0].new_zeros(()) if planes else torch.zeros(())
