"""The constants of either version of gsplat, on the CPU: the ceiling of alpha and the floor of the compensation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import gsplat_core as gsplat
from gsplat_core import InvalidInput, fully_fused_projection, rasterization, rasterize_to_pixels, reference
from tests.gsplat_core.ops.compositing_scenes import Scene, assert_close, scene
from tests.gsplat_core.ops.test_projection import MODELS, project
from tests.gsplat_core.rendering.test_rasterization import run


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 9])
def test_alpha_ceiling_matches_reference(channels: int) -> None:
    # Small splats, some opaque: many pixels lie where alpha is between the two ceilings or above both.
    s = scene(150, channels=channels, median_px=1.5, backgrounds=torch.rand(1, channels))
    s.opacities[:, ::2] = 1.0
    s.opacities[:, 1::4] = 0.995
    s.means2d[:, ::6] = s.means2d[:, ::6].floor() + 0.5
    by_ceiling = [assert_close(replace(s, max_alpha=most), absgrad=True) for most in (0.99, 0.999)]
    for seen, most in zip(by_ceiling, (0.99, 0.999), strict=True):
        assert seen["alphas"].max() > most - 1e-5
    assert not torch.equal(by_ceiling[0]["image"], by_ceiling[1]["image"])


@pytest.mark.parametrize(("most", "opacity", "clamped"), [
    (0.99, 1.0, True), (0.99, 0.995, True), (0.99, 0.985, False),
    (0.999, 1.0, True), (0.999, 0.9995, True), (0.999, 0.995, False), (0.5, 0.6, True),
])  # fmt: skip
def test_alpha_ceiling_clamps_value_and_gradient_at_pixel_centre(most, opacity, clamped) -> None:
    s = Scene(
        torch.full((1, 1, 2), 0.5), torch.tensor([[[0.5, 0, 0.5]]]), torch.ones(1, 1, 3), torch.full((1, 1), opacity),
        1, 1, max_alpha=most,
    )  # fmt: skip
    seen, wanted = s.run(rasterize_to_pixels, torch.float32), s.run(reference.rasterize_to_pixels, torch.float64)
    for results in (seen, wanted):
        assert results["alphas"].item() == pytest.approx(min(most, opacity), abs=1e-6)
        assert bool(results["v_opacities"].any()) is not clamped
        assert not results["v_means2d"].any() and not results["v_conics"].any()  # no slope at the centre
        assert results["v_colors"].all()
    assert seen["v_opacities"].item() == pytest.approx(wanted["v_opacities"].item(), rel=1e-4)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("floor", [0.0, 0.005, 0.4])
@pytest.mark.parametrize("with_opacities", [False, True])
def test_compensation_floor_matches_reference(make_scene, assert_near, model, floor, with_opacities):
    # From far below the blur to far above it: compensations on either side of 0.005 and of 0.4.
    scene = make_scene(200, model=model)
    scene.scales[:] *= torch.logspace(-3, 1, 200, dtype=torch.float64)[:, None]
    scene.opacities.fill_(1.0)
    scene = scene.to(torch.float32).to(torch.float64)
    options = {"calc_compensations": True, "camera_model": model, "compensation_floor": floor}
    if not with_opacities:
        options["opacities"] = None
    ours, gradients = project(fully_fused_projection, scene.to(torch.float32), 5, **options)
    exact, expected = project(reference.fully_fused_projection, scene, 5, **options)
    seen = exact[0][..., 0] > 0
    assert torch.equal(ours[0][..., 0] > 0, seen)
    found = exact[4][seen]
    # With opacities, what cannot reach an alpha of 1/255 is culled.
    assert found.min() >= max(floor, 1 / 255 if with_opacities else 0.0) - 1e-9 and found.max() > 0.5
    assert bool((found < 0.005).any()) is (floor == 0) and bool((found == floor).any()) is (floor > 0)
    assert_near(ours[4], exact[4])
    for actual, wanted in zip(gradients, expected, strict=True):
        assert_near(actual, wanted, relative=5e-3, of_largest=1e-4)


def test_splat_without_area_has_zero_compensation_and_finite_gradient(make_scene):
    scene = make_scene(5).to(torch.float32)
    scene.scales.zero_()
    options = {"calc_compensations": True, "compensation_floor": 0.0, "opacities": None}
    for function, dtype in ((fully_fused_projection, torch.float32), (reference.fully_fused_projection, torch.float64)):
        out, gradients = project(function, scene.to(dtype), 3, **options)
        assert (out.radii[0, 0] > 0).all()
        assert not out.compensations.any()
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_compensation_floor_outside_zero_to_one_rejected(make_scene):
    for floor in (-0.1, 1.1, math.nan):
        with pytest.raises(InvalidInput, match="compensation_floor must be from 0 to 1"):
            project(fully_fused_projection, make_scene(3).to(torch.float32), compensation_floor=floor)


def centred_ball(opacity, scale=0.5):
    """Return one Gaussian at the centre of pixel (15, 20) of 40x30."""
    return dict(
        means=torch.tensor([[0.0, 0, 5]]), quats=torch.tensor([[1.0, 0, 0, 0]]), scales=torch.full((1, 3), scale),
        opacities=torch.tensor([opacity]), colors=torch.ones(1, 3), viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[50.0, 0, 20.5], [0, 50, 15.5], [0, 0, 1]]]), width=40, height=30,
    )  # fmt: skip


@pytest.mark.parametrize("module", [gsplat, reference])
def test_constants_of_gsplat_versions(module):
    render = module.rasterization
    alpha = {version: render(**centred_ball(1.0), constants=version)[1][0, 15, 20, 0] for version in ("1.6", "1.5.3")}
    assert alpha["1.6"] == pytest.approx(0.99, abs=1e-6) and alpha["1.5.3"] == pytest.approx(0.999, abs=1e-6)
    assert torch.equal(render(**centred_ball(1.0))[1], render(**centred_ball(1.0), constants="1.6")[1])
    # Compensations of 0.0045, between 1/255 and 1.6's floor, and of 0.001, which 1.5.3 culls.
    for compensation, seen in ((0.0045, {"1.6": 0.005, "1.5.3": 0.0045}), (0.001, {"1.6": 0.005, "1.5.3": 0.0})):
        variance = 0.3 * compensation / (1 - compensation)
        ball = centred_ball(1.0, scale=math.sqrt(variance) / 10)
        for version, wanted in seen.items():
            _, alphas, meta = render(**ball, rasterize_mode="antialiased", packed=False, constants=version)
            assert alphas[0, 15, 20, 0] == pytest.approx(wanted, rel=1e-3)
            assert bool((meta["radii"] > 0).all()) is (wanted > 0)


@pytest.mark.parametrize("options", [{}, {"packed": False, "render_mode": "RGB+ED", "rasterize_mode": "antialiased"}])
def test_image_and_gradients_match_reference_for_both_constants(make_scene, assert_near, options):
    scene = make_scene(80)
    scene.opacities[::2] = 1.0
    scene.scales[:] *= torch.logspace(-2.5, 0.3, 80, dtype=torch.float64)[:, None]
    # In front of all others, and so large that the blur hardly matters.
    scene.means[0], scene.scales[0] = torch.tensor([0.1, 0.2, 2.0]), 1.0
    images = []
    for version in ("1.6", "1.5.3"):
        ours = run(rasterization, scene.to(torch.float32), constants=version, **options)
        exact = run(reference.rasterization, scene.to(torch.float32).to(torch.float64), constants=version, **options)
        for actual, wanted in zip(ours[:2], exact[:2], strict=True):
            assert_near(actual, wanted, relative=1e-3, of_largest=1e-4)
        for actual, wanted in zip(ours[2], exact[2], strict=True):
            assert_near(actual, wanted, relative=1e-2, of_largest=1e-3)
        images.append(exact[0])
    assert (images[0] - images[1]).abs().max() > 1e-3
