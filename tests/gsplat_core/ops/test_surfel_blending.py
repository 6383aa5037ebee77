"""The compiled blending of surfels, forward and backward, against plain torch in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.surfel_blending import rasterize_to_pixels_2dgs
from gsplat_core.reference import surfels as reference
from tests.gsplat_core.ops.surfel_scenes import BLENDED, INPUTS, BlendScene, blend_scene, close, surfel_scene


def assert_close(scene: BlendScene, *, absgrad: bool = False, max_alpha: float = 0.99) -> dict[str, torch.Tensor]:
    seen = scene.run(absgrad=absgrad, max_alpha=max_alpha)
    close(seen, scene.run(torch.float64, absgrad=absgrad, max_alpha=max_alpha), 5e-4)
    return seen


@pytest.mark.parametrize("channels", [1, 2, 3, 5, 9, 16, 35])
def test_surfel_blending_with_any_number_of_channels(channels: int) -> None:
    s = surfel_scene(25, 18, 10, channels=channels)
    assert_close(blend_scene(s, backgrounds=torch.rand(1, channels, dtype=torch.float64)), absgrad=channels <= 16)


@pytest.mark.parametrize(("tile_size", "size"), [(4, (9, 7)), (16, (1, 1)), (20, (33, 20)), (33, (20, 40))])
def test_surfel_blending_with_any_tile_and_image_size(tile_size: int, size: tuple[int, int]) -> None:
    s = surfel_scene(25, *size)
    assert_close(blend_scene(s, tile_size=tile_size, backgrounds=torch.rand(1, 4, dtype=torch.float64)))


@pytest.mark.parametrize(("batch", "cameras"), [((), 3), ((2,), 2), ((0,), 1)])
def test_surfel_blending_with_leading_dimensions(batch: tuple[int, ...], cameras: int) -> None:
    s = blend_scene(surfel_scene(20, 17, 10, batch=batch, cameras=cameras))
    seen = assert_close(s) if 0 not in batch else s.run()
    for name, size in zip(BLENDED, (4, 1, 3, 1, 1), strict=True):
        assert seen[name].shape == (*batch, cameras, 10, 17, size)


def test_surfel_blending_without_surfels() -> None:
    assert_close(blend_scene(surfel_scene(0)))


def test_surfel_blending_of_opaque_surfels_stops_pixel() -> None:
    s = surfel_scene(100, 16, 16, scale=0.5)
    s.opacities[::2] = 1.0
    for max_alpha in (0.99, 0.999):
        assert assert_close(blend_scene(s), max_alpha=max_alpha)["alphas"].max() > 0.999


def test_surfel_blending_masked_tiles_show_background_only() -> None:
    s = surfel_scene(40, 40, 20)
    masks = torch.tensor([[[True, False, True], [False, True, True]]])
    seen = assert_close(blend_scene(s, masks=masks, backgrounds=torch.rand(1, 4, dtype=torch.float64)))
    assert not seen["alphas"][0, :16, 16:32].any()


def test_surfel_blending_distortion_of_distant_depths() -> None:
    s = blend_scene(surfel_scene(60))
    s.colors[..., -1] = (1000 + s.colors[..., -1]).float().double()
    assert_close(s)


def test_surfel_blending_of_two_surfels_in_closed_form() -> None:
    # Surfels that face the camera, hit in their centres: weights 0.6 and 0.4 * 0.5, depths 2 and 3.
    alphas, depths = torch.tensor([0.6, 0.5]), torch.tensor([2.0, 3.0])
    transforms = torch.zeros(1, 2, 3, 3)
    transforms[0, :, 0, 0] = transforms[0, :, 1, 1] = 100.0
    transforms[0, :, 2, 2] = depths
    transforms[0, :, :2, 2] = 0.5 * depths[:, None]  # the centre of the first pixel
    lists = torch.zeros(1, 1, 1, dtype=torch.int32), torch.arange(2, dtype=torch.int32)
    image, alpha, normals, distortion, median = rasterize_to_pixels_2dgs(
        torch.full((1, 2, 2), 0.5), transforms, depths.reshape(1, 2, 1), alphas[None],
        torch.tensor([[[0.0, 0.0, -1.0], [0.0, 0.6, -0.8]]]), torch.zeros(1, 2, 2), 1, 1, 16, *lists,
    )  # fmt: skip
    assert image.item() == pytest.approx(0.6 * 2 + 0.2 * 3, rel=1e-5)
    assert alpha.item() == pytest.approx(0.8, rel=1e-5)
    torch.testing.assert_close(normals.flatten(), torch.tensor([0.0, 0.12, -0.76]), rtol=1e-5, atol=1e-6)
    assert distortion.item() == pytest.approx(2 * 0.6 * 0.2 * (3 - 2), rel=1e-5)
    assert median.item() == 2.0  # in front of the second the transmittance is 0.4


def test_surfel_blending_of_thin_tiny_and_very_large_surfels() -> None:
    s = surfel_scene(60, 40, 33, scale=0.2)
    s.scales[::3, 0] = 0.002
    s.scales[1::6] = 0.001
    s.scales[2::7] = 1.5  # extend behind the camera
    assert_close(blend_scene(s))


def test_surfel_blending_of_edge_on_surfels_keeps_pixel_size() -> None:
    s = surfel_scene(40)
    s.quats[:] = torch.tensor([math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 2e-3])
    seen = blend_scene(s).run()
    assert all(value.isfinite().all() for value in seen.values())
    assert seen["alphas"].max() > 0.3
    # A ray transform of rank 1: every ray is parallel to the surfel.
    flat = blend_scene(s)
    flat.ray_transforms[..., 0] = 0
    flat.ray_transforms[..., 1] = 0
    seen = assert_close(flat)
    assert not seen["alphas"].any()


def test_surfel_blending_skips_non_finite_surfels_without_gradient() -> None:
    s = blend_scene(surfel_scene(60))
    bad = torch.zeros(60, dtype=torch.bool)
    for row, value in enumerate((math.nan, math.inf, -math.inf)):
        s.means2d[0, 5 * row, 1] = s.ray_transforms[0, 5 * row + 1, 2, 0] = s.colors[0, 5 * row + 2, 0] = value
        s.normals[0, 5 * row + 3, 2] = s.opacities[0, 5 * row + 4] = value
    bad[:15] = True
    # The lists were made of finite values.
    lists = blend_scene(surfel_scene(60)).lists()
    seen = s.run(lists=lists)
    keep = {name: getattr(s, name)[:, ~bad] for name in (*INPUTS, "radii", "depths")}
    wanted = replace(s, **keep).run()
    for name in BLENDED:
        torch.testing.assert_close(seen[name], wanted[name], rtol=1e-5, atol=1e-5)
    for name in INPUTS:
        assert not seen[f"v_{name}"][:, bad].any(), name
        assert seen[f"v_{name}"].isfinite().all(), name


def test_surfel_blending_independent_of_thread_count() -> None:
    s = blend_scene(surfel_scene(150, 70, 50))
    first = s.run(absgrad=True)
    torch.set_num_threads(1)
    try:
        second = s.run(absgrad=True)
    finally:
        torch.set_num_threads(2)
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


def test_surfel_blending_reference_passes_gradcheck() -> None:
    s = blend_scene(surfel_scene(3, 3, 2, scale=0.4, channels=2))
    offsets, ids = s.lists()

    def function(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return reference.rasterize_to_pixels_2dgs(*inputs, s.densify, s.width, s.height, s.tile_size, offsets, ids)

    inputs = [getattr(s, name).clone().requires_grad_() for name in INPUTS[:-1]]
    assert torch.autograd.gradcheck(function, inputs, fast_mode=True)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # read by opcheck itself
def test_surfel_blending_ops_pass_opcheck() -> None:
    s = blend_scene(surfel_scene(20, 20, 18))
    offsets, ids = s.lists()
    flat = {name: value.detach()[0] for name, value in s.to(torch.float32).items()}
    leaves = [value.clone().requires_grad_() for value in flat.values()]
    background, size = torch.rand(1, 4), (s.width, s.height, s.tile_size)
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.blend_surfels.default, (*leaves, offsets, ids, background, None, None, *size))
    *tensors, _ = flat.values()
    image, alphas, normals, distortions, medians, depth_sums, last, at = ops.blend_surfels(
        *flat.values(), offsets, ids, background, None, None, *size
    )
    results = (alphas, depth_sums, last, at, image, alphas, normals, distortions, medians, True)
    torch.library.opcheck(
        ops.blend_surfels_backward.default, (*tensors, offsets, ids, background, None, *size, *results)
    )


def test_surfel_blending_rejects_invalid_arguments() -> None:
    s = blend_scene(surfel_scene(6, 20, 18))
    inputs, lists = {name: value.detach() for name, value in s.to(torch.float32).items()}, s.lists()
    rest = (s.width, s.height, s.tile_size, *lists)
    for name, value, message in (
        ("means2d", inputs["means2d"][:, :5], "means2d must have shape"),
        ("ray_transforms", inputs["ray_transforms"][..., :2], "ray_transforms must have shape"),
        ("colors", inputs["colors"][..., :0], "at least one channel"),
        ("normals", inputs["normals"].double(), "normals must be float32"),
    ):
        with pytest.raises(InvalidInput, match=message):
            rasterize_to_pixels_2dgs(*(inputs | {name: value}).values(), *rest)
    with pytest.raises(InvalidInput, match="do not cover"):
        rasterize_to_pixels_2dgs(*inputs.values(), 1000, 18, 16, *lists)
    with pytest.raises(InvalidInput, match="max_alpha"):
        rasterize_to_pixels_2dgs(*inputs.values(), *rest, max_alpha=1.0)
    with pytest.raises(RuntimeError, match="flatten_ids"):
        rasterize_to_pixels_2dgs(*inputs.values(), *rest[:3], lists[0], lists[1] + 100)
