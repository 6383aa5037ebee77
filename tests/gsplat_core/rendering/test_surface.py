"""Depth along rays, normals and spread: against a loop over splats in float64, and on walls whose geometry is known exactly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, InvalidInput, reference, render
from gsplat_core.choices import OUTPUTS
from gsplat_core.models import Model
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.rendering.depth_maps import depth_normals
from gsplat_core.rendering.renderer import SURFACE_OUTPUTS
from gsplat_core.rendering.settings import EPS2D
from gsplat_core.rendering.surface import (
    COVERED,
    Surface,
    certainty,
    contribution,
    pruned,
    render_surface,
)

CAMERA = Camera.from_focal(50.0, 45, 37)


def cloud(count: int, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=g)
    means = draw(count, 3) * torch.tensor([10.0, 8.0, 6.0]) + torch.tensor([0.0, 0.0, 40.0])
    # In front of the camera: outside of the picture the projection is linearised at the picture's border.
    means[:, :2] = means[:, :2].clamp(-0.4 * means[:, 2:], 0.4 * means[:, 2:])
    return Gaussians(means, draw(count, 4), draw(count, 3) * 0.5 + 0.7, draw(count) + 1, draw(count, 1, 3))


def wall(tilt_deg: float, distance: float = 40.0, thickness: float = 0.02, spacing: float = 1.0) -> Gaussians:
    """Flat Gaussians on a plane through (0, 0, distance), turned round y: its far side is on the right."""
    angle = math.radians(tilt_deg)
    a, b = torch.meshgrid(torch.arange(-40.0, 41, spacing), torch.arange(-30.0, 31, spacing), indexing="xy")
    a, b = a.ravel(), b.ravel()
    means = torch.stack([a * math.cos(angle), b, distance + a * math.sin(angle)], 1)
    count = len(means)
    quats = torch.tensor([math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]).repeat(count, 1)
    scales = torch.tensor([spacing, spacing, thickness]).log().repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 6.0), torch.zeros(count, 1, 3))


def plane_depth(camera: Camera, tilt_deg: float, distance: float = 40.0) -> torch.Tensor:
    """Exact z of that plane [H, W]."""
    ray_x = (torch.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    return (distance / (1 - math.tan(math.radians(tilt_deg)) * ray_x)).expand(camera.height_px, -1).float()


def along_one_ray(gaussians: Gaussians, camera: Camera, column: int, row: int) -> tuple[float, float, float]:
    """Return expected depth, median depth and spread at a pixel, splat by splat in float64."""
    g = gaussians.to(dtype=torch.float64)
    covariances, _ = reference.quat_scale_to_covar_preci(g.quats, g.scales, compute_preci=False)
    pixel = np.array([column + 0.5, row + 0.5])
    met = []
    for mean, covariance, opacity in zip(g.means.numpy(), covariances.numpy(), g.opacities.numpy(), strict=True):
        x, y, z = mean
        f = camera.K[0, 0]
        if z < 0.01:
            continue
        jacobian = np.array([[f / z, 0, -f * x / z**2], [0, f / z, -f * y / z**2], [0, 0, 1]])
        ray_space = jacobian @ covariance @ jacobian.T
        ray_space[:2, :2] += EPS2D * np.eye(2)
        off = pixel - (f * mean[:2] / z + camera.K[:2, 2])
        inverse = np.linalg.inv(ray_space[:2, :2])
        alpha = min(0.99, opacity * math.exp(-0.5 * off @ inverse @ off))
        if alpha < 1 / 255:
            continue
        ray = np.array([(pixel[0] - camera.K[0, 2]) / f, (pixel[1] - camera.K[1, 2]) / camera.K[1, 1], 1.0])
        precision = np.linalg.inv(covariance)
        reach = 3 * math.sqrt(np.linalg.eigvalsh(covariance)[-1])
        square = ray @ precision @ ray
        met.append((z, alpha, np.clip(ray @ precision @ mean / square, z - reach, z + reach), 1 / square))
    through, median, weights, depths, variances = 1.0, 0.0, [], [], []
    for _, alpha, depth, variance in sorted(met):
        if through * (1 - alpha) <= 1e-4:
            break
        weights.append(alpha * through)
        depths.append(depth)
        variances.append(variance)
        before, through = through, through * (1 - alpha)
        if before > 0.5 >= through:
            median = depth
    if 1 - through < COVERED:
        return 0.0, 0.0, 0.0
    w, d, v = np.array(weights), np.array(depths), np.array(variances)
    mean_depth = (w @ d) / w.sum()
    return mean_depth, median, math.sqrt((w @ ((d - mean_depth) ** 2 + v)) / w.sum())


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 20, 120])
def test_surface_matches_loop_over_splats(count, device):
    gaussians = cloud(count)
    surface = render_surface(gaussians.to(device), CAMERA)
    planes = [surface.ray_depth.cpu(), surface.median_depth.cpu(), surface.spread.cpu()]
    wrong = 0
    pixels = [(column, row) for row in range(0, 37, 3) for column in range(0, 45, 3)]
    for column, row in pixels:
        wanted = along_one_ray(gaussians, CAMERA, column, row)
        found = [float(plane[row, column]) for plane in planes]
        # A transmittance of just 0.5, or an alpha of just 1/255, may fall to either side in float32.
        wrong += not np.allclose(found, wanted, rtol=2e-3, atol=2e-3)
    assert wrong <= len(pixels) // 50


def test_surface_alpha_equals_rendered_alpha(device):
    gaussians = cloud(150).to(device)
    surface = render_surface(gaussians, CAMERA)
    torch.testing.assert_close(surface.alpha, render(gaussians, CAMERA).alpha, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(surface.confidence, surface.alpha)


@pytest.mark.parametrize(("tilt_deg", "most"), [(0.0, 1e-4), (20.0, 1e-4), (-35.0, 5e-4)])
def test_surface_depth_and_normals_of_tilted_wall(tilt_deg, most, device):
    gaussians = wall(tilt_deg).to(device)
    surface = render_surface(gaussians, CAMERA)
    exact = plane_depth(CAMERA, tilt_deg).to(device)
    assert float(((surface.ray_depth - exact) / exact).abs().max()) < most
    assert float(((surface.median_depth - exact) / exact).abs().max()) < most
    if tilt_deg:  # the splats' centres, which a picture's depth is made of, are nearer: what is in front hides the rest
        centres = render(gaussians, CAMERA).depth
        assert float(((centres - exact) / exact).abs().max()) > 8 * most
    angle = math.radians(tilt_deg)
    normal = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], device=device)
    off = torch.rad2deg(torch.acos((surface.normals @ normal).clamp(-1, 1)))
    assert float(off.max()) < 0.1
    assert bool((surface.normals.norm(dim=-1) - 1).abs().max() < 1e-5)


def test_surface_normals_face_camera_for_any_axis_direction():
    gaussians = wall(20.0)
    turned = gaussians.quats.clone()
    # Half a turn round the Gaussian's own x: the same ellipsoid, its shortest axis the other way round.
    w, x, y, z = turned[::2].clone().unbind(1)
    turned[::2] = torch.stack([-x, w, z, -y], 1)
    flipped = Gaussians(gaussians.means, turned, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh)
    torch.testing.assert_close(
        render_surface(flipped, CAMERA).normals, render_surface(gaussians, CAMERA).normals, atol=1e-4, rtol=0
    )
    assert bool((render_surface(flipped, CAMERA).normals[..., 2] < 0).all())


def test_surface_spread_of_thick_wall_and_two_walls():
    thick = render_surface(wall(0.0, thickness=0.8), CAMERA).spread
    assert float((thick - 0.8).abs().max()) < 0.08
    near, far = wall(0.0, 40.0), wall(0.0, 44.0)
    veil = Gaussians(near.means, near.quats, near.log_scales, torch.full((near.count,), -3.2), near.sh)
    both = render_surface(veil.append(far), CAMERA)
    alone = render_surface(veil, CAMERA).alpha[18, 22]
    assert float(alone) < 0.5
    assert float((both.median_depth - 44).abs().max()) < 0.2
    assert float((both.ray_depth[18, 22] - (40 * alone + 44 * (1 - alone))).abs()) < 0.05
    assert float((both.spread[18, 22] - 4 * (alone * (1 - alone)).sqrt()).abs()) < 0.05


def test_surface_unobserved_pixels_are_zero():
    some = wall(0.0)
    right = some.select(some.means[:, 0] > 8)
    surface = render_surface(right, CAMERA)
    empty = ~surface.observed
    assert bool(empty[:, :10].all()) and not bool(empty[:, -5:].any())
    for plane in (surface.ray_depth, surface.median_depth, surface.spread, surface.normals):
        assert not plane[empty].any()
    nobody = render_surface(some.select(slice(0, 0)), CAMERA)
    assert not nobody.observed.any() and not nobody.median_depth.any()


def test_surface_ignores_non_finite_gaussians():
    gaussians = wall(0.0)
    broken = gaussians.clone()
    broken.means[0] = math.nan
    broken.log_scales[1] = math.inf
    broken.quats[2] = 0.0
    surface = render_surface(broken, CAMERA)
    assert all(bool(plane.isfinite().all()) for plane in surface)


@pytest.mark.parametrize("projection", ["ortho", "fisheye"])
def test_surface_with_ortho_and_fisheye_projection(projection):
    gaussians = wall(0.0)
    camera = Camera(CAMERA.K if projection == "fisheye" else np.diag([1.0, 1.0, 1]), 45, 37, model=projection)
    if projection == "ortho":
        camera = Camera(np.array([[1.0, 0, 22], [0, 1.0, 18], [0, 0, 1]]), 45, 37, model="ortho")
    surface = render_surface(gaussians, camera)
    middle = surface.ray_depth[12:24, 14:30]
    assert float((middle - 40).abs().max()) < 0.05
    assert float((surface.normals[18, 22] - torch.tensor([0, 0, -1.0])).abs().max()) < 1e-4


def test_surface_confidence_decreases_with_unseen_time():
    gaussians = wall(0.0)
    unseen_s = torch.where(gaussians.means[:, 0] > 0, 5.0, 0.0).double()
    model = Model(1, gaussians, None, CAMERA, (0.0, 1.0), unseen_s=unseen_s)
    surface = model.surface(0.5)
    assert float(surface.confidence[18, 2]) == pytest.approx(float(surface.alpha[18, 2]), abs=1e-4)
    assert float(surface.confidence[18, 42]) == pytest.approx(0.5 * float(surface.alpha[18, 42]), abs=1e-3)
    with pytest.raises(InvalidInput, match="certain"):
        render_surface(gaussians, CAMERA, certainty(unseen_s)[:4])


def test_surface_semantics_blended_like_colours():
    gaussians = cloud(60)
    logits = torch.randn(60, 20, generator=torch.Generator().manual_seed(1))
    surface = render_surface(replace(gaussians, extra={"semantics": logits}), CAMERA)
    colours = replace(gaussians, sh=(logits[:, None, :3] - 0.5) / 0.28209479177387814)
    wanted = render(colours, CAMERA).image
    clamped = render_surface(replace(gaussians, extra={"semantics": logits.clamp(min=0)}), CAMERA).semantics
    assert surface.semantics.shape == (37, 45, 20)
    torch.testing.assert_close(clamped[..., :3], wanted, atol=2e-4, rtol=1e-4)
    assert render_surface(gaussians, CAMERA).semantics.shape == (37, 45, 0)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, -50.0])
def test_depth_normals_of_tilted_plane_with_jump(tilt_deg, device):
    camera = Camera.from_focal(500.0, 45, 37)
    depth = plane_depth(camera, tilt_deg).to(device).clone()
    depth[:, 30:] *= 1.1  # a parallel plane behind a jump of more than 2 %
    depth[5, 5] = 0
    normals = depth_normals(depth, camera)
    angle = math.radians(tilt_deg)
    normal = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], device=device)
    known = normals.norm(dim=-1) > 0
    assert float(((normals - normal)[known]).abs().max()) < 2e-3
    assert not known[:, 29:31].any() and not known[0].any() and not known[5, 4:7].any() and not known[:, -1].any()
    assert bool(known[10, 1:29].all()) and bool(known[10, 31:-1].all())


def test_depth_normals_pass_gradcheck():
    camera = Camera.from_focal(500.0, 8, 7)
    depth = plane_depth(camera, 20.0).double() + 0.01 * torch.rand(7, 8, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda plane: depth_normals(plane, camera), depth.requires_grad_())


def test_surface_outputs_registered_and_rendered():
    assert {*SURFACE_OUTPUTS} <= {*OUTPUTS}
    assert {*SURFACE_OUTPUTS} == {*Surface._fields} - {"alpha"}
    frame = AlphaRenderer(CAMERA, torch.device("cpu"))
    frame.prepare(Model(1, wall(10.0), None, CAMERA, (0.0, 1.0)))
    outputs = frame.render(CAMERA, 0.0, SURFACE_OUTPUTS).outputs()
    for name in SURFACE_OUTPUTS:
        channels = OUTPUTS[name].channels
        shape = outputs[name].shape
        assert shape[:2] == (37, 45) and (channels is None or tuple(shape[2:]) == ((channels,) if channels > 1 else ()))


def test_pruned_removes_gaussians_without_contribution(device):
    front = wall(0.0)
    hidden = replace(wall(0.0), means=front.means + torch.tensor([0.0, 0.0, 20.0]))
    scene = front.append(hidden).to(device)
    aside = np.eye(4)
    aside[0, 3] = 3
    cameras = [CAMERA, CAMERA.with_pose(aside)]
    most = contribution(scene, cameras)
    assert float(most[: front.count].max()) > 0.2
    left = pruned(scene, cameras)
    assert int((most[front.count :] >= 1 / 255).sum()) < 0.2 * hidden.count
    assert left.count == int((most >= 1 / 255).sum()) < scene.count
    before, after = (render(each, CAMERA).image for each in (scene, left))
    torch.testing.assert_close(before, after, atol=1.5 / 255, rtol=0)
