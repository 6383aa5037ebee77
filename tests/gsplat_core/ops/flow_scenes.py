"""Splats for the tests of blended flow: screen ellipses, rays and planes, with all of them in every tile they may touch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.scene.cameras import Camera


class FlowScene(NamedTuple):
    """Arguments of `blend_flow` that are tensors, in its order."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    rays: Tensor
    planes: Tensor

    def lists(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the offsets [tile_height, tile_width] and ids of the tiles, in the order of the splats."""
        grid = TileGrid(16, -(-camera.width_px // 16), -(-camera.height_px // 16))
        covers = torch.full((1, len(self.opacities), 2), 2**30, dtype=torch.int32, device=self.means2d.device)
        depths = torch.arange(1.0, len(self.opacities) + 1, device=self.means2d.device)[None]
        _, ids, offsets = bin_splats(
            self.means2d.nan_to_num(posinf=20.0)[None], covers, depths, grid,
            conics=self.conics.nan_to_num(posinf=0.1)[None], opacities=self.opacities.nan_to_num(posinf=0.5)[None],
        )  # fmt: skip
        return offsets[0], ids

    def converted(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> FlowScene:
        """Return the scene in another dtype, as new leaves of which `planes` requires a gradient."""
        moved = [tensor.detach().to(device, dtype).clone() for tensor in self]
        moved[4].requires_grad_()
        return FlowScene(*moved)


BEFORE = Camera.from_focal(60.0, 70, 45)
AFTER = Camera.from_focal(64.0, 72, 40)


def flow_scene(count: int, camera: Camera = BEFORE, median_px: float = 4.0, seed: int = 0) -> FlowScene:
    """Random splats at depths of about 10, moved by a few pixels."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(count, *shape, generator=g)
    means2d = torch.rand(count, 2, generator=g) * torch.tensor([camera.width_px + 10.0, camera.height_px + 10.0]) - 5
    sides = median_px * (0.5 * draw(2)).exp()
    angle = draw()
    axes = torch.stack([angle.cos(), angle.sin(), -angle.sin(), angle.cos()], 1).reshape(-1, 2, 2)
    conic = axes.transpose(1, 2) @ torch.diag_embed(sides**-2) @ axes
    conics = torch.stack([conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]], 1)
    z = 10 + draw()
    slope = 0.01 * draw(2)
    rays = torch.cat(
        [z[:, None], z[:, None] * slope, 2 * slope, 1e-4 * draw(3).abs(), 0.3 + draw(1).abs(), torch.zeros(count, 1)], 1
    )
    B = torch.eye(3) + 0.05 * draw(3, 3)
    planes = torch.cat([0.5 * draw(3), B.flatten(1)], 1)
    return FlowScene(means2d, conics, torch.rand(count, generator=g), rays, planes)
