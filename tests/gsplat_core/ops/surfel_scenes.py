"""Random surfels in front of cameras, and comparison of the compiled operations with plain torch in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.surfel_blending import rasterize_to_pixels_2dgs
from gsplat_core.ops.surfel_projection import fully_fused_projection_2dgs
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.reference import surfels as oracle

PROJECTED = ("means2d", "depths", "ray_transforms", "normals")
BLENDED = ("image", "alphas", "normals", "distortions", "medians")
INPUTS = ("means2d", "ray_transforms", "colors", "opacities", "normals", "densify")


@dataclass
class SurfelScene:
    """Float64 surfels and cameras."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def project(self, dtype: torch.dtype = torch.float64, device: Any = "cpu", **options: Any) -> dict[str, Tensor]:
        """Project, and propagate fixed random gradients of the visible surfels; return results and gradients by name."""
        inputs = {
            name: getattr(self, name).to(device, dtype).clone().requires_grad_()
            for name in ("means", "quats", "scales")
        }
        viewmats = self.viewmats.to(device, dtype).clone().requires_grad_()
        function: Callable[..., Any] = fully_fused_projection_2dgs
        if dtype == torch.float64:
            function = oracle.fully_fused_projection_2dgs
        out = function(*inputs.values(), viewmats, self.Ks.to(device, dtype), self.width, self.height, **options)
        generator = torch.Generator().manual_seed(7)
        loss = sum(
            (getattr(out, name) * torch.randn(getattr(out, name).shape, generator=generator).to(device, dtype)).sum()
            for name in PROJECTED
        )
        gradients = torch.autograd.grad(loss, [*inputs.values(), viewmats])
        return {
            "radii": out.radii,
            **{name: getattr(out, name).detach() for name in PROJECTED},
            **{f"v_{name}": v for name, v in zip([*inputs, "viewmats"], gradients, strict=True)},
        }


def surfel_scene(
    count: int = 60, width: int = 40, height: int = 33, *, batch: tuple[int, ...] = (), cameras: int = 1, channels: int = 4,
    scale: float = 0.12, seed: int = 0,
) -> SurfelScene:  # fmt: skip
    """Return surfels in a slab in front of the cameras."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = (uniform(*batch, count, 3) - 0.5) * torch.tensor([2.4, 2.0, 1.0]) + torch.tensor([0.0, 0.0, 2.5])
    scales = scale * torch.exp(uniform(*batch, count, 3) - 0.5)
    quats = torch.randn(*batch, count, 4, generator=generator, dtype=torch.float64)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(*batch, cameras, 1, 1)
    viewmats[..., :3, 3] = 0.1 * (uniform(*batch, cameras, 3) - 0.5)
    focal = float(width)
    intrinsics = torch.tensor([[focal, 0, width / 2 + 0.3], [0, 1.1 * focal, height / 2 - 0.2], [0, 0, 1]])
    return SurfelScene(
        means, quats, scales, uniform(*batch, count), uniform(*batch, cameras, count, channels), viewmats,
        intrinsics.double().repeat(*batch, cameras, 1, 1), width, height,
    )  # fmt: skip


@dataclass
class BlendScene:
    """Float64 inputs of blending, with lists of tiles."""

    means2d: Tensor
    ray_transforms: Tensor
    colors: Tensor
    opacities: Tensor
    normals: Tensor
    densify: Tensor
    radii: Tensor
    depths: Tensor
    width: int
    height: int
    tile_size: int = 16
    backgrounds: Tensor | None = None
    masks: Tensor | None = None

    def to(self, dtype: torch.dtype, device: Any = "cpu") -> dict[str, Tensor]:
        return {name: getattr(self, name).to(device, dtype).clone().requires_grad_() for name in INPUTS}

    def lists(self) -> tuple[Tensor, Tensor]:
        """Return isect_offsets and flatten_ids."""
        grid = TileGrid(self.tile_size, -(-self.width // self.tile_size), -(-self.height // self.tile_size))
        _, flatten_ids, offsets = bin_splats(self.means2d.float(), self.radii, self.depths.float(), grid)
        return offsets, flatten_ids

    def run(
        self, dtype: torch.dtype = torch.float32, device: Any = "cpu", *, absgrad: bool = False, max_alpha: float = 0.99,
        lists: tuple[Tensor, Tensor] | None = None,
    ) -> dict[str, Tensor]:  # fmt: skip
        """Blend, and propagate fixed random gradients; return results and gradients by name."""
        inputs = self.to(dtype, device)
        background = None if self.backgrounds is None else self.backgrounds.to(device, dtype).clone().requires_grad_()
        masks = None if self.masks is None else self.masks.to(device)
        function: Callable[..., Any] = rasterize_to_pixels_2dgs
        if dtype == torch.float64:
            function = oracle.rasterize_to_pixels_2dgs
        offsets, ids = lists or self.lists()
        out = function(
            *inputs.values(), self.width, self.height, self.tile_size, offsets.to(device), ids.to(device),
            backgrounds=background, masks=masks, absgrad=absgrad, max_alpha=max_alpha,
        )  # fmt: skip
        generator = torch.Generator().manual_seed(3)
        loss = sum((value * torch.randn(value.shape, generator=generator).to(device, dtype)).sum() for value in out)
        leaves = list(inputs.values()) + ([] if background is None else [background])
        # Without surfels the pictures of the reference do not depend on the inputs.
        loss = loss + sum((leaf * 0).sum() for leaf in leaves)
        # Not torch.autograd.grad, which does not call the hook that stores absolute gradients.
        loss.backward()
        result = {name: value.detach() for name, value in zip(BLENDED, out, strict=True)}
        names = [*INPUTS, "backgrounds"][: len(leaves)]
        result |= {f"v_{name}": leaf.grad for name, leaf in zip(names, leaves, strict=True)}  # type: ignore[misc]
        if absgrad:
            result["absgrad"] = inputs["means2d"].absgrad  # type: ignore[attr-defined]
        return result


def blend_scene(surfels: SurfelScene, **options: Any) -> BlendScene:
    """Return the inputs of blending of projected surfels, with depth as the last channel."""
    dense = oracle.fully_fused_projection_2dgs(
        surfels.means, surfels.quats, surfels.scales, surfels.viewmats, surfels.Ks, surfels.width, surfels.height
    )
    colors = surfels.colors.clone()
    colors[..., -1] = dense.depths
    opacities = surfels.opacities[..., None, :].expand(dense.depths.shape).clone()
    scene = BlendScene(
        dense.means2d, dense.ray_transforms, colors, opacities, dense.normals, torch.zeros_like(dense.means2d),
        dense.radii, dense.depths, surfels.width, surfels.height, **options,
    )  # fmt: skip
    rounded = {name: getattr(scene, name).float().double() for name in INPUTS}
    return replace(scene, **rounded)


def close(seen: dict[str, Tensor], wanted: dict[str, Tensor], relative: float = 2e-4) -> None:
    """Compare by the norm of the difference, relative to the norm."""
    assert seen.keys() == wanted.keys()
    for name, value in wanted.items():
        error = (seen[name].double().cpu() - value).norm()
        assert error <= relative * value.norm() + 2e-5, (name, float(error), float(value.norm()))
