"""SSIM on CUDA against the reference in float64: sizes around every tile."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import reference
from gsplat_core.ops.ssim import ssim_map

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
def test_values_and_gradients_equal_the_reference(shape):
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


def test_no_pixels():
    empty = torch.zeros(0, 5, 3, device="cuda")
    assert ssim_map(empty, empty).shape == (0, 5, 3)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_opcheck():
    image, target = images((12, 9, 3))
    torch.library.opcheck(torch.ops.gsplat_core.ssim_map, (image.requires_grad_(), target.requires_grad_()))
