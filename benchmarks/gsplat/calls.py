"""Typical calls of gsplat users, run with this package in place of gsplat.

    python benchmarks/gsplat/calls.py [--device cpu|cuda] [--list] [--only NAME ...] [--out FILE]

The calls are those of gsplat's documentation, examples and issues: each public name with its usual arguments. A call works
if it returns finite values of the documented shapes, with finite gradients where it is differentiated.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import log
import torch
from torch import Tensor

from gsplat_core.as_gsplat import install

install()
import gsplat  # noqa: E402

N, C, W, H = 60, 2, 48, 32
CALLS: dict[str, Callable[[Scene], None]] = {}
"""Calls by name. A call raises an exception if it does not work."""


@dataclasses.dataclass
class Scene:
    """Random Gaussians in front of cameras, on one device."""

    device: torch.device
    batch: tuple[int, ...] = ()
    leaves: list[Tensor] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        torch.manual_seed(0)
        random = lambda *shape: torch.rand(*self.batch, *shape, device=self.device)
        self.means = random(N, 3) * torch.tensor([2.0, 1.5, 2.0], device=self.device) + torch.tensor(
            [-1.0, -0.75, 2.0], device=self.device
        )
        self.quats, self.scales, self.opacities = random(N, 4) - 0.5, 0.02 + 0.2 * random(N, 3), random(N)
        self.colors = random(N, 3)
        self.sh = 0.3 * (random(N, 16, 3) - 0.5)
        viewmats = torch.eye(4, device=self.device).repeat(*self.batch, C, 1, 1)
        viewmats[..., 1, 0, 3] = 0.2
        self.viewmats = viewmats
        K = torch.tensor([[50.0, 0, W / 2], [0, 50.0, H / 2], [0, 0, 1]], device=self.device)
        self.Ks = K.repeat(*self.batch, C, 1, 1)
        self.backgrounds = random(C, 3)
        for each in (self.means, self.quats, self.scales, self.opacities, self.colors, self.sh):
            each.requires_grad_()

    def render(self, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Call `rasterization` with the scene's tensors, or with those of the options."""
        given: dict[str, Any] = {
            "means": self.means, "quats": self.quats, "scales": self.scales, "opacities": self.opacities,
            "colors": self.colors, "viewmats": self.viewmats, "Ks": self.Ks, "width": W, "height": H,
        }  # fmt: skip
        image, alphas, meta = gsplat.rasterization(**given | options)
        return image, alphas, meta

    def project(self, **options: Any) -> Any:
        """Call `fully_fused_projection` with quaternions and scales."""
        arguments = (self.means, None, self.quats, self.scales, self.viewmats, self.Ks, W, H)
        return gsplat.fully_fused_projection(*arguments, **options)

    def binned(self, projected: Any, tile: int = 16) -> tuple[Tensor, Tensor]:
        """Return starts and ids of the tile lists of a dense projection."""
        radii, means2d, depths = projected[:3]
        grid = -(-W // tile), -(-H // tile)
        _, ids, flat = gsplat.isect_tiles(means2d, radii, depths, tile, *grid)
        images = depths[..., 0].numel()
        starts = gsplat.isect_offset_encode(ids, images, *grid).reshape(*depths.shape[:-1], grid[1], grid[0])
        return starts, flat


def call(name: str) -> Callable[[Callable[[Scene], None]], Callable[[Scene], None]]:
    """Register a call under its name."""

    def register(function: Callable[[Scene], None]) -> Callable[[Scene], None]:
        CALLS[name] = function
        return function

    return register


def expect(condition: object, what: str = "a result is wrong") -> None:
    if not condition:
        raise AssertionError(what)


def finite(*tensors: Tensor) -> None:
    for tensor in tensors:
        expect(bool(tensor.isfinite().all()), "a value is not finite")


def differentiated(result: Tensor, *leaves: Tensor) -> None:
    """Check that the result has finite gradients, at least one of which is not zero."""
    finite(result)
    gradients = torch.autograd.grad(result.square().sum(), leaves, allow_unused=False)
    dense = [each.to_dense() if each.is_sparse else each for each in gradients]
    finite(*dense)
    expect(any(bool(each.any()) for each in dense), "all gradients are zero")


def renders(name: str, channels: int = 3, batch: tuple[int, ...] = (), gradient: bool = True, **options: Any) -> None:
    """Register a call of `rasterization` with options; functions among them are called with the scene."""

    @call(f"rasterization({name})")
    def rendered(scene: Scene) -> None:
        scene = Scene(scene.device, batch)
        given = {key: value(scene) if callable(value) else value for key, value in options.items()}
        image, alphas, meta = scene.render(**given)
        expect(image.shape == (*batch, C, H, W, channels), f"image {list(image.shape)}")
        expect(alphas.shape == (*batch, C, H, W, 1), f"alphas {list(alphas.shape)}")
        expect({"radii", "means2d", "gaussian_ids", "width", "height", "n_cameras"} <= set(meta), "meta lacks keys")
        if gradient:
            differentiated(image, scene.means, scene.opacities)


# rasterization: as in the quick start, and every keyword.
renders("defaults")
renders("packed=False", packed=False)
renders("batch of scenes", batch=(2,))
renders("two batch dimensions, packed=False", batch=(1, 2), packed=False)
renders("sh_degree=3", colors=lambda s: s.sh, sh_degree=3)
renders("sh_degree=1 of coefficients of degree 3", colors=lambda s: s.sh, sh_degree=1)
renders("sh_degree=0", colors=lambda s: s.sh, sh_degree=0)
renders("colours of each camera", colors=lambda s: s.colors.expand(C, N, 3))
renders("harmonics of each camera", colors=lambda s: s.sh.expand(C, N, 16, 3), sh_degree=3)
renders("features of 1 channel", 1, colors=lambda s: s.colors[..., :1])
renders("features of 32 channels", 32, colors=lambda s: s.colors.repeat(1, 11)[:, :32])
renders("features of 128 channels", 128, colors=lambda s: s.colors.repeat(1, 43)[:, :128])
renders("channel_chunk=8", 20, colors=lambda s: s.colors.repeat(1, 7)[:, :20], channel_chunk=8)
renders("backgrounds", backgrounds=lambda s: s.backgrounds)
renders("backgrounds and depth", 4, backgrounds=lambda s: s.backgrounds, render_mode="RGB+ED")
renders("render_mode=D", 1, render_mode="D")
renders("render_mode=ED", 1, render_mode="ED")
renders("render_mode=RGB+D", 4, render_mode="RGB+D")
renders("render_mode=RGB+ED, sh", 4, render_mode="RGB+ED", colors=lambda s: s.sh, sh_degree=3)
renders("render_mode=d", 1, render_mode="d")
renders("render_mode=Ed", 1, render_mode="Ed")
renders("render_mode=RGB-d", 4, render_mode="RGB-d")
renders("render_mode=RGB-Ed", 4, render_mode="RGB-Ed")
renders("rasterize_mode=antialiased", rasterize_mode="antialiased")
renders(
    "camera_model=ortho", camera_model="ortho", Ks=lambda s: s.Ks * torch.tensor([[0.4], [0.4], [1.0]], device=s.device)
)
renders("camera_model=fisheye", camera_model="fisheye")
renders("near_plane, far_plane, radius_clip, eps2d", near_plane=0.1, far_plane=10.0, radius_clip=0.5, eps2d=0.1)
renders("tile_size=8", tile_size=8)
renders("segmented", segmented=True)
renders("colors=None for depth", 1, colors=None, render_mode="D")
renders("global_z_order=False", global_z_order=False)
renders("with_ut", with_ut=True, packed=False)
renders("with_ut, with_eval3d", with_ut=True, with_eval3d=True, packed=False)
renders(
    "with_ut, radial_coeffs",
    with_ut=True,
    packed=False,
    radial_coeffs=lambda s: torch.full((C, 6), 0.01, device=s.device),
)
renders(
    "with_ut, with_eval3d, all OpenCV coefficients", with_ut=True, with_eval3d=True, packed=False,
    radial_coeffs=lambda s: torch.full((C, 6), 0.01, device=s.device),
    tangential_coeffs=lambda s: torch.full((C, 2), 0.01, device=s.device),
    thin_prism_coeffs=lambda s: torch.full((C, 4), 0.01, device=s.device),
)  # fmt: skip
renders(
    "with_ut, fisheye, radial_coeffs", with_ut=True, packed=False, camera_model="fisheye",
    radial_coeffs=lambda s: torch.full((C, 4), 0.01, device=s.device),
)  # fmt: skip
renders(
    "with_ut, rolling shutter", with_ut=True, with_eval3d=True, packed=False,
    rolling_shutter=gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM, viewmats_rs=lambda s: s.viewmats + 0.01,
)  # fmt: skip


@call("rasterization(with_ut, with_eval3d, return_normals)")
def _(scene: Scene) -> None:
    _, _, meta = scene.render(with_ut=True, with_eval3d=True, packed=False, return_normals=True)
    expect(meta["normals"].shape == (C, H, W, 3))
    finite(meta["normals"])


@call("rasterization(covars)")
def _(scene: Scene) -> None:
    covars, _ = gsplat.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False)
    image, _, _ = scene.render(covars=covars, quats=None, scales=None)
    plain, _, _ = scene.render()
    torch.testing.assert_close(image, plain, rtol=1e-3, atol=1e-4)
    differentiated(image, scene.quats, scene.scales)


@call("rasterization(positional arguments)")
def _(scene: Scene) -> None:
    image, _, _ = gsplat.rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, W, H, 0.01, 1e10, 0.0,
        0.3, None, False,
    )  # fmt: skip
    differentiated(image, scene.colors)


@call("rasterization(absgrad)")
def _(scene: Scene) -> None:
    for packed in (False, True):
        image, _, meta = scene.render(absgrad=True, packed=packed)
        meta["means2d"].retain_grad()
        image.square().sum().backward()
        expect(meta["means2d"].absgrad.shape == meta["means2d"].grad.shape, "shape of absgrad")
        expect(bool((meta["means2d"].absgrad >= meta["means2d"].grad.abs() - 1e-5).all()), "absgrad is too small")


@call("rasterization(sparse_grad)")
def _(scene: Scene) -> None:
    image, _, _ = scene.render(sparse_grad=True, packed=True)
    image.square().sum().backward()
    expect(scene.means.grad is not None and scene.means.grad.is_sparse, "the gradient is dense")
    torch.optim.SparseAdam([scene.means]).step()


@call("rasterization(gradients of viewmats and Ks)")
def _(scene: Scene) -> None:
    viewmats, Ks = scene.viewmats.requires_grad_(), scene.Ks.requires_grad_()
    image, _, _ = scene.render(colors=scene.sh, sh_degree=3)
    differentiated(image, viewmats, Ks)


@call("rasterization(extra_signals)")
def _(scene: Scene) -> None:
    signals = torch.rand(N, 7, device=scene.device, requires_grad=True)
    _, _, meta = scene.render(extra_signals=signals)
    expect(meta["render_extra_signals"].shape == (C, H, W, 7))
    differentiated(meta["render_extra_signals"], signals, scene.means)


@call("rasterization(extra_signals_sh_degree)")
def _(scene: Scene) -> None:
    signals = torch.rand(N, 4, 2, device=scene.device, requires_grad=True)
    _, _, meta = scene.render(extra_signals=signals, extra_signals_sh_degree=1)
    differentiated(meta["render_extra_signals"], signals)


@call("rasterization(return_normals)")
def _(scene: Scene) -> None:
    _, _, meta = scene.render(return_normals=True)
    expect(meta["normals"].shape == (C, H, W, 3))
    differentiated(meta["normals"], scene.quats)


@call("rasterization(0 Gaussians)")
def _(scene: Scene) -> None:
    none = {name: getattr(scene, name)[:0] for name in ("means", "quats", "scales", "opacities", "colors")}
    image, _, _ = scene.render(**none, backgrounds=scene.backgrounds)
    torch.testing.assert_close(image, scene.backgrounds[:, None, None].expand(C, H, W, 3))


@call("rasterization(under no_grad, then float of the mean)")
def _(scene: Scene) -> None:
    with torch.no_grad():
        image, _, _ = scene.render(render_mode="RGB+ED")
    expect(0 < float(image[..., :3].mean()) < 1)


@call("rasterization(distributed), one process")
def _(scene: Scene) -> None:
    with tempfile.TemporaryDirectory() as folder:
        backend = "nccl" if scene.device.type == "cuda" else "gloo"
        torch.distributed.init_process_group(backend, init_method=f"file://{folder}/store", rank=0, world_size=1)
        try:
            image, _, _ = scene.render(distributed=True)
            plain, _, _ = scene.render()
            torch.testing.assert_close(image, plain)
        finally:
            torch.distributed.destroy_process_group()


@call("rasterization_inria_wrapper")
def _(scene: Scene) -> None:
    image, _, _ = gsplat.rasterization_inria_wrapper(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, W, H
    )
    differentiated(image, scene.means)


# The steps of the pipeline.
@call("quat_scale_to_covar_preci")
def _(scene: Scene) -> None:
    covars, precis = gsplat.quat_scale_to_covar_preci(scene.quats, scene.scales)
    torch.testing.assert_close(covars @ precis, torch.eye(3, device=scene.device).expand(N, 3, 3), rtol=0, atol=1e-2)
    differentiated(covars, scene.quats, scene.scales)


@call("quat_scale_to_covar_preci(triu, compute_preci=False)")
def _(scene: Scene) -> None:
    covars, precis = gsplat.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False, triu=True)
    expect(covars.shape == (N, 6) and precis is None)


@call("world_to_cam, proj")
def _(scene: Scene) -> None:
    for model in ("pinhole", "ortho", "fisheye"):
        covars, _ = gsplat.quat_scale_to_covar_preci(scene.quats, scene.scales)
        local, turned = gsplat.world_to_cam(scene.means, covars, scene.viewmats)
        means2d, covars2d = gsplat.proj(local, turned, scene.Ks, W, H, model)
        expect(means2d.shape == (C, N, 2) and covars2d.shape == (C, N, 2, 2))
        differentiated(means2d, scene.means)


@call("fully_fused_projection")
def _(scene: Scene) -> None:
    radii, means2d, depths, conics, compensations = scene.project()
    expect(radii.shape == (C, N, 2) and radii.dtype == torch.int32 and compensations is None)
    differentiated(torch.cat([means2d, depths[..., None], conics], -1), scene.means, scene.quats, scene.scales)


@call("fully_fused_projection(packed)")
def _(scene: Scene) -> None:
    batch, cameras, gaussians, radii, means2d, depths, conics, compensations = scene.project(packed=True)
    expect(len(batch) == len(cameras) == len(gaussians) == len(radii) == len(depths) == len(conics))
    expect(compensations is None)
    differentiated(means2d, scene.means)


@call("fully_fused_projection(packed, sparse_grad)")
def _(scene: Scene) -> None:
    _, _, _, _, means2d, *_ = scene.project(packed=True, sparse_grad=True)
    (gradient,) = torch.autograd.grad(means2d.sum(), scene.means)
    expect(gradient.is_sparse, "the gradient is dense")


@call("fully_fused_projection(covars)")
def _(scene: Scene) -> None:
    covars, _ = gsplat.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False, triu=True)
    found = gsplat.fully_fused_projection(scene.means, covars, None, None, scene.viewmats, scene.Ks, W, H)
    differentiated(found[3], scene.quats)


@call("fully_fused_projection(calc_compensations, camera_model, opacities)")
def _(scene: Scene) -> None:
    for model in ("pinhole", "ortho", "fisheye"):
        found = scene.project(calc_compensations=True, camera_model=model, opacities=scene.opacities)
        expect(found[4].shape == (C, N))
        finite(found[4])


@call("fully_fused_projection(batch)")
def _(scene: Scene) -> None:
    found = Scene(scene.device, (2, 1)).project()
    expect(found[1].shape == (2, 1, C, N, 2))


@call("fully_fused_projection(gradient of viewmats)")
def _(scene: Scene) -> None:
    viewmats = scene.viewmats.requires_grad_()
    differentiated(scene.project()[1], viewmats)


@call("fully_fused_projection_with_ut")
def _(scene: Scene) -> None:
    found = gsplat.fully_fused_projection_with_ut(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats, scene.Ks, W, H
    )
    expect(found[0].shape == (C, N, 2) and found[1].shape == (C, N, 2))


@call("isect_tiles, isect_offset_encode")
def _(scene: Scene) -> None:
    radii, means2d, depths, _, _ = scene.project()
    per_splat, ids, flat = gsplat.isect_tiles(means2d, radii, depths, 16, 3, 2)
    expect(int(per_splat.sum()) == len(ids) == len(flat) and ids.dtype == torch.int64 and flat.dtype == torch.int32)
    starts = gsplat.isect_offset_encode(ids, C, 3, 2)
    expect(starts.shape == (C, 2, 3) and starts.dtype == torch.int32)


@call("isect_tiles(packed)")
def _(scene: Scene) -> None:
    _, cameras, gaussians, radii, means2d, depths, _, _ = scene.project(packed=True)
    _, ids, _ = gsplat.isect_tiles(
        means2d, radii, depths, 16, 3, 2, packed=True, n_images=C, image_ids=cameras, gaussian_ids=gaussians
    )
    expect(bool((ids[1:] >= ids[:-1]).all()), "the keys are not sorted")


@call("isect_tiles(sort=False, segmented=True)")
def _(scene: Scene) -> None:
    radii, means2d, depths, _, _ = scene.project()
    unsorted = gsplat.isect_tiles(means2d, radii, depths, 16, 3, 2, sort=False)[1]
    ids = gsplat.isect_tiles(means2d, radii, depths, 16, 3, 2, segmented=True)[1]
    expect(torch.equal(unsorted.sort().values, ids))


def composited(scene: Scene, colors: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
    projected = scene.project()
    starts, flat = scene.binned(projected)
    opacities = scene.opacities.expand(C, N)
    image, alphas = gsplat.rasterize_to_pixels(
        projected[1], projected[3], colors, opacities, W, H, 16, starts, flat, **options
    )
    return image, alphas


@call("rasterize_to_pixels")
def _(scene: Scene) -> None:
    image, _ = composited(scene, scene.colors.expand(C, N, 3))
    differentiated(image, scene.means, scene.colors, scene.opacities)


@call("rasterize_to_pixels(backgrounds)")
def _(scene: Scene) -> None:
    image, _ = composited(scene, scene.colors.expand(C, N, 3), backgrounds=scene.backgrounds)
    finite(image)


@call("rasterize_to_pixels(masks)")
def _(scene: Scene) -> None:
    masks = torch.ones(C, 2, 3, dtype=torch.bool, device=scene.device)
    masks[:, 0, 0] = False
    image, _ = composited(scene, scene.colors.expand(C, N, 3), masks=masks)
    expect(not bool(image[:, :16, :16].any()), "a masked tile is not empty")


@call("rasterize_to_pixels(128 channels)")
def _(scene: Scene) -> None:
    colors = torch.rand(C, N, 128, device=scene.device, requires_grad=True)
    image, _ = composited(scene, colors)
    differentiated(image, colors)


@call("rasterize_to_pixels(packed)")
def _(scene: Scene) -> None:
    _, cameras, gaussians, radii, means2d, depths, conics, _ = scene.project(packed=True)
    _, ids, flat = gsplat.isect_tiles(
        means2d, radii, depths, 16, 3, 2, packed=True, n_images=C, image_ids=cameras, gaussian_ids=gaussians
    )
    starts = gsplat.isect_offset_encode(ids, C, 3, 2)
    image, _ = gsplat.rasterize_to_pixels(
        means2d, conics, scene.colors[gaussians], scene.opacities[gaussians], W, H, 16, starts, flat, packed=True
    )
    differentiated(image, scene.colors)


@call("rasterize_to_pixels(absgrad)")
def _(scene: Scene) -> None:
    projected = scene.project()
    means2d = projected[1].detach().requires_grad_()
    starts, flat = scene.binned(projected)
    image, _ = gsplat.rasterize_to_pixels(
        means2d,
        projected[3],
        scene.colors.expand(C, N, 3),
        scene.opacities.expand(C, N),
        W,
        H,
        16,
        starts,
        flat,
        absgrad=True,
    )
    image.sum().backward()
    expect(means2d.absgrad.shape == (C, N, 2))


@call("rasterize_to_pixels_eval3d")
def _(scene: Scene) -> None:
    projected = scene.project(opacities=scene.opacities)
    starts, flat = scene.binned(projected)
    image, _ = gsplat.rasterize_to_pixels_eval3d(
        scene.means, scene.quats, scene.scales, scene.colors.expand(C, N, 3), scene.opacities.expand(C, N), scene.viewmats,
        scene.Ks, W, H, 16, starts, flat,
    )  # fmt: skip
    differentiated(image, scene.means, scene.quats, scene.scales)


@call("rasterize_to_indices_in_range, accumulate")
def _(scene: Scene) -> None:
    projected = scene.project()
    starts, flat = scene.binned(projected)
    opacities = scene.opacities.expand(C, N)
    pairs = gsplat.rasterize_to_indices_in_range(
        0,
        int(1e10),
        torch.ones(C, H, W, device=scene.device),
        projected[1],
        projected[3],
        opacities,
        W,
        H,
        16,
        starts,
        flat,
    )
    image, _ = gsplat.accumulate(projected[1], projected[3], opacities, scene.colors.expand(C, N, 3), *pairs, W, H)
    expected, _ = composited(scene, scene.colors.expand(C, N, 3))
    torch.testing.assert_close(image, expected, rtol=1e-3, atol=1e-4)
    differentiated(image, scene.means)


for degree in range(5):

    @call(f"spherical_harmonics(degree {degree})")
    def _(scene: Scene, degree: int = degree) -> None:
        directions = torch.randn(N, 3, device=scene.device, requires_grad=True)
        coefficients = torch.randn(N, 25, 3, device=scene.device, requires_grad=True)
        colors = gsplat.spherical_harmonics(degree, directions, coefficients)
        expect(colors.shape == (N, 3))
        differentiated(colors, *([directions] if degree else []), coefficients)


@call("spherical_harmonics(masks, batch)")
def _(scene: Scene) -> None:
    masks = torch.rand(2, C, N, device=scene.device) > 0.5
    directions = torch.randn(2, C, N, 3, device=scene.device)
    colors = gsplat.spherical_harmonics(3, directions, torch.randn(2, C, N, 16, 3, device=scene.device), masks)
    expect(not bool(colors[~masks].any()))


# Surfels.
def surfels(scene: Scene, **options: Any) -> tuple[Any, ...]:
    found = gsplat.rasterization_2dgs(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, W, H, **options
    )
    expect(len(found) == 7)
    return tuple(found)


@call("rasterization_2dgs")
def _(scene: Scene) -> None:
    image, _, normals, *_ = surfels(scene)
    expect(normals.shape == (C, H, W, 3))
    differentiated(image, scene.means, scene.quats)


@call("rasterization_2dgs(RGB+ED, distloss, backgrounds)")
def _(scene: Scene) -> None:
    image, _, normals, from_depth, distortion, median, meta = surfels(
        scene, render_mode="RGB+ED", distloss=True, backgrounds=scene.backgrounds
    )
    expect(image.shape == (C, H, W, 4) and from_depth.shape == (C, H, W, 3) and median.shape == (C, H, W, 1))
    expect("gradient_2dgs" in meta)
    differentiated(distortion, scene.means)
    finite(normals)


@call("rasterization_2dgs(packed, sh_degree, depth_mode=median)")
def _(scene: Scene) -> None:
    image, *_ = gsplat.rasterization_2dgs(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, scene.viewmats, scene.Ks, W, H, sh_degree=3,
        packed=True, render_mode="RGB+ED", depth_mode="median",
    )  # fmt: skip
    differentiated(image[..., :3], scene.sh)


@call("rasterization_2dgs(gradient_2dgs for DefaultStrategy)")
def _(scene: Scene) -> None:
    image, *_, meta = surfels(scene, packed=False)
    meta["gradient_2dgs"].retain_grad()
    image.sum().backward()
    finite(meta["gradient_2dgs"].grad)


@call("fully_fused_projection_2dgs, rasterize_to_pixels_2dgs")
def _(scene: Scene) -> None:
    radii, means2d, depths, transforms, normals = gsplat.fully_fused_projection_2dgs(
        scene.means, scene.quats, scene.scales, scene.viewmats, scene.Ks, W, H
    )
    starts, flat = scene.binned((radii, means2d, depths))
    image, *_ = gsplat.rasterize_to_pixels_2dgs(
        means2d, transforms, scene.colors.expand(C, N, 3), scene.opacities.expand(C, N), normals, torch.zeros_like(means2d),
        W, H, 16, starts, flat, distloss=True,
    )  # fmt: skip
    differentiated(image, scene.means)


@call("rasterize_to_indices_in_range_2dgs, accumulate_2dgs")
def _(scene: Scene) -> None:
    radii, means2d, depths, transforms, normals = gsplat.fully_fused_projection_2dgs(
        scene.means, scene.quats, scene.scales, scene.viewmats, scene.Ks, W, H
    )
    starts, flat = scene.binned((radii, means2d, depths))
    opacities = scene.opacities.expand(C, N)
    pairs = gsplat.rasterize_to_indices_in_range_2dgs(
        0, int(1e10), torch.ones(C, H, W, device=scene.device), means2d, transforms, opacities, W, H, 16, starts, flat
    )
    image, *_ = gsplat.accumulate_2dgs(
        means2d, transforms, opacities, scene.colors.expand(C, N, 3), normals, *pairs, W, H
    )
    differentiated(image, scene.means)


@call("rasterization_2dgs_inria_wrapper")
def _(scene: Scene) -> None:
    image, *_ = gsplat.rasterization_2dgs_inria_wrapper(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, W, H
    )
    finite(image if isinstance(image, Tensor) else image[0])


# Training.
def trained(scene: Scene, strategy: Any, steps: int, **options: Any) -> int:
    """Train a few steps as gsplat's trainer does; return the number of Gaussians."""
    params = torch.nn.ParameterDict(
        {
            "means": scene.means.detach().clone(), "scales": scene.scales.detach().log(), "quats": scene.quats.detach().clone(),
            "opacities": torch.logit(scene.opacities.detach().clamp(0.01, 0.99)), "sh0": scene.sh.detach()[:, :1].clone(),
            "shN": scene.sh.detach()[:, 1:].clone(),
        }
    )  # fmt: skip
    optimizers = {
        name: torch.optim.Adam([{"params": value, "lr": 1e-3, "name": name}]) for name, value in params.items()
    }
    strategy.check_sanity(params, optimizers)
    scaled = isinstance(strategy, gsplat.DefaultStrategy)
    state = strategy.initialize_state(scene_scale=1.0) if scaled else strategy.initialize_state()
    target = torch.rand(C, H, W, 3, device=scene.device)
    for step in range(steps):
        image, _, info = scene.render(
            means=params["means"], quats=params["quats"], scales=params["scales"].exp(), opacities=params["opacities"].sigmoid(),
            colors=torch.cat([params["sh0"], params["shN"]], 1), sh_degree=3, **options,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        (image - target).abs().mean().backward()
        for each in optimizers.values():
            each.step()
            each.zero_grad(set_to_none=True)
        if scaled:
            strategy.step_post_backward(params, optimizers, state, step, info, packed=options.get("packed", True))
        else:
            strategy.step_post_backward(params, optimizers, state, step, info, lr=1e-3)
    finite(*params.values())
    expect(len({len(value) for value in params.values()}) == 1, "the tensors have different numbers of rows")
    return len(params["means"])


@call("DefaultStrategy")
def _(scene: Scene) -> None:
    strategy = gsplat.DefaultStrategy(refine_start_iter=1, refine_every=2, grow_grad2d=1e-7, prune_opa=1e-4)
    expect(trained(scene, strategy, 6, packed=False) > N, "nothing was added")


@call("DefaultStrategy(packed)")
def _(scene: Scene) -> None:
    strategy = gsplat.DefaultStrategy(refine_start_iter=1, refine_every=2, grow_grad2d=1e-7, prune_opa=1e-4)
    expect(trained(scene, strategy, 6, packed=True) > N, "nothing was added")


@call("DefaultStrategy(absgrad, revised_opacity)")
def _(scene: Scene) -> None:
    strategy = gsplat.DefaultStrategy(
        refine_start_iter=1, refine_every=2, grow_grad2d=1e-7, absgrad=True, revised_opacity=True, reset_every=3
    )
    trained(scene, strategy, 6, packed=False, absgrad=True)


@call("MCMCStrategy")
def _(scene: Scene) -> None:
    strategy = gsplat.MCMCStrategy(cap_max=N + 5, refine_start_iter=1, refine_every=2)
    expect(N < trained(scene, strategy, 8) <= N + 5, "the number of Gaussians is wrong")


@call("strategy.ops")
def _(scene: Scene) -> None:
    from gsplat.strategy.ops import duplicate, remove, reset_opa, split

    params = torch.nn.ParameterDict(
        {"means": scene.means.detach(), "scales": scene.scales.detach().log(), "quats": scene.quats.detach(), "opacities": scene.opacities.detach()}
    )  # fmt: skip
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    mask = torch.zeros(N, dtype=torch.bool, device=scene.device)
    mask[:3] = True
    state: dict[str, Any] = {}
    duplicate(params, optimizers, state, mask)
    split(params, optimizers, state, torch.cat([mask, mask[:3]]))
    count = len(params["means"])
    remove(params, optimizers, state, torch.arange(count, device=scene.device) < 2)
    reset_opa(params, optimizers, state, 0.01)
    expect(len(params["means"]) == count - 2 > N)


@call("relocation.compute_relocation")
def _(scene: Scene) -> None:
    from gsplat.relocation import compute_relocation

    binoms = torch.tensor([[float(math.comb(n, k)) for k in range(51)] for n in range(51)], device=scene.device)
    ratios = torch.randint(1, 5, (N,), device=scene.device, dtype=torch.int32)
    found = compute_relocation(scene.opacities.detach().clamp(0.01, 0.99), scene.scales.detach(), ratios, binoms)
    finite(*found)


@call("SelectiveAdam")
def _(scene: Scene) -> None:
    optimizer = gsplat.SelectiveAdam([scene.means], eps=1e-8, betas=(0.9, 0.999))
    image, _, info = scene.render(packed=False)
    image.sum().backward()
    before = scene.means.detach().clone()
    visible = (info["radii"] > 0).all(-1).any(0)
    visible[:5] = False
    optimizer.step(visible)
    expect(torch.equal(before[:5], scene.means[:5]) and not torch.equal(before, scene.means), "rows are wrong")


@call("fused_ssim")
def _(scene: Scene) -> None:
    from fused_ssim import fused_ssim

    image, _, _ = scene.render()
    target = torch.rand_like(image)
    value = fused_ssim(image.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2), padding="valid")
    differentiated(value, scene.means)


@call("utils")
def _(scene: Scene) -> None:
    from gsplat.utils import depth_to_normal, depth_to_points, get_projection_matrix, normalized_quat_to_rotmat

    depth, _, _ = scene.render(render_mode="ED")
    poses = torch.linalg.inv(scene.viewmats)
    expect(
        depth_to_points(depth, poses, scene.Ks).shape == depth_to_normal(depth, poses, scene.Ks).shape == (C, H, W, 3)
    )
    expect(get_projection_matrix(0.01, 100.0, 1.0, 0.8, device=scene.device).shape == (4, 4))
    turned = normalized_quat_to_rotmat(torch.nn.functional.normalize(scene.quats, dim=-1))
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3, device=scene.device).expand(N, 3, 3))


# Files.
@call("PngCompression")
def _(scene: Scene) -> None:
    splats = {
        "means": scene.means.detach(), "scales": scene.scales.detach().log(), "quats": scene.quats.detach(),
        "opacities": scene.opacities.detach(), "sh0": scene.sh.detach()[:, :1], "shN": scene.sh.detach()[:, 1:],
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        codec = gsplat.PngCompression(verbose=False)
        codec.compress(folder, dict(splats))
        found = codec.decompress(folder)
    expect(len(found["means"]) == 49)
    finite(*found.values())


for form in ("ply", "splat", "ply_compressed"):

    @call(f"export_splats({form})")
    def _(scene: Scene, form: str = form) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "splats")
            data = gsplat.export_splats(
                scene.means, scene.scales.log(), scene.quats, scene.opacities, scene.sh[:, :1], scene.sh[:, 1:], format=form, save_to=path
            )  # fmt: skip
            expect(Path(path).read_bytes() == data and len(data) > 0)


@call("distributed.cli, one process")
def _(scene: Scene) -> None:
    from gsplat.distributed import cli

    seen: list[tuple[int, int]] = []
    expect(
        cli(lambda local_rank, world_rank, world_size, args: seen.append((world_rank, world_size)), None) is not False
    )
    expect(seen == [(0, 1)], "the function was not called once")


@call("__version__, RollingShutterType")
def _(scene: Scene) -> None:
    expect(gsplat.__version__ == "1.5.3" and gsplat.RollingShutterType.GLOBAL.name == "GLOBAL")


def main() -> None:
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="print the names of the calls")
    parser.add_argument("--only", nargs="+", help="calls to run")
    chosen = parser.parse_args()
    names = chosen.only or list(CALLS)
    if chosen.list:
        print("\n".join(names))
        return
    fails: dict[str, str] = {}
    for name in names:
        try:
            with contextlib.redirect_stdout(sys.stderr):
                CALLS[name](Scene(torch.device(chosen.device)))
        except Exception as error:  # noqa: BLE001  any exception is a call that does not work
            fails[name] = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"[:200]
            print(f"FAILED {name}: {fails[name]}")
    log.write(
        "calls",
        chosen,
        {"gsplat": "1.5.3", "calls": len(names), "works": len(names) - len(fails), "fails": fails},
        "gsplat",
    )


if __name__ == "__main__":
    main()
