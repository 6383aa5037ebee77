"""Splats for the tests of compositing, and the comparison with plain torch in float64."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.reference import compositing as reference

Rasterize = Callable[..., tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Scene:
    """Splats of some images, and which of them each tile has."""

    means2d: Tensor
    conics: Tensor
    colors: Tensor
    opacities: Tensor
    width: int
    height: int
    tile_size: int = 16
    backgrounds: Tensor | None = None
    masks: Tensor | None = None
    max_alpha: float = 0.99

    def lists(self) -> tuple[Tensor, Tensor]:
        """Every splat in every tile that its contour may touch, in the order of its index."""
        shape = self.opacities.shape
        covers = torch.full((*shape, 2), 2**30, dtype=torch.int32)
        across, down = math.ceil(self.width / self.tile_size), math.ceil(self.height / self.tile_size)
        depths = torch.arange(1.0, shape[-1] + 1).expand(shape)
        # Values that are not finite are listed all the same: compositing must skip them itself.
        means2d = self.means2d.nan_to_num(posinf=20.0)
        options = dict(conics=self.conics.nan_to_num(posinf=0.1), opacities=self.opacities.nan_to_num(posinf=0.5))
        _, flatten_ids, offsets = bin_splats(means2d, covers, depths, TileGrid(self.tile_size, across, down), **options)
        return offsets, flatten_ids

    def run(self, rasterize: Rasterize, dtype: torch.dtype, absgrad: bool = False) -> dict[str, Tensor]:
        """Image, alpha and the gradients of a fixed random linear function of them."""
        inputs = {
            name: value.to(dtype).clone().requires_grad_()
            for name in ("means2d", "conics", "colors", "opacities", "backgrounds")
            if (value := getattr(self, name)) is not None
        }
        named = dict(backgrounds=inputs.get("backgrounds"), masks=self.masks, absgrad=absgrad, max_alpha=self.max_alpha)
        splats = [inputs[name] for name in ("means2d", "conics", "colors", "opacities")]
        image, alphas = rasterize(*splats, self.width, self.height, self.tile_size, *self.lists(), **named)
        random = torch.Generator().manual_seed(11)
        v_image, v_alphas = (torch.randn(t.shape, generator=random) for t in (image, alphas))
        ((image * v_image).sum() + (alphas * v_alphas).sum()).backward()
        results = {"image": image.detach(), "alphas": alphas.detach()}
        results |= {f"v_{name}": t.grad for name, t in inputs.items() if t.grad is not None}
        if absgrad:
            results["absgrad"] = inputs["means2d"].absgrad  # type: ignore[attr-defined]
        return results


def scene(
    count: int,
    width: int = 70,
    height: int = 45,
    channels: int = 3,
    image_dims: tuple[int, ...] = (1,),
    median_px: float = 3.0,
    seed: int = 0,
    **options: object,
) -> Scene:
    random = torch.Generator().manual_seed(seed)
    shape = (*image_dims, count)
    means2d = torch.rand(*shape, 2, generator=random) * torch.tensor([width + 10.0, height + 10.0]) - 5
    axes = (
        torch.randn(*shape, 2, 2, generator=random)
        * median_px
        * torch.exp(0.5 * torch.randn(*shape, 1, 1, generator=random))
    )
    conics = torch.linalg.inv(axes @ axes.mT + 0.3 * torch.eye(2)).flatten(-2)[..., [0, 1, 3]]
    colors = torch.randn(*shape, channels, generator=random)
    opacities = torch.sigmoid(1 + 2 * torch.randn(shape, generator=random))
    return Scene(means2d, conics, colors, opacities, width, height, **options)  # type: ignore[arg-type]


def assert_close(s: Scene, absgrad: bool = False) -> dict[str, Tensor]:
    """Compiled against reference: pixels within 2e-4 of their scale, gradients within 1e-3 of their norm."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the reference's many small tensors gain nothing from more
    try:
        wanted = s.run(reference.rasterize_to_pixels, torch.float64, absgrad)
    finally:
        torch.set_num_threads(threads)
    seen = s.run(rasterize_to_pixels, torch.float32, absgrad)
    assert seen.keys() == wanted.keys()
    for name, w in wanted.items():
        assert seen[name].shape == w.shape
        assert seen[name].isfinite().all(), name
        error = seen[name].double() - w
        if name in ("image", "alphas"):
            scale = max(1.0, float(s.colors.nan_to_num(posinf=0).abs().max())) if s.colors.numel() else 1.0
            # A splat within rounding of a cut-off may fall on either side of it, in a few pixels.
            off = (error.abs() > 2e-4 * scale).any(-1)
            assert int(off.sum()) <= max(1, 2e-4 * off.numel()), (name, int(off.sum()))
            assert error.abs().max() <= 0.02 * scale, (name, float(error.abs().max()))
        else:
            assert error.norm() <= 1e-3 * w.norm(), (name, float(error.norm() / w.norm()))
    return seen
