"""Rendering by weighted sums: the picture against its formula, its gradients, and independence of the order."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import Camera, reference
from gsplat_core.ops.arguments import View
from gsplat_core.rendering.weighted_sum import (
    FACTOR,
    LEAST_SHARE,
    LEAST_TOTAL,
    OPACITY,
    DirectWeightedSumRenderer,
    ExpWeightedSumRenderer,
    WeightedSumRenderer,
)
from gsplat_core.scene.gaussians import SH_C0, Gaussians

CAMERA = Camera.from_focal(40.0, 32, 24)
KINDS = [WeightedSumRenderer, DirectWeightedSumRenderer, ExpWeightedSumRenderer]


def two_splats() -> Gaussians:
    """Two wide splats on the axis at the depths 40 and 80, red and green, with opacities 0.5 and 0.25."""
    sh = (torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]) - 0.5) / SH_C0
    opacity = torch.tensor([0.5, 0.25])
    return Gaussians(
        torch.tensor([[0.0, 0, 40], [0, 0, 80]]), torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 10.0).log(),
        torch.logit(opacity), sh[:, None],
    )  # fmt: skip


def values_of(kind, distance=50.0):
    return {name: torch.tensor(value) for name, value in kind.first_values(distance).items()}


@pytest.mark.parametrize("kind", KINDS)
def test_weighted_sum_image_is_weighted_mean(kind):
    scene, values = kind.extended(two_splats()), values_of(kind)
    output = kind.picture(scene, CAMERA, torch.tensor([0.0, 0.0, 1.0]), values)
    depths = torch.tensor([40.0, 80.0])
    weights = {
        "weighted_sum": (1 - depths / 100).clamp(min=0),
        "weighted_sum_direct": torch.ones(2),
        "weighted_sum_exp": torch.exp(-depths / 50),
    }[kind.name]
    # The pixel at (15, 11) is half a pixel from the axis in x and y; the projected scale is 10 * 40 / depth px.
    variance = (400 / depths) ** 2 + 0.3
    terms = torch.tensor([0.5, 0.25]) * torch.exp(-0.5 * 0.5 / variance) * weights
    total = 0.1 + terms.sum()
    expected = torch.tensor([terms[0], terms[1], 0.1]) / total
    torch.testing.assert_close(output.image[11, 15], expected, rtol=2e-4, atol=1e-5)
    torch.testing.assert_close(output.alpha[11, 15], 1 - 0.1 / total, rtol=2e-4, atol=1e-5)
    torch.testing.assert_close(output.depth[11, 15], (terms * depths).sum() / terms.sum(), rtol=2e-4, atol=1e-3)


def test_weighted_sum_opacity_depends_on_direction_and_may_be_negative():
    scene = WeightedSumRenderer.extended(two_splats())
    opacity = scene.extra[OPACITY].clone()
    opacity[0, 0], opacity[0, 2] = 0.0, -1.0  # Y_1,0 = 0.4886 z, and the direction is +z
    scene = dataclasses.replace(scene, extra={**scene.extra, OPACITY: opacity})
    output = WeightedSumRenderer.picture(scene, CAMERA, None, values_of(WeightedSumRenderer))
    terms = torch.tensor([-0.4886 * 0.6, 0.25 * 0.2])
    assert terms.sum() + 0.1 < 0.01
    torch.testing.assert_close(output.image[11, 15], torch.tensor([terms[0], terms[1], 0]) / 0.01, rtol=2e-2, atol=1e-5)
    assert output.depth[11, 15] == 0


@pytest.mark.parametrize("kind", KINDS)
def test_weighted_sum_gradients_equal_finite_differences(kind):
    # The splats cover the whole picture, so no pixel crosses the cutoff.
    scene, values = kind.extended(two_splats()), values_of(kind)
    scene.means[:, :2] += torch.tensor([[3.0, -2.0], [-4.0, 5.0]])
    weights = torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(1))

    def loss(tensors, values):
        output = kind.picture(Gaussians.from_tensors(tensors), CAMERA, None, values)
        return (output.image * weights).sum() + output.alpha.sum()

    leaves = {name: t.clone().requires_grad_() for name, t in scene.tensors().items()}
    scalars = {name: t.clone().requires_grad_() for name, t in values.items()}
    loss(leaves, scalars).backward()
    for name in ("means", "extra." + OPACITY, "extra." + FACTOR):
        gradient = leaves[name].grad
        if gradient is None:
            assert name.endswith(FACTOR) and kind is not WeightedSumRenderer
            continue
        index = int(gradient.abs().argmax())
        step = 1e-3 * max(1.0, float(scene.tensors()[name].reshape(-1)[index].abs()))
        moved = []
        for sign in (-1, 1):
            tensors = {key: t.clone() for key, t in scene.tensors().items()}
            tensors[name].view(-1)[index] += sign * step
            moved.append(float(loss(tensors, values)))
        assert (moved[1] - moved[0]) / (2 * step) == pytest.approx(
            float(gradient.reshape(-1)[index]), rel=0.05, abs=0.05
        )
    for name in set(values) - {"distance"}:
        moved = [float(loss(scene.tensors(), {**values, name: values[name] * factor})) for factor in (0.999, 1.001)]
        expected = (moved[1] - moved[0]) / (0.002 * float(values[name]))
        assert float(scalars[name].grad) == pytest.approx(expected, rel=0.05, abs=0.05)


def test_weighted_sum_is_independent_of_order(make_gaussians):
    scene, values = WeightedSumRenderer.extended(make_gaussians(300)), values_of(WeightedSumRenderer, 1000.0)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(2))
    wanted = WeightedSumRenderer.picture(scene, CAMERA, None, values)
    seen = WeightedSumRenderer.picture(scene.select(order), CAMERA, None, values)
    assert wanted.alpha.any()
    assert all(torch.equal(one, other) for one, other in zip(seen, wanted, strict=True))


@pytest.mark.parametrize("with_background", [True, False])
def test_weighted_sum_image_equals_reference(make_gaussians, assert_near, with_background):
    scene, values = WeightedSumRenderer.extended(make_gaussians(200)), values_of(WeightedSumRenderer)
    g = torch.Generator().manual_seed(5)
    opacity = scene.extra[OPACITY] + 0.3 * torch.randn(200, 16, generator=g)
    scene = dataclasses.replace(scene, extra={OPACITY: opacity, FACTOR: 0.5 + torch.rand(200, generator=g)})
    background = torch.tensor([0.1, 0.5, 0.9]) if with_background else None
    seen = WeightedSumRenderer.picture(scene, CAMERA, background, values)
    exact = lambda t: None if t is None else t.double()
    viewmat, K = CAMERA.matrices("cpu", torch.float64)
    image, alphas = reference.render_weighted_frame(
        [t.double() for t in scene.left_tensors], exact(opacity), exact(scene.extra[FACTOR]),
        tuple(values[name].double() for name in ("sigma", "distance", "background")),
        View(viewmat, K, 32, 24, exact(background)), least_total=LEAST_TOTAL, least_share=LEAST_SHARE,
    )  # fmt: skip
    assert alphas.max() > 0.5
    assert_near(seen.image, image[..., :3], of_largest=1e-4)
    assert_near(seen.alpha, alphas, of_largest=1e-4)
    assert_near(seen.depth, image[..., 3], of_largest=1e-4)
