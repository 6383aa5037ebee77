"""Blending along rays: an analytic pixel, the linear projection as its limit, and exact gradients."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.ops.unscented_projection import fully_fused_projection_with_ut
from gsplat_core.ops.world_blending import rasterize_to_pixels_eval3d
from gsplat_core.poses.se3 import RollingShutterType, exp
from gsplat_core.reference.compositing import rasterize_to_pixels
from tests.gsplat_core.ops.test_unscented_projection import DISTORTED, RADIAL, scene

W, H, TILE = 20, 14, 8
GRID = TileGrid(TILE, 3, 2)
KS = torch.tensor([[[16.0, 0, 10.0], [0, 17.0, 7.0], [0, 0, 1]]], dtype=torch.float64)


def lists(given, **camera):
    with torch.no_grad():
        out = fully_fused_projection_with_ut(**given, width=W, height=H, **camera)
        _, ids, offsets = bin_splats(out.means2d.float(), out.radii, out.depths.float(), GRID)
    return out, offsets.reshape(*out.radii.shape[:-2], 2, 3), ids


def small_scene(count: int, size: float = 0.1):
    given = scene(count, size)
    colors = torch.rand(1, count, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return given | {"Ks": KS}, colors


def blend(given, colors, offsets, ids, **more):
    given = given | {"opacities": given["opacities"][None].expand(colors.shape[:-1])}
    return rasterize_to_pixels_eval3d(
        **given,
        colors=colors,
        image_width=W,
        image_height=H,
        tile_size=TILE,
        isect_offsets=offsets,
        flatten_ids=ids,
        **more,
    )


def test_world_blending_of_one_gaussian_in_closed_form():
    given, colors = small_scene(1)
    given |= {
        "means": torch.tensor([[0.1, 0.05, 1.5]], dtype=torch.float64),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
    }
    given["quats"], given["scales"] = torch.tensor([[1.0, 0, 0, 0]]).double(), torch.tensor([[0.2, 0.1, 0.4]]).double()
    _, offsets, ids = lists(given)
    image, alphas = blend(given, colors, offsets, ids, backgrounds=torch.tensor([[0.1, 0.2, 0.3]]).double())
    direction = torch.tensor([(8.5 - 10) / 16, (9.5 - 7) / 17, 1.0], dtype=torch.float64) / given["scales"][0]
    center = given["means"][0] / given["scales"][0]
    squared = (center @ center) - (center @ direction) ** 2 / (direction @ direction)
    alpha = given["opacities"][0] * math.exp(-0.5 * squared)
    torch.testing.assert_close(alphas[0, 9, 8, 0], alpha)
    torch.testing.assert_close(
        image[0, 9, 8], alpha * colors[0, 0] + (1 - alpha) * torch.tensor([0.1, 0.2, 0.3]).double()
    )


def test_world_blending_of_distant_gaussians_equals_image_plane_blending():
    given, colors = small_scene(30)
    given |= {
        "means": given["means"] * 40,
        "scales": given["scales"] * 40 * 0.3,
        "Ks": KS * torch.tensor([[[1.0], [1], [1]]]),
    }
    out, offsets, ids = lists(given, eps2d=0.0)
    image, alphas = blend(given, colors, offsets, ids)
    flat, flat_alphas = rasterize_to_pixels(
        out.means2d, out.conics, colors, given["opacities"][None], W, H, TILE, offsets, ids
    )
    assert alphas.max() > 0.5
    assert (image - flat).abs().max() < 0.05 and (alphas - flat_alphas).abs().mean() < 2e-3


@pytest.mark.parametrize("kind", ["distorted", "rolling"])
def test_world_blending_passes_gradcheck_for_all_tensors(kind):
    given, colors = small_scene(3)
    camera = dict(DISTORTED)
    if kind == "rolling":
        move = exp(torch.tensor([[0.01, 0.02, -0.01, 0.02, 0.01, -0.03]], dtype=torch.float64))
        camera = {"viewmats_rs": move @ given["viewmats"]}
    fixed = {"rolling_shutter": RollingShutterType.ROLLING_LEFT_TO_RIGHT} if kind == "rolling" else {}
    _, offsets, ids = lists(given, **camera, **fixed)
    names = [*given, *camera]
    values = [(given | camera)[name].clone().requires_grad_() for name in names]
    background = torch.rand(1, 3, dtype=torch.float64)

    def run(colors, background, *tensors):
        tensors = dict(zip(names, tensors, strict=True))
        image, alphas = blend(
            {name: tensors[name] for name in given}, colors, offsets, ids, backgrounds=background,
            **{name: tensors[name] for name in camera}, **fixed,
        )  # fmt: skip
        weights = torch.cos(torch.arange(image.numel(), dtype=torch.float64)).view(image.shape)
        return (image * weights).sum() + alphas[..., 0].square().sum()

    torch.autograd.gradcheck(
        run,
        (colors.requires_grad_(), background.requires_grad_(), *values),
        atol=1e-4,
        rtol=1e-3,
        eps=1e-7,
        fast_mode=True,
    )


def test_world_blending_stops_at_low_transmittance_and_masks_tiles(monkeypatch):
    from gsplat_core.ops import world_blending

    given, colors = small_scene(40, size=0.4)
    given["opacities"] = torch.full((40,), 0.9, dtype=torch.float64)
    _, offsets, ids = lists(given)
    image, alphas = blend(given, colors, offsets, ids)
    assert 0.999 < alphas.max() < 1 - 1e-4
    monkeypatch.setattr(world_blending, "PAIRS_AT_A_TIME", 1)
    again = blend(given, colors, offsets, ids)
    torch.testing.assert_close(again[0], image)
    masks = torch.ones(1, 2, 3, dtype=torch.bool)
    masks[0, 1, 2] = False
    background = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
    masked, seen = blend(given, colors, offsets, ids, masks=masks, backgrounds=background)
    assert (seen[0, 8:, 16:] == 0).all() and torch.equal(masked[0, 8:, 16:], background[0].expand(6, 4, 3))
    torch.testing.assert_close(seen[0, :8], alphas[0, :8])


def test_world_blending_pixels_without_ray_show_background():
    given, colors = small_scene(8, size=0.3)
    _, offsets, ids = lists(given)
    radial = RADIAL * 0
    radial[..., 0] = -1.2  # folds over at r = 0.53: the corners have no ray
    image, alphas = blend(given, colors, offsets, ids, radial_coeffs=radial)
    assert (alphas[0, 0, 0] == 0) and alphas[0, 7, 10] > 0 and image.isfinite().all()


def two_pictures(channels, masked):
    """Return inputs of two pictures with long lists, values that are not finite, and pixels without a ray."""
    given, _ = small_scene(60, size=0.15)
    given["opacities"][:20] = 0.995
    colors = torch.rand(2, 60, channels, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    move = exp(torch.tensor([[[0.0] * 6], [[0.1, 0.0, 0.0, 0.02, 0.0, 0.1]]], dtype=torch.float64)[:, 0])
    given |= {"viewmats": move @ given["viewmats"], "Ks": KS.expand(2, 3, 3)}
    _, offsets, ids = lists(given)
    radial = RADIAL.expand(2, 6) * 0
    radial[1, 0] = -1.2  # the corners of the second picture have no ray
    masks = torch.rand(2, 2, 3, generator=torch.Generator().manual_seed(1)) > (0.4 if masked else -1.0)
    return given, colors, offsets, ids, {"masks": masks, "radial_coeffs": radial}


def cast(values, dtype):
    return {name: each.to(dtype) if each.is_floating_point() else each for name, each in values.items()}


@pytest.mark.parametrize("channels", [1, 3, 11])
@pytest.mark.parametrize("masked", [False, True])
def test_world_blending_equals_reference(channels, masked):
    given, colors, offsets, ids, more = two_pictures(channels, masked)
    colors[0, 5, 0], given["means"][7, 1] = math.nan, math.inf
    given["quats"][9] = math.nan
    results = []
    for dtype in (torch.float64, torch.float32):
        image, alphas = blend(cast(given, dtype), colors.to(dtype), offsets, ids, **cast(more, dtype))
        results.append((image.double(), alphas.double()))
    (expected, expected_alphas), (found, alphas) = results
    assert expected_alphas.max() > 0.99 and (expected_alphas == 0).any()
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-3)
    torch.testing.assert_close(alphas, expected_alphas, rtol=0, atol=2e-3)
    assert (found - expected).abs().mean() < 2e-5


def gradients(given, colors, offsets, ids, more, dtype, device="cpu"):
    """Return the gradients by name of a function of both results, in float64 on the CPU."""
    values = {name: each.to(device) for name, each in cast({**given, "colors": colors, **more}, dtype).items()}
    leaves = {name: each.clone().requires_grad_() for name, each in values.items() if each.is_floating_point()}
    values |= leaves
    own = {name: values[name] for name in given}
    more = {name: values[name] for name in more}
    image, alphas = blend(own, values["colors"], offsets.to(device), ids.to(device), **more)
    weights = torch.cos(torch.arange(image.numel(), dtype=torch.float64)).view(image.shape).to(image)
    ((image * weights).sum() + alphas[..., 0].square().sum()).backward()
    return {name: leaf.grad.double().cpu() for name, leaf in leaves.items()}


@pytest.mark.parametrize(("channels", "masked"), [(1, False), (3, True), (19, False)])
def test_world_blending_gradients_equal_reference(channels, masked):
    inputs = two_pictures(channels, masked)
    expected, found = gradients(*inputs, torch.float64), gradients(*inputs, torch.float32)
    for name, wanted in expected.items():
        # A pixel at the cut-off of alpha or transmittance may change sides between the precisions.
        scale = wanted.abs().max()
        assert scale > 0 and (found[name] - wanted).abs().mean() < 2e-4 * scale, name
        assert (found[name] - wanted).abs().max() < 0.05 * scale, name


def test_world_blending_non_finite_gaussians_have_no_gradient():
    given, colors, offsets, ids, more = two_pictures(3, False)
    hidden = {**given, "opacities": given["opacities"].clone()}
    hidden["opacities"][3] = 0
    expected = gradients(hidden, colors, offsets, ids, more, torch.float32)
    colors[:, 3, 1] = math.nan
    found = gradients(given, colors, offsets, ids, more, torch.float32)
    assert torch.equal(found["means"], expected["means"]) and (found["opacities"][3] == 0)
    assert (found["colors"][:, 3] == 0).all() and (expected["means"][3] == 0).all()


@pytest.mark.parametrize("threads", [1, 3])
def test_world_blending_gradients_independent_of_thread_count(threads):
    inputs = two_pictures(3, False)
    before = torch.get_num_threads()
    expected = gradients(*inputs, torch.float32)
    try:
        torch.set_num_threads(threads)
        found = gradients(*inputs, torch.float32)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(found[name], expected[name]) for name in ("means", "quats", "scales", "colors", "opacities"))


def test_world_blending_op_rejects_lists_out_of_range():
    given, colors = small_scene(3)
    _, offsets, ids = lists(given)
    single = {name: value.float() for name, value in given.items()}
    with pytest.raises(RuntimeError, match="flatten_ids must be in"):
        blend(single, colors.float(), offsets, ids + 3)
    with pytest.raises(RuntimeError, match="must rise"):
        blend(single, colors.float(), offsets + len(ids) + 1, ids)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # read by opcheck itself
def test_world_blending_ops_pass_opcheck():

    given, colors = small_scene(5)
    _, offsets, ids = lists(given)
    floats = (torch.rand(1, 5, 12), colors.float(), given["opacities"].float()[None], torch.rand(1, H, W, 6))
    rest = (offsets, ids, None, TILE, 0.99)
    op = torch.ops.gsplat_core
    torch.library.opcheck(op.blend_world.default, (*(each.clone().requires_grad_() for each in floats), *rest))
    image, through, last = op.blend_world(*floats, *rest)
    results = (through, last, torch.rand_like(image), torch.rand_like(through))
    torch.library.opcheck(op.blend_world_backward.default, (*floats, *rest, *results))


def test_world_blending_without_gaussians():
    given, colors = small_scene(1)
    none = {name: value[:0] if name not in ("viewmats", "Ks") else value for name, value in given.items()}
    empty = torch.zeros(0, dtype=torch.int32)
    image, alphas = blend(none, colors[:, :0], torch.zeros(1, 2, 3, dtype=torch.int32), empty)
    assert image.shape == (1, H, W, 3) and (image == 0).all() and (alphas == 0).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"max_alpha": 1.0}, "max_alpha"),
        ({"masks": torch.ones(1, 1, 1, dtype=torch.bool)}, "masks"),
        ({"backgrounds": torch.zeros(1, 2).double()}, "backgrounds"),
        ({"camera_model": "fisheye", "radial_coeffs": RADIAL}, "radial_coeffs"),
    ],
)
def test_world_blending_rejects_invalid_arguments(options, words):
    given, colors = small_scene(2)
    _, offsets, ids = lists(given)
    with pytest.raises(InvalidInput, match=words):
        blend(given, colors, offsets, ids, **options)
