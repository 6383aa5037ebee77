"""SSIM on CUDA against the reference in float64: sizes around every tile."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import reference
from gsplat_core.ops.ssim import fused_ssim, ssim_map

SHAPES = [
    (1, 1, 3),
    (1, 700, 3),
    (13, 1, 1),
    (3, 4, 3),
    (32, 32, 3),
    (33, 31, 2),
    (100, 17, 4),
    (65, 97, 3),
    (9, 50, 32),
]


def images(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator)
    return (target + 0.2 * torch.randn(shape, generator=generator)).cuda(), target.cuda()


@pytest.mark.parametrize("shape", SHAPES)
def test_ssim_map_values_and_gradients_equal_reference(shape):
    image, target = images(shape)
    weights = torch.randn(shape, generator=torch.Generator().manual_seed(5))
    results = []
    for function, device, dtype in ((ssim_map, "cuda", torch.float32), (reference.ssim_map, "cpu", torch.float64)):
        x, y = (t.to(device, dtype, copy=True).requires_grad_() for t in (image, target))
        similarity = function(x, y)
        (similarity * weights.to(device, dtype)).sum().backward()
        results.append([t.detach().double().cpu() for t in (similarity, x.grad, y.grad)])
    for ours, expected in zip(*results, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-4)


def test_ssim_map_without_pixels():
    empty = torch.zeros(0, 5, 3, device="cuda")
    assert ssim_map(empty, empty).shape == (0, 5, 3)


# 33 channels in all take two calls.
@pytest.mark.parametrize("padding", ["same", "valid"])
@pytest.mark.parametrize("layout", ["planes", "pixels"])
@pytest.mark.parametrize(
    "shape",
    [(1, 3, 11, 11), (1, 1, 11, 90), (1, 3, 70, 13), (2, 3, 33, 64), (1, 3, 97, 650), (2, 16, 14, 17), (3, 11, 14, 17)],
)
def test_fused_ssim_equals_mean_of_ssim_maps(shape, layout, padding):
    pair = [t.movedim(-1, 0).reshape(shape) for t in images((*shape[2:], shape[0] * shape[1]), seed=2)]
    if layout == "pixels":
        pair = [t.movedim(1, -1).contiguous().movedim(-1, 1) for t in pair]
    ours = [t.clone().requires_grad_() for t in pair]
    exact = [t.double().cpu().requires_grad_() for t in pair]
    score = fused_ssim(*ours, padding)
    maps = torch.stack([reference.ssim_map(a.movedim(0, -1), b.movedim(0, -1)) for a, b in zip(*exact, strict=True)])
    wanted = (maps if padding == "same" else maps[:, 5:-5, 5:-5]).mean()
    assert score.shape == () and score.item() == pytest.approx(wanted.item(), abs=1e-5)
    gradients = torch.autograd.grad(1.7 * score, ours, retain_graph=True)
    for one, other in zip(gradients, torch.autograd.grad(1.7 * wanted, exact), strict=True):
        scale = other.abs().max()
        torch.testing.assert_close(one.double().cpu() / scale, other / scale, rtol=0, atol=1e-4)
    assert torch.equal(fused_ssim(*ours, padding), score)
    assert all(map(torch.equal, torch.autograd.grad(1.7 * score, ours), gradients))
    assert torch.equal(fused_ssim(*ours, padding, train=False), score)


@pytest.mark.parametrize("border", [0, 1, 5, 32, 40])
def test_ssim_mean_excludes_border_from_value_and_gradient(border):
    image, target = (t.requires_grad_() for t in images((97, 130, 3)))
    inner = ssim_map(image, target)[border : 97 - border, border : 130 - border]
    mean = torch.ops.gsplat_core.ssim_mean(image.detach(), target.detach(), border)
    torch.testing.assert_close(mean, inner.mean(), rtol=1e-6, atol=1e-6)
    upstream = torch.tensor(0.7, device="cuda")
    for one, other in ((image, target), (target, image)):
        (wanted,) = torch.autograd.grad(inner.mean(), one, upstream, retain_graph=True)
        found = torch.ops.gsplat_core.ssim_mean_backward(upstream, one.detach(), other.detach(), border)
        torch.testing.assert_close(found / wanted.abs().max(), wanted / wanted.abs().max(), rtol=0, atol=1e-5)


@pytest.mark.filterwarnings("ignore:Synchronization debug mode:UserWarning")
def test_fused_ssim_does_not_synchronise():
    first, second = (t.movedim(-1, 0)[None] for t in images((20, 24, 3)))
    try:
        torch.cuda.set_sync_debug_mode("error")
        fused_ssim(first.requires_grad_(), second).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_ssim_ops_pass_opcheck():
    image, target = images((12, 9, 3))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_map, (image.requires_grad_(), target.requires_grad_()))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_mean, (image.detach(), target.detach(), 2))
    upstream = torch.ones((), device="cuda")
    torch.library.opcheck(torch.ops.gsplat_core.ssim_mean_backward, (upstream, image.detach(), target.detach(), 2))
