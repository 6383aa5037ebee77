"""Rendering of surfels: a plane whose depth and normal are known exactly, and consistency of the options of `rasterization_2dgs`."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import gsplat_core
from gsplat_core import InvalidInput, rasterization_2dgs, rasterization_2dgs_inria_wrapper
from tests.gsplat_core.ops.surfel_scenes import blend_scene, surfel_scene

WIDTH, HEIGHT, FOCAL = 45, 37, 50.0


def intrinsics() -> Tensor:
    return torch.tensor([[[FOCAL, 0, WIDTH / 2 + 0.4], [0, FOCAL, HEIGHT / 2 - 0.3], [0, 0, 1]]])


def wall(tilt_deg: float, distance: float = 40.0, spacing: float = 1.0) -> dict[str, Tensor]:
    """Surfels on a plane through (0, 0, distance), turned round y: its far side is on the right."""
    angle = math.radians(tilt_deg)
    a, b = torch.meshgrid(torch.arange(-75.0, 76, spacing), torch.arange(-42.0, 43, spacing), indexing="xy")
    a, b = a.ravel(), b.ravel()
    means = torch.stack([a * math.cos(angle), b, distance + a * math.sin(angle)], 1)
    quats = torch.tensor([math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]).repeat(len(means), 1)
    return {
        "means": means,
        "quats": quats,
        "scales": torch.tensor([spacing, spacing, 1.0]).repeat(len(means), 1),
        "opacities": torch.full((len(means),), 0.9),
        "colors": torch.rand(len(means), 3),
    }


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, -40.0])
def test_surfel_plane_depth_and_normal(tilt_deg: float) -> None:
    # A camera that is turned round z and shifted, so that the normals' axes are those of the world.
    turn = math.radians(25)
    pose = torch.eye(4)
    pose[:2, :2] = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    pose[:3, 3] = torch.tensor([0.5, -0.4, 1.0])
    K = intrinsics()
    colors, alphas, normals, from_depth, _, medians, _ = rasterization_2dgs(
        **wall(tilt_deg), viewmats=pose[None], Ks=K, width=WIDTH, height=HEIGHT, render_mode="RGB+ED"
    )
    angle = math.radians(tilt_deg)
    normal = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
    x = (torch.arange(WIDTH) + 0.5 - K[0, 0, 2]) / FOCAL
    y = (torch.arange(HEIGHT) + 0.5 - K[0, 1, 2]) / FOCAL
    rays = torch.stack([x.expand(HEIGHT, -1), y[:, None].expand(-1, WIDTH), torch.ones(HEIGHT, WIDTH)], -1)
    rays_world, center = rays @ pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    depth = ((torch.tensor([0.0, 0.0, 40.0]) - center) @ normal) / (rays_world @ normal)
    assert alphas.min() > 0.99
    # Depths are those of the surfels' centres, which are up to some standard deviations of 1 away, mostly in front.
    assert (colors[0, ..., 3] / depth - 1).abs().max() < 1e-3 + 0.06 * abs(math.tan(angle))
    assert (medians[0, ..., 0] / depth - 1).abs().max() < 1e-3 + 0.08 * abs(math.tan(angle))
    unit = torch.nn.functional.normalize(normals[0], dim=-1)
    torch.testing.assert_close(unit, normal.expand_as(unit), rtol=0, atol=1e-4)
    assert from_depth is not None
    cosines = (from_depth[1:-1, 1:-1] @ normal).abs()
    assert cosines.mean() > math.cos(math.radians(3))


def test_surfel_plane_depth_error_proportional_to_surfel_size() -> None:
    exact = 40.0 / (1 - math.tan(math.radians(35)) * ((torch.arange(9) + 0.5 - 4.5) / 300))
    K = torch.tensor([[[300.0, 0, 4.5], [0, 300, 2.5], [0, 0, 1]]])
    errors = []
    for spacing in (1.0, 0.5):
        plane = wall(35.0, spacing=spacing)
        near = (plane["means"][:, :2].abs() < 8).all(-1)
        image, *_ = rasterization_2dgs(
            **{name: value[near] for name, value in plane.items()}, viewmats=torch.eye(4)[None], Ks=K, width=9, height=5,
            render_mode="ED",
        )  # fmt: skip
        errors.append(float((image.detach()[0, ..., 0] - exact).abs().mean()))
    assert 1.7 < errors[0] / errors[1] < 2.3


def scene(**options: Any) -> dict[str, Any]:
    s = surfel_scene(60, 40, 33, **options)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    tensors = {name: getattr(s, name).float() for name in names}
    return {**tensors, "colors": tensors["colors"][..., :3].contiguous(), "width": s.width, "height": s.height}


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_surfel_render_modes_agree(mode: str) -> None:
    s = scene(cameras=2)
    whole, alphas, normals, surface, *_ = rasterization_2dgs(**s, render_mode="RGB+D")
    image, seen_alphas, seen_normals, seen_surface, _, _, meta = rasterization_2dgs(**s, render_mode=mode)
    expected = whole[..., :3] if mode.startswith("RGB") else whole[..., :0]
    if mode != "RGB":
        depth = whole[..., 3:]
        expected = torch.cat([expected, depth / alphas.clamp(min=1e-10) if "E" in mode else depth], -1)
    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(seen_alphas, alphas)
    torch.testing.assert_close(seen_normals, normals)
    assert (seen_surface is None) == (mode in ("RGB", "D", "ED"))
    assert surface is not None and surface.shape == (2, 33, 40, 3)
    assert meta["camera_ids"] is None and meta["n_cameras"] == 2
    assert {"means2d", "ray_transforms", "gradient_2dgs", "isect_ids", "render_distort", "tile_width"} <= meta.keys()


@pytest.mark.parametrize("packed", [False, True])
def test_surfel_colors_without_channels_give_depth_only(packed: bool) -> None:
    s = scene(cameras=2)
    options: dict[str, Any] = {"render_mode": "RGB+ED", "packed": packed}
    expected = rasterization_2dgs(**s, **options)
    empty = {"colors": s["colors"][..., :0], "backgrounds": torch.zeros(2, 0)}
    found = rasterization_2dgs(**{**s, **empty}, **options)
    torch.testing.assert_close(found[0], expected[0][..., 3:])
    torch.testing.assert_close(found[3], expected[3])
    with pytest.raises(InvalidInput, match="at least one channel"):
        rasterization_2dgs(**{**s, **empty}, packed=packed)


def test_surfel_packed_and_sparse_gradients_equal_dense() -> None:
    s = scene(cameras=2)
    s["means"][:20, 2] -= 4
    results = []
    for options in ({}, {"packed": True}, {"packed": True, "sparse_grad": True}):
        inputs = {
            name: s[name].clone().requires_grad_() for name in ("means", "quats", "scales", "opacities", "colors")
        }
        image, alphas, normals, _, distortions, _, meta = rasterization_2dgs(
            **{**s, **inputs}, render_mode="RGB+ED", **options
        )
        (image.square().sum() + normals.square().sum() + distortions.sum()).backward()
        results.append((image, alphas, meta, {name: value.grad for name, value in inputs.items()}))
    dense, packed, sparse = results
    for image, alphas, meta, gradients in (packed, sparse):
        torch.testing.assert_close(image, dense[0])
        torch.testing.assert_close(alphas, dense[1])
        at = meta["camera_ids"], meta["gaussian_ids"]
        torch.testing.assert_close(meta["gradient_2dgs"].grad, dense[2]["gradient_2dgs"].grad[at], rtol=1e-4, atol=1e-4)
        for name, value in gradients.items():
            torch.testing.assert_close(value.to_dense(), dense[3][name], rtol=1e-4, atol=1e-4)
    assert sparse[3]["means"].layout == torch.sparse_coo
    assert sparse[3]["means"]._nnz() == 40


def test_surfel_harmonics_batches_and_constants() -> None:
    s = scene(batch=(2,), cameras=2)
    s["opacities"][:] = 1.0
    s["colors"] = torch.rand(2, 60, 4, 3) - 0.5
    image, alphas, *_ = rasterization_2dgs(**s, sh_degree=1, backgrounds=torch.ones(2, 2, 3))
    assert image.shape == (2, 2, 33, 40, 3)
    assert rasterization_2dgs(**s, sh_degree=1, constants="1.5.3")[1].max() > alphas.max()
    one = {name: value[:1] if isinstance(value, Tensor) else value for name, value in s.items()}
    torch.testing.assert_close(rasterization_2dgs(**one, sh_degree=1, backgrounds=torch.ones(1, 2, 3))[0], image[:1])


def test_surfels_with_invalid_values_are_ignored() -> None:
    s = scene()
    expected = rasterization_2dgs(**s, render_mode="RGB+ED")
    more = dict(s)
    for name in ("means", "quats", "scales", "opacities"):
        more[name] = torch.cat([s[name], s[name][:3]])
    more["colors"] = torch.cat([s["colors"], s["colors"][:, :3]], 1)
    more["means"][-3, 0] = math.nan
    more["means"][-2, 2] = -1
    more["colors"][0, -1, 0] = math.inf
    more["means"].requires_grad_()
    seen = rasterization_2dgs(**more, render_mode="RGB+ED")
    for value, wanted in zip(seen[:6], expected[:6], strict=True):
        assert value is not None and wanted is not None
        torch.testing.assert_close(value, wanted)
    seen[0].sum().backward()
    assert more["means"].grad.isfinite().all() and not more["means"].grad[-3:].any()


def test_surfel_rendering_without_surfels() -> None:
    s = scene()
    empty = {name: s[name][:0] for name in ("means", "quats", "scales", "opacities")}
    image, alphas, *_ = rasterization_2dgs(
        **{**s, **empty, "colors": s["colors"][:, :0]}, backgrounds=torch.full((1, 3), 0.25)
    )
    assert (image == 0.25).all() and not alphas.any()


def test_surfel_pairs_blend_to_same_image() -> None:
    s = blend_scene(surfel_scene(50, 40, 33, cameras=2))
    inputs = {name: value.detach() for name, value in s.to(torch.float32).items()}
    offsets, ids = s.lists()
    size = s.width, s.height
    image, alphas, normals, _, _ = gsplat_core.rasterize_to_pixels_2dgs(*inputs.values(), *size, 16, offsets, ids)
    shape = inputs["means2d"], inputs["ray_transforms"], inputs["opacities"]
    pairs = gsplat_core.rasterize_to_indices_in_range_2dgs(
        0, 10**9, torch.ones(2, s.height, s.width), *shape, *size, 16, offsets, ids
    )
    seen = gsplat_core.accumulate_2dgs(*shape, inputs["colors"], inputs["normals"], *pairs, *size)
    for value, wanted in zip(seen, (image, alphas, normals), strict=True):
        torch.testing.assert_close(value, wanted, rtol=1e-4, atol=1e-4)


def test_inria_wrapper_equals_rasterization_2dgs() -> None:
    s = scene()
    s["colors"] = s["colors"][0]
    (colors, alphas), meta = rasterization_2dgs_inria_wrapper(**s, depth_ratio=1)
    image, expected, _, _, _, medians, _ = rasterization_2dgs(**s, far_plane=100.0, render_mode="RGB+ED")
    torch.testing.assert_close(colors, torch.cat([image[..., :3], medians], -1))
    torch.testing.assert_close(alphas, expected)
    assert meta["normals_surf"].shape == (1, 33, 40, 3) and meta["radii"].shape == (1, 60)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"render_mode": "d"}, "unknown render_mode 'd'"),
        ({"depth_mode": "mean"}, "unknown depth_mode 'mean'"),
        ({"distloss": True}, "distloss=True needs a render_mode with depth"),
        ({"sparse_grad": True}, "packed=True"),
        ({"tile_size": 0}, "tile_size"),
        ({"backgrounds": torch.zeros(2, 3)}, "backgrounds"),
    ],
)
def test_surfel_rendering_rejects_invalid_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        rasterization_2dgs(**scene(), **options)
