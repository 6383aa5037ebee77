"""Compositing on CUDA, forward and backward, against plain torch in float64 and against the CPU."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.reference import compositing as reference

Results = dict[str, Tensor]


@dataclass(frozen=True)
class Scene:
    """Splats of some images, on the CPU."""

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
        """The CPU's lists: every splat in every tile that its contour may touch, in the order of its index."""
        shape = self.opacities.shape
        covers = torch.full((*shape, 2), 2**30, dtype=torch.int32)
        across, down = math.ceil(self.width / self.tile_size), math.ceil(self.height / self.tile_size)
        depths = torch.arange(1.0, shape[-1] + 1).expand(shape)
        # Values that are not finite are listed all the same: compositing must skip them itself.
        options = dict(conics=self.conics.nan_to_num(posinf=0.1), opacities=self.opacities.nan_to_num(posinf=0.5))
        means2d = self.means2d.nan_to_num(posinf=20.0)
        _, flatten_ids, offsets = bin_splats(means2d, covers, depths, TileGrid(self.tile_size, across, down), **options)
        return offsets, flatten_ids

    def run(
        self,
        device: str = "cuda",
        rasterize: Callable[..., tuple[Tensor, Tensor]] = rasterize_to_pixels,
        dtype: torch.dtype = torch.float32,
        absgrad: bool = False,
    ) -> Results:
        """Image, alpha and the gradients of a fixed random linear function of them, on the CPU."""
        inputs = {
            name: value.to(device, dtype, copy=True).requires_grad_()
            for name in ("means2d", "conics", "colors", "opacities", "backgrounds")
            if (value := getattr(self, name)) is not None
        }
        masks = None if self.masks is None else self.masks.to(device)
        named = dict(backgrounds=inputs.get("backgrounds"), masks=masks, absgrad=absgrad, max_alpha=self.max_alpha)
        splats = [inputs[name] for name in ("means2d", "conics", "colors", "opacities")]
        lists = [t.to(device) for t in self.lists()]
        image, alphas = rasterize(*splats, self.width, self.height, self.tile_size, *lists, **named)
        random = torch.Generator().manual_seed(11)
        v_image, v_alphas = (torch.randn(t.shape, generator=random).to(device) for t in (image, alphas))
        ((image * v_image).sum() + (alphas * v_alphas).sum()).backward()
        results = {"image": image.detach(), "alphas": alphas.detach()}
        results |= {f"v_{name}": t.grad for name, t in inputs.items() if t.grad is not None}
        if absgrad:
            results["absgrad"] = inputs["means2d"].absgrad  # type: ignore[attr-defined]
        return {name: value.cpu() for name, value in results.items()}


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
    size = median_px * torch.exp(0.5 * torch.randn(*shape, 1, 1, generator=random))
    axes = torch.randn(*shape, 2, 2, generator=random) * size
    conics = torch.linalg.inv(axes @ axes.mT + 0.3 * torch.eye(2)).flatten(-2)[..., [0, 1, 3]]
    colors = torch.randn(*shape, channels, generator=random)
    opacities = torch.sigmoid(1 + 2 * torch.randn(shape, generator=random))
    return Scene(means2d, conics, colors, opacities, width, height, **options)  # type: ignore[arg-type]


def assert_near(seen: Results, wanted: Results) -> None:
    """Pixels within 2e-4 of their scale, gradients within 1e-3 of their norm."""
    assert seen.keys() == wanted.keys()
    for name, w in wanted.items():
        assert seen[name].shape == w.shape
        assert seen[name].isfinite().all(), name
        error = seen[name].double() - w
        if name in ("image", "alphas"):
            scale = max(1.0, float(w.abs().max())) if w.numel() else 1.0
            # A splat within rounding of a cut-off may fall on either side of it, in a few pixels and by a few 1/255.
            off = (error.abs() > 2e-4 * scale).any(-1)
            assert off.sum() <= 1 + 2e-4 * off.numel(), (name, int(off.sum()))
            assert not w.numel() or error.abs().max() <= 3 / 255 * max(4.0, scale), (name, float(error.abs().max()))
        else:
            assert error.norm() <= 1e-3 * w.norm(), (name, float(error.norm() / w.norm()))


def check(s: Scene, absgrad: bool = False) -> Results:
    """CUDA against the reference in float64 and against the CPU."""
    seen = s.run(absgrad=absgrad)
    assert_near(seen, s.run("cpu", reference.rasterize_to_pixels, torch.float64, absgrad))
    assert_near(seen, s.run("cpu", absgrad=absgrad))
    return seen


@pytest.mark.parametrize("absgrad", [True, False])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 7, 8, 9, 32])
def test_compositing_with_any_number_of_channels(channels: int, absgrad: bool) -> None:
    check(scene(300, channels=channels, backgrounds=torch.rand(1, channels)), absgrad)


@pytest.mark.parametrize("tile_size", [4, 5, 8, 16, 20, 33, 64])
@pytest.mark.parametrize("size", [(1, 1), (33, 50)])
def test_compositing_with_any_tile_and_image_size(tile_size: int, size: tuple[int, int]) -> None:
    check(scene(120, *size, tile_size=tile_size, backgrounds=torch.rand(1, 3)), absgrad=True)


@pytest.mark.parametrize("image_dims", [(), (3,), (2, 2), (0,)])
def test_compositing_with_leading_dimensions(image_dims: tuple[int, ...]) -> None:
    s = scene(60, 40, 20, image_dims=image_dims, backgrounds=torch.rand(*image_dims, 3))
    seen = s.run()
    assert seen["image"].shape == (*image_dims, 20, 40, 3)
    if 0 not in image_dims:
        check(s)


def test_compositing_of_faint_opaque_and_indefinite_splats() -> None:
    s = scene(300, median_px=5.0)
    s.opacities[:, ::4] = 1.0
    s.opacities[:, 1::4] = 1.5 / 255
    s.opacities[:, 2::8] = 0.0
    s.conics[:, 1::3] = torch.tensor([0.05, 0.0, -0.04])
    s.conics[:, 4::9] = torch.tensor([0.02, 0.05, 0.02])
    check(s)


def test_compositing_of_thin_huge_and_tiny_splats() -> None:
    s = scene(200, 90, 60, median_px=4.0)
    direction = torch.tensor([[1.0, 1.0], [-1.0, 1.0]]) / math.sqrt(2)
    thin = direction.T @ torch.diag(torch.tensor([1 / 80.0**2, 1 / 0.6**2])) @ direction
    s.conics[:, ::5] = thin.flatten()[[0, 1, 3]]
    s.conics[:, 1::5] = torch.tensor([1e-8, 0.0, 1e-8])
    s.conics[:, 2::5] = torch.tensor([3.3, 0.0, 3.3])
    s.conics[:, 3::25] = 0.0
    check(s, absgrad=True)


def test_compositing_gradients_of_tiny_splats_keep_single_precision() -> None:
    """Moments are summed about the middle of 8x8 pixels; moving them to the mean of a tiny splat must not lose precision."""
    s, random = scene(400, 160, 160, channels=4), torch.Generator().manual_seed(5)
    s.means2d[0] = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)) * 8 + 8 * torch.rand(
        400, 2, generator=random
    )
    s.conics[:] = torch.tensor([3.3, 0.4, 2.8])
    s.opacities.clamp_(0.02, 0.95)
    seen, wanted = s.run(), s.run("cpu", reference.rasterize_to_pixels, torch.float64)
    for name in ("v_means2d", "v_conics", "v_colors", "v_opacities"):
        error = (seen[name].double() - wanted[name]).reshape(400, -1).norm(dim=-1)
        # One splat in a hundred may have a pixel within rounding of the cut-off of 1/255.
        assert (error > 2e-4 * wanted[name].reshape(400, -1).norm(dim=-1)).sum() <= 4, name


@pytest.mark.parametrize("channels", [3, 6])
def test_compositing_skips_non_finite_splats_without_gradient(channels: int) -> None:
    s = scene(200, channels=channels)
    columns = (
        (s.means2d, 0),
        (s.means2d, 1),
        (s.conics, 0),
        (s.conics, 1),
        (s.conics, 2),
        (s.colors, 0),
        (s.colors, 2),
    )
    for row, value in enumerate((math.nan, math.inf, -math.inf)):
        for column, (tensor, channel) in enumerate(columns):
            tensor[0, 8 * row + column, channel] = value
        s.opacities[0, 8 * row + 7] = value
    bad = torch.arange(200) < 24
    seen = s.run(absgrad=True)
    good = replace(s, **{n: getattr(s, n)[:, ~bad] for n in ("means2d", "conics", "colors", "opacities")})
    wanted = good.run(absgrad=True)
    assert torch.equal(seen["image"], wanted["image"])
    for name in ("v_means2d", "v_conics", "v_colors", "v_opacities", "absgrad"):
        assert not seen[name][:, bad].any()
        torch.testing.assert_close(seen[name][:, ~bad], wanted[name])


def test_compositing_masked_tiles_show_background_only() -> None:
    masks = torch.rand(2, 3, 5, generator=torch.Generator().manual_seed(2)) > 0.4
    seen = check(scene(150, image_dims=(2,), masks=masks, backgrounds=torch.rand(2, 3)))
    hidden = ~masks.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, :45, :70]
    assert not seen["alphas"][..., 0][hidden].any()


@pytest.mark.parametrize("channels", [3, 2])
def test_compositing_without_splats_shows_background(channels: int) -> None:
    background = torch.rand(1, channels)
    seen = scene(0, 33, 17, channels, backgrounds=background).run()
    assert torch.equal(seen["image"], background.expand(1, 17, 33, channels))
    assert not seen["alphas"].any()


def test_compositing_of_very_many_splats_in_one_tile() -> None:
    s = scene(20_000, 16, 16)
    s.opacities[:] = 0.0045  # just visible, so that about 2,000 are blended before a pixel ends
    s.conics[:] = torch.tensor([1e-6, 0.0, 1e-6])  # and over the whole tile: no pixel is near the cut-off of 1/255
    check(s)


def test_compositing_of_splat_in_very_many_tiles() -> None:
    s = scene(40, 300, 200, median_px=2.0, backgrounds=torch.rand(1, 3))
    s.conics[:, 3] = torch.tensor([1e-6, 0.0, 1e-6])
    s.opacities[:, 3] = 0.3
    check(s, absgrad=True)


def test_compositing_packed_equals_dense() -> None:
    s = scene(80, image_dims=(2,))
    offsets, flatten_ids = (t.cuda() for t in s.lists())
    splats = [t.cuda() for t in (s.means2d, s.conics, s.colors, s.opacities)]
    dense = rasterize_to_pixels(*splats, s.width, s.height, 16, offsets, flatten_ids)
    flat = [t.flatten(0, 1) for t in splats]
    packed = rasterize_to_pixels(*flat, s.width, s.height, 16, offsets, flatten_ids, packed=True)
    assert all(torch.equal(d, p) for d, p in zip(dense, packed, strict=True))


@pytest.mark.parametrize("channels", [4, 6])
def test_compositing_is_deterministic(channels: int) -> None:
    s = scene(3000, 300, 200, channels=channels, backgrounds=torch.rand(1, channels))
    runs = [s.run(absgrad=True) for _ in range(3)]
    for other in runs[1:]:
        assert all(torch.equal(other[name], value) for name, value in runs[0].items())


def test_compositing_skips_indices_out_of_range() -> None:
    s = scene(50)
    offsets, flatten_ids = (t.cuda() for t in s.lists())
    splats = [t.cuda().requires_grad_() for t in (s.means2d, s.conics, s.colors, s.opacities)]
    for wrong in (flatten_ids + 50, flatten_ids - 50):
        image, alphas = rasterize_to_pixels(*splats, s.width, s.height, 16, offsets, wrong)
        image.sum().backward()
        assert not alphas.any()
        assert not splats[0].grad.any()
    beyond = rasterize_to_pixels(*splats, s.width, s.height, 16, offsets + 10**6, flatten_ids)
    assert not beyond[1].any()


def test_compositing_with_strided_inputs_on_side_stream() -> None:
    s = scene(300)
    lists = [t.cuda() for t in s.lists()]
    splats = [t.cuda() for t in (s.means2d, s.conics, s.colors, s.opacities)]
    wanted = rasterize_to_pixels(*splats, s.width, s.height, 16, *lists)
    strided = [t.mT.contiguous().mT if t.ndim == 3 else t for t in splats]
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        seen = rasterize_to_pixels(*strided, s.width, s.height, 16, *lists)
    stream.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(seen, wanted, strict=True))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("limit", [(), (0.999,)], ids=["default", "0.999"])
def test_compositing_ops_pass_opcheck(background: bool, limit: tuple[float, ...]) -> None:
    s = scene(30, 20, 18)
    lists = [t.cuda() for t in s.lists()]
    splats = [t[0].cuda().requires_grad_() for t in (s.means2d, s.conics, s.colors, s.opacities)]
    behind = torch.rand(1, 3, device="cuda", requires_grad=True) if background else None
    masks = torch.ones(1, 2, 2, dtype=torch.bool, device="cuda") if background else None
    probe = torch.zeros(30, 2, device="cuda", requires_grad=True) if background else None
    ops, size = torch.ops.gsplat_core, (s.width, s.height, 16)
    torch.library.opcheck(ops.composite.default, (*splats, *lists, behind, masks, probe, *size, *limit))
    with torch.no_grad():
        plain = [t.detach() for t in splats]
        image, alphas, last = ops.composite(*plain, *lists, behind, masks, None, *size, *limit)
        args = (*plain, *lists, behind, masks, *size, alphas, last, image, alphas, background, *limit)
        torch.library.opcheck(ops.composite_backward.default, args)
