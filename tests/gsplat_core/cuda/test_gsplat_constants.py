"""The constants of either version of gsplat in the CUDA kernels of compositing and projection."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core import fully_fused_projection, reference
from tests.gsplat_core.cuda.test_compositing import Scene, check, scene
from tests.gsplat_core.cuda.test_projection import MODELS, project, to_gpu


@pytest.mark.parametrize("absgrad", [True, False])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 9])
def test_cuda_alpha_ceiling_matches_reference(channels: int, absgrad: bool) -> None:
    # Small splats, some opaque: many pixels lie where alpha is between the two ceilings or above both.
    s = scene(150, channels=channels, median_px=1.5, backgrounds=torch.rand(1, channels))
    s.opacities[:, ::2] = 1.0
    s.opacities[:, 1::4] = 0.995
    s.means2d[:, ::6] = s.means2d[:, ::6].floor() + 0.5
    for most in (0.99, 0.999):
        seen = check(replace(s, max_alpha=most), absgrad)
        assert seen["alphas"].max() > most - 1e-5


@pytest.mark.parametrize("channels", [3, 9])
@pytest.mark.parametrize(("most", "opacity", "clamped"), [
    (0.99, 1.0, True), (0.99, 0.985, False), (0.999, 1.0, True), (0.999, 0.9995, True), (0.999, 0.995, False),
])  # fmt: skip
def test_cuda_alpha_ceiling_clamps_value_and_gradient_at_pixel_centre(channels, most, opacity, clamped) -> None:
    s = Scene(
        torch.full((1, 1, 2), 0.5), torch.tensor([[[0.5, 0, 0.5]]]), torch.ones(1, 1, channels),
        torch.full((1, 1), opacity), 1, 1, max_alpha=most,
    )  # fmt: skip
    seen, wanted = s.run(), s.run("cpu", reference.rasterize_to_pixels, torch.float64)
    assert seen["alphas"].item() == pytest.approx(min(most, opacity), abs=2e-6)
    assert bool(seen["v_opacities"].any()) is not clamped
    for name in (
        "v_means2d",
        "v_conics",
    ):  # no slope at the centre: zero to rounding, and exactly where alpha is clamped
        assert seen[name].abs().max() <= (0 if clamped else 1e-4), name
    assert seen["v_opacities"].item() == pytest.approx(wanted["v_opacities"].item(), rel=1e-3)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("floor", [0.0, 0.005, 0.4])
@pytest.mark.parametrize("with_opacities", [False, True])
def test_cuda_compensation_floor_matches_reference(gpu, make_scene, assert_near, model, floor, with_opacities):
    # From far below the blur to far above it: compensations on either side of 0.005 and of 0.4.
    scene = make_scene(200, model=model)
    scene.scales[:] *= torch.logspace(-3, 1, 200, dtype=torch.float64)[:, None]
    scene.opacities.fill_(1.0)
    scene = scene.to(torch.float32).to(torch.float64)
    options = {"calc_compensations": True, "camera_model": model, "compensation_floor": floor}
    if not with_opacities:
        options["opacities"] = None
    ours, gradients = project(fully_fused_projection, to_gpu(scene, gpu), **options)
    exact, expected = project(reference.fully_fused_projection, scene, **options)
    seen = exact[0][..., 0] > 0
    assert torch.equal(ours[0][..., 0] > 0, seen)
    found = exact[4][seen]
    # With opacities, what cannot reach an alpha of 1/255 is culled.
    assert found.min() >= max(floor, 1 / 255 if with_opacities else 0.0) - 1e-9 and found.max() > 0.5
    assert bool((found < 0.005).any()) is (floor == 0) and bool((found == floor).any()) is (floor > 0)
    assert_near(ours[4], exact[4])
    for actual, wanted in zip(gradients, expected, strict=True):
        assert_near(actual, wanted, relative=5e-3, of_largest=1e-4)
