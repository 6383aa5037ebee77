"""Gradients of `rasterization` in one native call against those of the chain: all inputs, `meta`, and subsets."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import rasterization
from gsplat_core.rendering.rasterization import step_by_step
from tests.gsplat_core.cuda.single_call_checks import assert_same, inputs, run


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED", "ED"])
def test_single_call_background_gradient_equals_chain(make_scene, mode):
    scene = make_scene(100, cameras=2)
    found = []
    for function in (rasterization, step_by_step.rasterization):
        background = torch.rand(2, 3, generator=torch.Generator().manual_seed(1)).cuda().requires_grad_()
        result, _ = run(function, scene, inputs(scene) | {"backgrounds": background}, render_mode=mode)
        found.append(result)
    assert_same(*found)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4, None])
@pytest.mark.parametrize("bases", [16, 25])
@pytest.mark.parametrize("cameras", [1, 2])
def test_single_call_gaussian_gradients_equal_chain(make_scene, degree, bases, cameras):
    degree = min(degree, math.isqrt(bases) - 1) if degree is not None else None
    scene = make_scene(150, cameras=cameras, degree=4)
    leaves = inputs(scene, colors=scene.sh[:, :bases] if degree is not None else scene.sh[:, 0])
    leaves["viewmats"].requires_grad_(False)
    options = {"sh_degree": degree, "packed": False, "render_mode": "RGB+ED"}
    seen, _ = run(rasterization, scene, leaves, **options)
    assert "viewmats" not in seen
    assert_same(seen, run(step_by_step.rasterization, scene, leaves, **options)[0])
    if degree is not None and (degree + 1) ** 2 < bases:
        assert not seen["colors"][:, (degree + 1) ** 2 :].any()


@pytest.mark.parametrize("wanted", [("means",), ("colors",), ("quats", "opacities"), ("viewmats",), ("scales",)])
def test_single_call_computes_requested_gradients_only(make_scene, wanted):
    scene = make_scene(100, cameras=2)
    every = inputs(scene)
    all_gradients, _ = run(rasterization, scene, every)
    some = {name: t.detach().requires_grad_(name in wanted) for name, t in every.items()}
    seen, _ = run(rasterization, scene, some)
    assert set(seen) == {"image", "alphas", *wanted}
    for name, value in seen.items():
        torch.testing.assert_close(value, all_gradients[name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("packed", [False, True])
def test_single_call_means2d_has_gradient_and_absolute_gradient(make_scene, packed):
    scene = make_scene(200, cameras=2, width=90, height=70)
    found = []
    for function in (rasterization, step_by_step.rasterization):
        leaves = inputs(scene)
        image, _, meta = function(
            **leaves, Ks=scene.Ks.float().cuda(), width=90, height=70, sh_degree=3, packed=packed, absgrad=True,
            render_mode="RGB+ED",
        )  # fmt: skip
        meta["means2d"].retain_grad()
        image.square().sum().backward()
        found.append({"grad": meta["means2d"].grad, "absgrad": meta["means2d"].absgrad, "means": leaves["means"].grad})
    assert_same(*found)
    assert (found[0]["absgrad"] >= found[0]["grad"].abs() * (1 - 1e-4) - 1e-5).all()


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_single_call_losses_over_meta_reach_inputs(make_scene, packed, mode):
    scene = make_scene(100, cameras=2)
    found = []
    for function in (rasterization, step_by_step.rasterization):
        leaves = inputs(scene)
        _, _, meta = function(
            **leaves, Ks=scene.Ks.float().cuda(), width=scene.width, height=scene.height, sh_degree=3, packed=packed,
            rasterize_mode=mode,
        )  # fmt: skip
        rows = meta["radii"][..., 0] > 0
        total = sum((meta[name][rows] ** 2).sum() for name in ("depths", "conics", "opacities"))
        total = total + meta["means2d"][rows].sin().sum()
        names = ("means", "quats", "scales", "opacities", "viewmats")
        gradients = torch.autograd.grad(total, [leaves[name] for name in names])
        found.append(dict(zip(names, gradients, strict=True)))
    assert_same(*found)


def test_single_call_backward_repeatable_and_second_order_rejected(make_scene):
    scene = make_scene(40)
    leaves = inputs(scene)
    image, _, _ = rasterization(
        **leaves, Ks=scene.Ks.float().cuda(), width=scene.width, height=scene.height, sh_degree=3
    )
    first, second = (torch.autograd.grad(image.sum(), leaves["means"], retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
    gradient = torch.autograd.grad(image.square().sum(), leaves["means"], create_graph=True)[0]
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        gradient.sum().backward()
