"""The image loss on CUDA, of plain images and of frames, against the reference in float64."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from gsplat_core import InvalidInput, reference
from gsplat_core.ops.image_loss import frame_loss, image_loss

SHAPES = [(1, 1, 3), (1, 37, 3), (5, 7, 3), (33, 65, 3), (70, 131, 3), (18, 700, 3), (10, 11, 1), (40, 33, 32)]


def scene(shape, seed=0, keep=0.7) -> tuple[Tensor, ...]:
    """Image, target, mask, depth and its target; a third of the depths unknown."""
    generator = torch.Generator().manual_seed(seed)
    height, width, _ = shape
    image = torch.rand(shape, generator=generator)
    target = (torch.rand(shape, generator=generator) * 255).to(torch.uint8)
    mask = (torch.rand(height, width, generator=generator) < keep).to(torch.uint8)
    depth, target_depth = 20 + 60 * torch.rand(2, height, width, generator=generator)
    depth[torch.rand(height, width, generator=generator) < 0.1] = 0
    target_depth[torch.rand(height, width, generator=generator) < 0.3] = 0
    return tuple(t.cuda() for t in (image, target, mask, depth, target_depth))


def frame(shape, seed=0, keep=0.7) -> tuple[Tensor, ...]:
    """Image with depth times alpha behind its colours, alphas, target, mask, target depth."""
    image, target, mask, depth, target_depth = scene((*shape, 3), seed, keep)
    alphas = torch.rand(shape, generator=torch.Generator().manual_seed(seed + 1)).cuda()
    alphas[alphas < 0.1] = 0
    return torch.cat([image, (depth * alphas)[..., None]], -1), alphas, target, mask, target_depth


def double(t: Tensor | None) -> Tensor | None:
    return t if t is None else t.cpu() if t.dtype == torch.uint8 else t.double().cpu()


def assert_same(ours, expected):
    for i, (a, b) in enumerate(zip(ours, expected, strict=True)):
        if b is None:
            assert a is None
            continue
        scale = b.abs().max().clamp(min=1e-12) if i > 1 else 1
        tolerance = {"rtol": 0, "atol": 1e-4} if i > 1 else {"rtol": 1e-5, "atol": 1e-6}
        torch.testing.assert_close(a.double().cpu() / scale, b / scale, **tolerance)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_image_loss_equals_reference(shape, ssim_weight):
    image, target, mask, depth, target_depth = scene(shape)
    for masked, deep, as_bytes, squared in itertools.product((True, False), repeat=4):
        tensors = (
            image,
            target if as_bytes else target.float() / 255,
            mask if masked else None,
            *((depth, target_depth) if deep else (None, None)),
        )
        assert_same(
            image_loss(*tensors, ssim_weight, 0.5, squared),
            reference.image_loss(*map(double, tensors), ssim_weight, 0.5, squared),
        )


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (64, 64), (101, 150)])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
def test_frame_loss_equals_reference(shape, ssim_weight):
    for masked, deep, squared in itertools.product((True, False), repeat=3):
        image, alphas, target, mask, target_depth = frame(shape)
        tensors = (image, alphas, target, mask if masked else None, target_depth if deep else None)
        assert_same(
            frame_loss(*tensors, ssim_weight, 0.5, squared),
            reference.frame_loss(*map(double, tensors), ssim_weight, 0.5, squared),
        )


def test_frame_loss_without_tissue_or_depth_is_zero():
    image, alphas, target, mask, target_depth = frame((12, 15))
    for result in (
        frame_loss(image, alphas, target, torch.zeros_like(mask), target_depth, 0.2, 1.0),
        frame_loss(image, alphas, target, torch.zeros_like(mask), None, 0.2, 1.0),
    ):
        assert result.loss.item() == 0
        assert not result.grad_image.any()
        assert not result.grad_alphas.any()
    unknown = frame_loss(image, alphas, target, mask, torch.zeros_like(target_depth), 0.2, 1.0)
    assert unknown.terms[2].item() == 0
    assert not unknown.grad_image[..., 3].any()


def test_image_loss_ignores_masked_nan_and_reports_unmasked_nan():
    image, target, mask, *_ = scene((30, 40, 3))
    mask[10:, :] = 1
    mask[:10, :] = 0
    clean = image_loss(image, target, mask, ssim_weight=0.2)
    hidden = image.clone()
    hidden[3, 3] = torch.nan
    assert torch.equal(image_loss(hidden, target, mask, ssim_weight=0.2).grad_image, clean.grad_image)
    shown = image.clone()
    shown[25, 3] = torch.nan
    result = image_loss(shown, target, mask)
    assert torch.isnan(result.loss)
    assert torch.isnan(result.grad_image).all(dim=2).sum() == 1


def test_frame_loss_is_deterministic():
    tensors = frame((512, 640))
    for a, b in zip(frame_loss(*tensors, 0.2, 0.5), frame_loss(*tensors, 0.2, 0.5), strict=True):
        assert torch.equal(a, b)


def test_frame_loss_independent_of_memory_layout():
    image, alphas, target, mask, target_depth = frame((31, 44))
    expected = frame_loss(image, alphas, target, mask, target_depth, 0.2, 0.5)
    shifted = [torch.cat([t.flatten()[:1], t.flatten()])[1:].view(t.shape) for t in (image, alphas, target, mask)]
    turned = [t.transpose(0, 1).contiguous().transpose(0, 1) for t in (image, alphas, target, mask)]
    for tensors in (shifted, turned):
        for a, b in zip(frame_loss(*tensors, target_depth, 0.2, 0.5), expected, strict=True):
            assert torch.equal(a, b)


def test_frame_loss_in_graph_reads_new_images():
    tensors = frame((64, 80))
    frame_loss(*tensors, 0.2, 0.5)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = frame_loss(*tensors, 0.2, 0.5)
    for mine, new in zip(tensors, frame((64, 80), seed=7), strict=True):
        mine.copy_(new)
    graph.replay()
    for a, b in zip(captured, frame_loss(*tensors, 0.2, 0.5), strict=True):
        assert torch.equal(a, b)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_image_loss_ops_pass_opcheck():
    image, target, mask, depth, target_depth = scene((12, 9, 3))
    image.requires_grad_()
    torch.library.opcheck(torch.ops.gsplat_core.image_loss, (image, target, mask, depth, target_depth, 0.2, 0.5))
    torch.library.opcheck(torch.ops.gsplat_core.frame_loss, (*frame((12, 9)), 0.2, 0.5))
    torch.library.opcheck(torch.ops.gsplat_core.frame_loss, (*frame((12, 9)), 0.2, 0.5, True))


def test_frame_loss_rejects_invalid_inputs():
    image, alphas, target, mask, _ = frame((4, 5))
    with pytest.raises(InvalidInput, match="CUDA"):
        frame_loss(image.cpu(), alphas, target)
    with pytest.raises(InvalidInput, match="float64"):
        frame_loss(image.double(), alphas, target)
    with pytest.raises(InvalidInput, match="mask must be"):
        frame_loss(image, alphas, target, mask.T)
    with pytest.raises(InvalidInput, match="ssim_weight"):
        frame_loss(image, alphas, target, mask, None, 1.5)
    with pytest.raises(RuntimeError, match="same CUDA device"):
        frame_loss(image, alphas.cpu(), target)
