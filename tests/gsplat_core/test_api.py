"""`rasterization` as gsplat 1.5.3's users know it: modes, shapes, meta, absgrad, and what is refused."""

from __future__ import annotations

import enum
import math
import pickle

import pytest
import torch

import gsplat_core as gsplat
from gsplat_core import InvalidInput, reference

META = [
    "batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "tile_width",
    "tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size",
    "n_batches", "n_cameras",
]  # fmt: skip


def rasterize(scene, module=gsplat, **changes):
    arguments = dict(
        means=scene.means, quats=scene.quats, scales=scene.scales, opacities=scene.opacities, colors=scene.sh,
        viewmats=scene.viewmats, Ks=scene.Ks, width=scene.width, height=scene.height, sh_degree=3,
    )  # fmt: skip
    return module.rasterization(**(arguments | changes))


@pytest.fixture
def scene(make_scene):
    return make_scene(50, cameras=2).to(torch.float32)


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("D", 1), ("ED", 1), ("RGB+D", 4), ("RGB+ED", 4)])
@pytest.mark.parametrize("packed", [False, True])
def test_rasterization_render_modes(scene, mode, channels, packed):
    image, alpha, _ = rasterize(scene, render_mode=mode, packed=packed)
    assert image.shape == (2, 37, 52, channels) and alpha.shape == (2, 37, 52, 1)
    rgb, depth = rasterize(scene, render_mode="RGB")[0], rasterize(scene, render_mode="D")[0]
    if mode.startswith("RGB"):
        torch.testing.assert_close(image[..., :3], rgb)
    if mode.endswith("ED"):
        depth = depth / alpha.clamp(min=1e-10)
    if mode.endswith("D"):
        torch.testing.assert_close(image[..., -1:], depth)


@pytest.mark.parametrize("mode", ["RGB+D", "RGB+ED", "RGB-d", "RGB-Ed"])
@pytest.mark.parametrize(
    "changes", [{}, {"packed": True}, {"with_ut": True}, {"with_ut": True, "with_eval3d": True}], ids=str
)
def test_rasterization_colors_without_channels_give_depth_only(scene, mode, changes):
    """Programs concatenate the features that a caller asks for, which may be none."""
    if "with_eval3d" in changes and mode.startswith("RGB-"):
        with pytest.raises(NotImplementedError, match="leave with_eval3d out"):
            rasterize(scene, **changes, render_mode=mode)
        return
    options = {"sh_degree": None, "packed": False, **changes}
    means = scene.means.clone().requires_grad_()
    empty = dict(means=means, colors=torch.zeros(50, 0), backgrounds=torch.zeros(2, 0))
    image, alphas, _ = rasterize(scene, **options, **empty, render_mode=mode)
    expected, expected_alphas, _ = rasterize(scene, **options, colors=None, render_mode=mode[4:])
    assert image.shape == (2, 37, 52, 1)
    torch.testing.assert_close(image, expected)
    torch.testing.assert_close(alphas, expected_alphas)
    image.sum().backward()
    assert means.grad.isfinite().all() and means.grad.any()


@pytest.mark.parametrize("count", [1, 3, 7, 40])
@pytest.mark.parametrize("per_camera", [False, True])
def test_rasterization_plain_colors_with_any_number_of_channels(scene, count, per_camera):
    g = torch.Generator().manual_seed(1)
    colors = torch.rand(*((2,) if per_camera else ()), 50, count, generator=g)
    background = torch.rand(2, count, generator=g)
    image, alpha, _ = rasterize(scene, colors=colors, sh_degree=None, backgrounds=background)
    assert image.shape[-1] == count
    # Each channel by itself is the same picture.
    one, _, _ = rasterize(scene, colors=colors[..., -1:], sh_degree=None, backgrounds=background[:, -1:])
    torch.testing.assert_close(image[..., -1:], one)
    empty = alpha[..., 0] == 0
    assert empty.any()
    torch.testing.assert_close(image[empty], background[:, None, None].expand(2, 37, 52, count)[empty])


@pytest.mark.parametrize("degree", range(5))
def test_rasterization_sh_degrees_up_to_coefficients(make_scene, degree, assert_near):
    scene = make_scene(30, degree=4)
    image, _, _ = rasterize(scene.to(torch.float32), sh_degree=degree)
    exact, _, _ = rasterize(scene.to(torch.float64), reference, sh_degree=degree)
    assert_near(image, exact, of_largest=1e-4)


def test_rasterization_coefficients_per_camera(scene):
    shared, _, _ = rasterize(scene)
    own, _, _ = rasterize(scene, colors=scene.sh.expand(2, -1, -1, -1))
    torch.testing.assert_close(own, shared, rtol=0, atol=0)


def test_rasterization_covars_give_same_image(scene):
    covars, _ = gsplat.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False)
    image, _, _ = rasterize(scene, quats=None, scales=None, covars=covars)
    torch.testing.assert_close(image, rasterize(scene)[0], rtol=1e-3, atol=1e-4)


def test_rasterization_batches_and_cameras_are_separate_images(make_scene):
    scene = make_scene(30, (2, 2), 3).to(torch.float32)
    background = torch.rand(2, 2, 3, 3)
    together, alpha, meta = rasterize(scene, packed=False, backgrounds=background)
    assert together.shape == (2, 2, 3, 37, 52, 3) and alpha.shape == (2, 2, 3, 37, 52, 1)
    assert meta["n_batches"] == 4 and meta["n_cameras"] == 3
    alone, _, _ = gsplat.rasterization(
        scene.means[1, 0], scene.quats[1, 0], scene.scales[1, 0], scene.opacities[1, 0], scene.sh[1, 0],
        scene.viewmats[1, 0, 2:], scene.Ks[1, 0, 2:], 52, 37, sh_degree=3, backgrounds=background[1, 0, 2:],
    )  # fmt: skip
    torch.testing.assert_close(together[1, 0, 2], alone[0], rtol=0, atol=0)


@pytest.mark.parametrize("tile_size", [4, 8, 16, 32, None])
def test_rasterization_tile_size_does_not_change_image(scene, tile_size):
    image, _, meta = rasterize(scene, tile_size=tile_size, packed=False)
    size = tile_size or 16
    assert meta["tile_size"] == size
    assert meta["isect_offsets"].shape == (2, math.ceil(37 / size), math.ceil(52 / size))
    torch.testing.assert_close(image, rasterize(scene)[0], rtol=1e-4, atol=1e-5)


def test_rasterization_meta_dense(scene):
    _, _, meta = rasterize(scene, packed=False)
    assert list(meta) == META
    assert all(meta[name] is None for name in META[:3])
    assert meta["radii"].shape == meta["means2d"].shape == (2, 50, 2) and meta["radii"].dtype == torch.int32
    assert meta["depths"].shape == meta["opacities"].shape == meta["tiles_per_gauss"].shape == (2, 50)
    assert meta["conics"].shape == (2, 50, 3)
    assert (meta["width"], meta["height"], meta["tile_width"], meta["tile_height"]) == (52, 37, 4, 3)
    again = gsplat.isect_offset_encode(meta["isect_ids"], 2, 4, 3)
    torch.testing.assert_close(again, meta["isect_offsets"])
    assert len(meta["isect_ids"]) == len(meta["flatten_ids"]) == meta["tiles_per_gauss"].sum()
    # image | tile | depth: as gsplat's own key, entry by entry.
    tiles = torch.repeat_interleave(
        torch.arange(24), torch.diff(meta["isect_offsets"].flatten(), append=torch.tensor([len(meta["isect_ids"])]))
    )
    bits = meta["depths"].flatten()[meta["flatten_ids"]].view(torch.int32).long()
    assert torch.equal(meta["isect_ids"], (tiles // 12) << 36 | (tiles % 12) << 32 | bits)
    assert torch.equal(meta["isect_ids"], meta["isect_ids"].sort().values)


def test_rasterization_meta_is_picklable_pytree_dict(scene):
    with torch.no_grad():
        _, _, meta = rasterize(scene, packed=False)
    assert type(meta) is dict
    leaves, spec = torch.utils._pytree.tree_flatten(meta)
    assert torch.utils._pytree.tree_unflatten(leaves, spec)["means2d"] is meta["means2d"]
    again = pickle.loads(pickle.dumps(meta))
    assert list(again) == META
    assert torch.equal(again["isect_ids"], meta["isect_ids"])


def test_rasterization_accepts_all_arguments_by_position(scene):
    given = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, scene.viewmats, scene.Ks, 52, 37)
    given += (0.01, 1e10, 0.0, 0.3, 3, False, 16, None, "RGB+ED", False, False, "antialiased", 32, False, "pinhole")
    image, alpha, _ = gsplat.rasterization(*given)
    wanted = rasterize(scene, packed=False, render_mode="RGB+ED", rasterize_mode="antialiased")
    assert torch.equal(image, wanted[0])
    assert torch.equal(alpha, wanted[1])


def test_rasterization_meta_packed_has_visible_rows(scene):
    dense, packed = rasterize(scene, packed=False)[2], rasterize(scene)[2]
    seen = dense["radii"][..., 0] > 0
    assert list(packed) == META
    rows = (packed["camera_ids"], packed["gaussian_ids"])
    assert (packed["batch_ids"] == 0).all()
    for name in ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss"):
        torch.testing.assert_close(packed[name], dense[name][rows], rtol=0, atol=0)
        assert packed[name].shape[0] == seen.sum()


@pytest.mark.parametrize("packed", [False, True])
def test_rasterization_absgrad_not_below_gradient_magnitude(scene, packed):
    scene.means.requires_grad_()
    image, _, meta = rasterize(scene, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    (image * torch.rand(image.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
    absolute, plain = meta["means2d"].absgrad, meta["means2d"].grad
    assert absolute.shape == plain.shape == meta["means2d"].shape
    # Of the same terms: the absolute values sum to at least the absolute value of the sum, mostly to more.
    assert (absolute >= plain.abs() * (1 - 1e-4) - 1e-6).all() and absolute.sum() > 1.2 * plain.abs().sum()


@pytest.mark.slow
def test_rasterization_absgrad_matches_reference(make_scene, assert_near):
    def absolute(module, dtype):
        scene = make_scene(30).to(dtype)
        scene.means.requires_grad_()
        image, _, meta = rasterize(scene, module, packed=False, absgrad=True)
        (image**2).sum().backward()
        return meta["means2d"].absgrad

    assert_near(absolute(gsplat, torch.float32), absolute(reference, torch.float64), relative=1e-2, of_largest=1e-3)


def test_rasterization_antialiasing_dims_sub_pixel_gaussians(make_scene):
    scene = make_scene(20).to(torch.float32)
    scene.scales.fill_(0.01)
    classic, aliased = (rasterize(scene, rasterize_mode=mode, packed=False) for mode in ("classic", "antialiased"))
    assert aliased[1].sum() < 0.2 * classic[1].sum()
    assert (aliased[2]["opacities"] < scene.opacities).all()


@pytest.mark.parametrize(
    ("what", "value"),
    [
        ("means", math.nan),
        ("scales", math.inf),
        ("quats", math.nan),
        ("opacities", math.nan),
        ("sh", math.nan),
        ("sh", math.inf),
    ],
)
@pytest.mark.parametrize("module", [gsplat, reference])
def test_rasterization_invalid_gaussian_does_not_affect_others(make_scene, what, value, module):
    scene = make_scene(30)
    scene = scene.to(torch.float32)
    scene.means[3] = torch.tensor([0.0, 0.0, 5.0])
    without = scene.to(torch.float32)
    without.opacities[3] = 0
    getattr(scene, what)[3] = value
    results = []
    for it in (scene, without):
        leaves = it.leaves()
        image, alpha, meta = rasterize(it, module, render_mode="RGB+ED", packed=False)
        (image.sum() + alpha.sum()).backward()
        results.append((image, alpha, [leaf.grad for leaf in leaves], meta["radii"]))
    assert results[0][3][0, 3].tolist() == [0, 0]
    for actual, wanted in zip(results[0][:2], results[1][:2], strict=True):
        torch.testing.assert_close(actual, wanted)
    for actual, wanted in zip(results[0][2][:5], results[1][2][:5], strict=True):
        assert (actual[3] == 0).all()
        torch.testing.assert_close(actual, wanted)
    assert results[0][2][5].isfinite().all()


@pytest.mark.parametrize("module", [gsplat, reference])
@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_rasterization_culls_gaussian_with_infinite_coefficient(make_scene, module, value):
    scene = make_scene(10).to(torch.float32)
    scene.sh[0, 0] = value  # the sum is infinite, of this sign
    _, _, meta = rasterize(scene, module, packed=False)
    assert meta["radii"][0, 0].tolist() == [0, 0]


def test_rasterization_culls_non_finite_plain_colors(scene):
    colors = torch.rand(50, 3)
    colors[4, 1] = math.nan
    image, _, meta = rasterize(scene, colors=colors, sh_degree=None, packed=False)
    assert image.isfinite().all() and (meta["radii"][:, 4] == 0).all()


class Shutter(enum.Enum):
    """gsplat's names."""

    ROLLING_TOP_TO_BOTTOM = 0
    GLOBAL = 4


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("camera_model", "ftheta"), ("camera_model", "lidar"),
    ],
)  # fmt: skip
def test_rasterization_unsupported_argument_error_names_value(scene, argument, value):
    shown = r"\[2, " if isinstance(value, torch.Tensor) else str(value).split(" at ")[0].replace("<", "")
    with pytest.raises(NotImplementedError, match=f"{argument}.*{shown}"):
        rasterize(scene, **{argument: value})


def test_rasterization_accepts_options_without_effect(scene):
    image, _, _ = rasterize(scene, segmented=True, channel_chunk=2, rolling_shutter=Shutter.GLOBAL, with_ut=False)
    torch.testing.assert_close(image, rasterize(scene)[0], rtol=0, atol=0)


def test_rasterization_rejects_invalid_arguments(scene):
    for changes, message in [
        ({"means": scene.means[:, :2]}, r"means must be \[..., N, 3\], got \[50, 2\]"),
        ({"quats": scene.quats[:9]}, r"quats .*\[50, 4\], got \[9, 4\]"),
        ({"scales": None}, "quats and scales"),
        ({"opacities": scene.opacities[:, None]}, r"opacities .*got \[50, 1\]"),
        ({"colors": scene.sh[:9]}, r"colors must be .*N = 50.*got \[9, 16, 3\]"),
        ({"colors": scene.sh, "sh_degree": 4}, r"K >= 25 for degree 4, got"),
        ({"sh_degree": 5}, "sh_degree .*got 5"),
        ({"sh_degree": None, "colors": scene.sh[:, :0, 0]}, "at least one channel"),
        ({"colors": scene.sh[..., :0], "render_mode": "RGB+D"}, r"coeffs .*16, 0\]"),
        ({"viewmats": scene.viewmats[0, 0]}, r"viewmats must be \[..., C, 4, 4\]"),
        ({"Ks": scene.Ks[:1]}, r"Ks .*\[2, 3, 3\], got \[1, 3, 3\]"),
        ({"covars": torch.zeros(50, 6)}, r"covars .*3, 3\], got \[50, 6\]"),
        ({"backgrounds": torch.zeros(3)}, r"backgrounds .*\[2, 3\], got \[3\]"),
        ({"render_mode": "RGBD"}, r"render_mode 'RGBD'.*RGB\+ED"),
        ({"rasterize_mode": "smooth"}, "'smooth'"),
        ({"camera_model": "mirror"}, "'mirror'"),
        ({"constants": "1.5"}, r"unknown constants '1.5'; the versions are 1\.6, 1\.5\.3"),
        ({"tile_size": 0}, "tile_size .*got 0"),
        ({"height": 0}, "height .*got 0"),
        ({"colors": scene.sh.double()}, "colors: torch.float64"),
        (dict(zip(("colors", "backgrounds"), (scene.sh, torch.zeros(2, 3).double()), strict=True)), "float64"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            rasterize(scene, **changes)
    with pytest.raises(InvalidInput, match=r"float32, got torch.float64.*gsplat_core\.reference"):
        rasterize(scene.to(torch.float64))
