"""`rasterization` on CUDA in difficult scenes, against the reference in float64: image, alpha and all gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsplat_core import rasterization, reference

NAMES = ("means", "quats", "scales", "opacities", "sh", "viewmats")


def near_the_cutoff(scene) -> Tensor:
    """Pixels [C, H, W] where rounding may decide whether some splat reaches an alpha of 1/255."""
    with torch.no_grad():
        geometry = (scene.means, None, scene.quats, scene.scales, scene.viewmats, scene.Ks, scene.width, scene.height)
        splats = reference.fully_fused_projection(*geometry, opacities=scene.opacities)
    x = torch.arange(scene.width, device=scene.means.device) + 0.5
    y = torch.arange(scene.height, device=scene.means.device) + 0.5
    near = torch.zeros(len(scene.viewmats), scene.height, scene.width, dtype=torch.bool, device=x.device)
    for image, seen in enumerate(splats.radii[..., 0] > 0):
        rows = zip(splats.means2d[image][seen].split(500), splats.conics[image][seen].split(500), strict=True)
        for (means, conics), opacities in zip(rows, scene.opacities[seen].split(500), strict=True):
            dx, dy = (x - means[:, :1])[:, None, :], (y - means[:, 1:])[:, :, None]
            a, b, c = (conic[:, None, None] for conic in conics.unbind(-1))
            log_alpha = opacities.log()[:, None, None] - 0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
            near[image] |= ((log_alpha + math.log(255)).abs() < 2e-3).any(0)
    return near


def render(function, scene, weights: tuple[Tensor, Tensor], **options) -> dict[str, Tensor]:
    """Image, alpha and the gradients of a weighted sum of them."""
    leaves = scene.leaves()
    image, alpha, _ = function(*leaves, scene.Ks, scene.width, scene.height, sh_degree=3, **options)
    total = sum((t * w.to(t)).sum() for t, w in zip((image, alpha), weights, strict=True))
    gradients = torch.autograd.grad(total, leaves, allow_unused=True) if total.requires_grad else [None] * len(leaves)
    zeros = [torch.zeros_like(t) if g is None else g for t, g in zip(leaves, gradients, strict=True)]
    return {"image": image.detach(), "alpha": alpha.detach()} | dict(zip(NAMES, zeros, strict=True))


def check(scene, **options) -> dict[str, Tensor]:
    """Pixels away from the cut-off within 2e-4, 60 dB over all of them, gradients of what is away within 1e-3 of their norm."""
    exact = place(scene, torch.float64)
    near = near_the_cutoff(exact)
    assert near.double().mean() < 0.2
    random = torch.Generator().manual_seed(5)
    channels = 4 if options.get("render_mode", "RGB") != "RGB" else 3
    weights = tuple(
        torch.rand(*near.shape, n, generator=random, dtype=torch.float64).cuda() * ~near[..., None]
        for n in (channels, 1)
    )
    seen = render(rasterization, place(scene, torch.float32), weights, **options)
    wanted = render(reference.rasterization, exact, weights, **options)
    for name, w in wanted.items():
        assert seen[name].shape == w.shape
        assert seen[name].isfinite().all(), name
        error = seen[name].double() - w
        if name in ("image", "alpha"):
            scale = max(1.0, float(w.abs().max())) if w.numel() else 1.0
            assert error[~near].abs().max() <= 2e-4 * scale, (name, float(error[~near].abs().max()))
            assert error.square().mean() <= 1e-6 * scale**2, name
        else:
            assert error.norm() <= 1e-3 * w.norm(), (name, float(error.norm() / w.norm()))
    return seen


def place(scene, dtype: torch.dtype):
    scene = scene.to(dtype)
    return replace(scene, **{name: getattr(scene, name).cuda() for name in (*NAMES, "Ks")})


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("count", [0, 1, 2, 33])
def test_rasterization_of_very_few_gaussians(make_scene, count, packed):
    seen = check(make_scene(count), packed=packed, render_mode="RGB+ED")
    assert bool(seen["alpha"].max() > 0.1) == (count > 0)


@pytest.mark.parametrize("packed", [True, False])
def test_rasterization_of_gaussians_behind_camera_is_empty(make_scene, packed):
    scene = make_scene(50)
    seen = check(replace(scene, means=scene.means * torch.tensor([1.0, 1.0, -1.0]) - 10), packed=packed)
    assert not any(seen[name].any() for name in ("image", "alpha", *NAMES))


@pytest.mark.parametrize("tile_size", [8, 16])
def test_rasterization_of_screen_covering_gaussian_among_others(make_scene, tile_size):
    scene = make_scene(80, cameras=2, width=130, height=70)
    scene.means[0] = torch.tensor([0.3, -0.2, 6.0])
    scene.scales[0] = torch.tensor([60.0, 50.0, 0.1])
    scene.opacities[0] = 0.7
    seen = check(scene, packed=False, tile_size=tile_size)
    assert seen["alpha"].min() > 0.5


def test_rasterization_of_100000_wide_gaussians_in_one_tile(make_scene):
    scene = make_scene(100_000, width=16, height=16)
    # Wide and just visible everywhere, so that a pixel goes through thousands of them before it ends.
    scene.means[:] *= torch.tensor([0.1, 0.1, 0.1])
    scene.means[:, 2] += 6
    scene.scales[:] = torch.tensor([6.0, 4.0, 3.0])
    scene.opacities[:] = torch.tensor(0.006)
    seen = check(scene, packed=False)
    assert seen["alpha"].min() > 0.99


def test_rasterization_of_100000_small_gaussians_in_one_tile_is_deterministic(make_scene):
    scene = make_scene(100_000, width=16, height=16)
    weights = (torch.ones(1, 16, 16, 3), torch.ones(1, 16, 16, 1))
    first, second = (render(rasterization, place(scene, torch.float32), weights, packed=False) for _ in range(2))
    assert first["image"].isfinite().all()
    assert all(torch.equal(first[name], value) for name, value in second.items())


def test_rasterization_of_grazing_distant_tiny_thin_and_opaque_gaussians(make_scene):
    scene = make_scene(160)
    scene.means[1:20, 2] = torch.linspace(0.011, 0.3, 19)
    scene.means[20:40] *= 1e4
    scene.scales[40:60] = 1e-9
    scene.scales[60:80] *= torch.tensor([8.0, 0.01, 0.01])
    scene.opacities[80:100] = 1.0
    scene.opacities[100:120] = 0.0
    scene.quats[120:140] *= 1e-8
    rounded = replace(scene, **{name: getattr(scene, name).float().double() for name in NAMES})
    check(rounded, packed=False, eps2d=0.3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("packed", [True, False])
def test_rasterization_culls_non_finite_gaussians_without_side_effect(make_scene, value, packed):
    scene = place(make_scene(60, cameras=2), torch.float32)
    columns = [(t.view(60, -1), n) for t in (getattr(scene, name) for name in NAMES[:5]) for n in range(t[0].numel())]
    columns = columns[:11] + columns[11::7]  # every column of the geometry, some of the harmonics
    bad = torch.arange(60, device="cuda") < len(columns)
    for row, (tensor, column) in enumerate(columns):
        tensor[row, column] = value
    weights = (torch.ones(2, 37, 52, 3), torch.ones(2, 37, 52, 1))
    seen = render(rasterization, scene, weights, packed=packed)
    others = replace(scene, **{name: getattr(scene, name).detach()[~bad].clone() for name in NAMES[:5]})
    wanted = render(rasterization, others, weights, packed=packed)
    assert torch.equal(seen["image"], wanted["image"])
    assert wanted["alpha"].max() > 0.3
    for name in NAMES[:5]:
        assert not seen[name][bad].any(), name
        torch.testing.assert_close(seen[name][~bad], wanted[name])
    torch.testing.assert_close(seen["viewmats"], wanted["viewmats"])


@pytest.mark.parametrize("layout", ["strided", "shifted", "expanded"])
def test_rasterization_independent_of_memory_layout(make_scene, layout):
    scene = place(make_scene(200, cameras=2), torch.float32)
    weights = (torch.ones(2, 37, 52, 3), torch.ones(2, 37, 52, 1))
    if layout == "expanded":
        scene = replace(scene, sh=scene.sh[:1].expand_as(scene.sh), scales=scene.scales[:, :1].expand_as(scene.scales))

    def laid_out(t: Tensor) -> Tensor:
        if layout == "shifted":  # starts four bytes behind where its storage does
            return torch.empty(t.numel() + 1, device="cuda")[1:].view(t.shape).copy_(t)
        if layout == "strided":
            return torch.stack([t, t * 0], -1)[..., 0]
        return t

    changed = replace(scene, **{name: laid_out(getattr(scene, name).detach()) for name in (*NAMES, "Ks")})
    plain = replace(scene, **{name: getattr(scene, name).detach().clone().contiguous() for name in (*NAMES, "Ks")})
    assert layout == "shifted" or not changed.scales.is_contiguous()
    seen, wanted = (render(rasterization, s, weights, packed=False) for s in (changed, plain))
    for name, value in wanted.items():
        assert torch.equal(seen[name], value), name


def test_rasterization_with_non_rigid_view_matrices_equals_reference(make_scene):
    scene = make_scene(60, cameras=3)
    scene.viewmats[1, :3, :3] *= 2.0
    scene.viewmats[2, :3] += 0.3 * torch.randn(3, 4, generator=torch.Generator().manual_seed(1))
    check(replace(scene, viewmats=scene.viewmats.float().double()), packed=False)
