"""Rendering functions inside modes of torch: autocasting, transforms, forward-mode and second derivatives."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch.autograd import forward_ad

import gsplat_core
from gsplat_core import Camera, Gaussians, rasterization, rasterization_2dgs, render

RENDER = {
    "dense": lambda *a: rasterization(*a, 24, 16, packed=False)[0],
    "packed": lambda *a: rasterization(*a, 24, 16)[0],
    "order and depth along rays": lambda *a: rasterization(*a, 24, 16, global_z_order=False, render_mode="RGB-Ed")[0],
    "unscented": lambda *a: rasterization(*a, 24, 16, with_ut=True, with_eval3d=True)[0],
    "surfels": lambda *a: torch.cat(rasterization_2dgs(*a, 24, 16, render_mode="RGB+ED", packed=False)[:3], -1),
}


def arguments():
    random = torch.Generator().manual_seed(3)
    draw = lambda *shape: torch.rand(*shape, generator=random)
    means = (draw(30, 3) - 0.5) * torch.tensor([3.0, 2.0, 1.0]) + torch.tensor([0.0, 0.0, 3.0])
    views = torch.eye(4).repeat(2, 1, 1)
    views[1, :3, 3] = torch.tensor([0.3, -0.2, 0.4])
    Ks = torch.tensor([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]).repeat(2, 1, 1)
    return [means, draw(30, 4) - 0.5, 0.05 + 0.2 * draw(30, 3), draw(30), draw(30, 3), views, Ks]


@pytest.mark.parametrize("render", RENDER.values(), ids=RENDER.keys())
def test_rendering_unchanged_under_autocast(render):
    expected = render(*arguments())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.is_autocast_enabled("cpu")
        found = render(*arguments())
        assert torch.is_autocast_enabled("cpu")
    assert found.dtype == torch.float32 and torch.equal(found, expected)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")  # by torch itself when jvp is first used
@pytest.mark.parametrize("render", [RENDER["dense"], RENDER["packed"], RENDER["surfels"]])
def test_rendering_rejects_vmap_and_forward_mode(render):
    means, *others = arguments()
    of_means = lambda each: render(each, *others)
    with pytest.raises(
        NotImplementedError, match=r"rasterization(_2dgs)?\(\) has no transforms.*batch dimensions in place of vmap"
    ):
        torch.func.vmap(of_means)(means.expand(2, 30, 3))
    with pytest.raises(NotImplementedError, match="no forward-mode derivatives"):
        torch.func.jvp(of_means, (means,), (torch.ones_like(means),))
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="no forward-mode derivatives"):
        of_means(forward_ad.make_dual(means, torch.ones_like(means)))
    assert of_means(means).any()


def _scene_of(means):
    _, quats, scales, opacities, colors, _, _ = arguments()
    scene = Gaussians(means, quats, scales.log(), opacities.logit(), colors[:, None])
    return render(scene, Camera.from_focal(20.0, 24, 16)).image


OPERATIONS = {
    "render": _scene_of,
    "spherical_harmonics": lambda means: gsplat_core.spherical_harmonics(1, means, torch.ones(30, 4, 3)),
    "quat_scale_to_covar_preci": lambda means: gsplat_core.quat_scale_to_covar_preci(torch.ones(30, 4), means.abs())[0],
    "fully_fused_projection": lambda means: gsplat_core.fully_fused_projection(
        means, None, *arguments()[1:3], *arguments()[5:], 24, 16
    )[1],
    "fully_fused_projection_2dgs": lambda means: gsplat_core.fully_fused_projection_2dgs(
        means, *arguments()[1:3], *arguments()[5:], 24, 16
    )[1],
    "fully_fused_projection_with_ut": lambda means: gsplat_core.fully_fused_projection_with_ut(
        means, *arguments()[1:4], *arguments()[5:], 24, 16
    )[1],
    "fused_ssim": lambda means: gsplat_core.fused_ssim(means.reshape(1, 3, 5, 6), torch.ones(1, 3, 5, 6)),
}


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")  # by torch itself when jvp is first used
@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_reject_forward_mode_and_are_unchanged_under_autocast(name):
    means, function = arguments()[0], OPERATIONS[name]
    with pytest.raises(NotImplementedError, match=rf"{name}\(\) has no transforms"):
        torch.func.jvp(function, (means,), (torch.ones_like(means),))
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="no forward-mode derivatives"):
        function(forward_ad.make_dual(means, torch.ones_like(means)))
    expected = function(means)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(function(means), expected) and expected.any()


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")  # by torch itself when jvp is first used
def test_plain_torch_operations_are_unchanged_under_autocast_and_have_forward_derivatives():
    means, covars = arguments()[0], 0.1 * torch.eye(3).expand(30, 3, 3)
    views, Ks = arguments()[5:]
    to_camera = lambda each: gsplat_core.world_to_cam(each, covars, views)
    project = lambda each: gsplat_core.proj(*to_camera(each), Ks, 24, 16)[0]
    expected = (*to_camera(means), project(means))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert all(torch.equal(*pair) for pair in zip(expected, (*to_camera(means), project(means)), strict=True))
    _, tangent = torch.func.jvp(project, (means,), (torch.ones_like(means),))
    torch.testing.assert_close(tangent, (project(means + 1e-3) - project(means - 1e-3)) / 2e-3, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("render", RENDER.values(), ids=RENDER.keys())
def test_rendering_rejects_second_derivatives(render):
    means, *others = arguments()
    means.requires_grad_()
    image = render(means, *others)
    (expected,) = torch.autograd.grad(image.square().sum(), means, retain_graph=True)
    (gradient,) = torch.autograd.grad(image.square().sum(), means, create_graph=True)
    assert torch.equal(gradient, expected) and expected.any()
    # The gradient of a plain sum does not depend on the image, which torch's own guard misses.
    (gradient,) = torch.autograd.grad(image.sum(), means, create_graph=True)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        (gradient.square().sum() + image.sum()).backward()


def test_rendering_functions_can_be_pickled():
    for function in (gsplat_core.rasterization, gsplat_core.rasterization_2dgs):
        assert pickle.loads(pickle.dumps(function)) is function
