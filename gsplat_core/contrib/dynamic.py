"""Deforming Gaussians with the names of gsplat's `contrib.dynamic`: HexPlane field, network, strategy and regularisers.

A training loop evaluates `HexPlaneField` at positions and time, passes the features to `DeformNetwork`, and renders the
deformed Gaussians. Parameters have gsplat's names and shapes, so its checkpoints load. For new work, the fields of
`gsplat_core.deformation` are faster and normalise time as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from gsplat_core.deformation.field import ops_for
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import hexplane as compiled
from gsplat_core.ops import plain_torch
from gsplat_core.training.strategies.adc import DefaultStrategy
from gsplat_core.training.strategies.strategy import Optimizers, Params

AXES = tuple(combinations(range(4), 2))
"""Axes of gsplat's planes in its order: xy, xz, xt, yz, yt, zt."""
ORDER = tuple(AXES.index(axes) for axes in plain_torch.PLANE_AXES)
"""Index among gsplat's planes of each plane that `hexplane_features` takes."""
SPACE = tuple(place for place, axes in enumerate(AXES) if 3 not in axes)
"""Indices among gsplat's planes of those without time."""
TIME = tuple(place for place, axes in enumerate(AXES) if 3 in axes)
"""Indices among gsplat's planes of those with time."""
PLANES_CONFIG: Mapping[str, Any] = {
    "grid_dimensions": 2,
    "input_coordinate_dim": 4,
    "output_coordinate_dim": 32,
    "resolution": [64, 64, 64, 25],
}
"""Default of `planes_config`."""
LEAST_CURVED = 3
"""Minimum height of a plane that has a second difference."""


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
            # The ops read channels-last planes, which this layout provides without a copy.
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
        """Return the planes xy, xz and yz of all levels."""
        return self._chosen(SPACE)

    def temporal_planes(self) -> list[Tensor]:
        """Return the planes xt, yt and zt of all levels."""
        return self._chosen(TIME)

    def _chosen(self, places: Sequence[int]) -> list[Tensor]:
        levels = [list(level.parameters()) for level in self.grids]
        return [planes[place] for planes in levels for place in places]


class DeformNetwork(torch.nn.Module):
    """Network from features to changes of means, rotations and opacities. Its heads start at zero, the identity."""

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
    """Return the mean absolute deviation from 1 of each plane, summed over the planes."""
    return _summed(planes, lambda plane: (plane - 1).abs().mean(), planes)


def hexplane_regularization(
    field: HexPlaneField,
    lambda_plane_smooth: float = 1.0,
    lambda_time_smooth: float = 1.0,
    lambda_time_l1: float = 1.0,
) -> Tensor:
    """Return the weighted sum of the three regularisers over the planes of a field."""
    space, time = field.spatial_planes(), field.temporal_planes()
    return (
        lambda_plane_smooth * plane_smoothness(space)
        + lambda_time_smooth * time_smoothness(time)
        + lambda_time_l1 * time_l1(time)
    )


def _summed(counted: Sequence[Tensor], term: Callable[[Tensor], Tensor], planes: Sequence[Tensor]) -> Tensor:
    """Return the sum of a term over planes; a zero on the device of `planes` if none counts."""
    if counted:
        return torch.stack([term(plane) for plane in counted]).sum()
    return planes[0].new_zeros(()) if planes else torch.zeros(())
