"""The fused image loss against the reference in float64: values, gradients, masks, targets, threads."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.image_loss import image_loss
from gsplat_core.reference.training import image_loss as reference_image_loss

SHAPES = [(1, 1, 3), (1, 37, 3), (5, 7, 3), (33, 65, 3), (18, 270, 3), (10, 11, 1)]


def scene(shape, seed=0, keep=0.7):
    generator = torch.Generator().manual_seed(seed)
    height, width, _ = shape
    image = torch.rand(shape, generator=generator)
    target = (torch.rand(shape, generator=generator) * 255).to(torch.uint8)
    mask = (torch.rand(height, width, generator=generator) < keep).to(torch.uint8)
    depth, target_depth = 20 + 60 * torch.rand(2, height, width, generator=generator)
    depth[torch.rand(height, width, generator=generator) < 0.1] = 0
    target_depth[torch.rand(height, width, generator=generator) < 0.3] = 0
    return image, target, mask, depth, target_depth


def assert_equals_reference(image, target, mask, depth, target_depth, ssim_weight, depth_weight, squared=False):
    double = lambda t: t if t is None or t.dtype == torch.uint8 else t.double()
    ours = image_loss(image, target, mask, depth, target_depth, ssim_weight, depth_weight, squared)
    expected = reference_image_loss(
        image.double(), double(target), mask, double(depth), double(target_depth), ssim_weight, depth_weight, squared
    )
    torch.testing.assert_close(ours.loss.double(), expected.loss, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(ours.terms.double(), expected.terms, rtol=1e-5, atol=1e-6)
    for ours_gradient, gradient in ((ours.grad_image, expected.grad_image), (ours.grad_depth, expected.grad_depth)):
        if gradient is None:
            assert ours_gradient is None
        else:
            scale = gradient.abs().max().clamp(min=1e-12)
            torch.testing.assert_close(ours_gradient.double() / scale, gradient / scale, rtol=0, atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_image_loss_equals_reference(shape, ssim_weight):
    for masked, deep, squared in itertools.product((True, False), repeat=3):
        image, target, mask, depth, target_depth = scene(shape)
        depths = (depth, target_depth) if deep else (None, None)
        assert_equals_reference(image, target, mask if masked else None, *depths, ssim_weight, 0.5, squared)


def test_squared_image_loss_accepts_float_target_and_matches_l1_slope():
    image, target, mask, *_ = scene((18, 270, 3))
    assert_equals_reference(image, target.float() / 255, mask, None, None, 0.2, 0.0, squared=True)
    off_by_a_hundredth = target.double() / 255 + 0.01
    squared = image_loss(off_by_a_hundredth.float(), target, mask, squared=True).grad_image
    l1 = image_loss(off_by_a_hundredth.float(), target, mask).grad_image
    torch.testing.assert_close(squared, l1, rtol=1e-4, atol=0)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 24), st.integers(1, 40), st.integers(0, 1000), st.sampled_from([0.0, 0.1, 0.9]))
def test_image_loss_equals_reference_for_any_size(height, width, seed, keep):
    image, target, mask, depth, target_depth = scene((height, width, 3), seed, keep)
    assert_equals_reference(image, target, mask, depth, target_depth, 0.2, 1.0)


def test_image_loss_equal_for_byte_and_float_target():
    image, target, mask, *_ = scene((20, 33, 3))
    for a, b in zip(
        image_loss(image, target, mask, ssim_weight=0.3),
        image_loss(image, target.float() / 255, mask, ssim_weight=0.3),
        strict=True,
    ):
        assert a is b is None or torch.equal(a, b)


def test_image_loss_accepts_any_mask_dtype_and_value():
    image, target, mask, *_ = scene((9, 14, 3))
    expected = image_loss(image, target, mask, ssim_weight=0.2).grad_image
    for other in (mask.bool(), mask.float(), mask * 255, mask.to(torch.int64)):
        assert torch.equal(image_loss(image, target, other, ssim_weight=0.2).grad_image, expected)


def test_image_loss_without_tissue_or_depth_is_zero():
    image, target, mask, depth, target_depth = scene((12, 15, 3))
    result = image_loss(image, target, torch.zeros_like(mask), depth, target_depth, 0.2, 1.0)
    assert result.loss.item() == 0
    assert not result.grad_image.any()
    assert not result.grad_depth.any()
    unknown = image_loss(image, target, mask, depth, torch.zeros_like(depth), 0.2, 1.0)
    assert unknown.terms[2].item() == 0
    assert not unknown.grad_depth.any()


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
    for result in (image_loss(shown, target, mask), image_loss(shown, target, mask, squared=True)):
        assert torch.isnan(result.loss)
        assert torch.isnan(result.grad_image).all(dim=2).sum() == 1


def test_image_loss_backward_equals_returned_gradients():
    image, target, mask, depth, target_depth = scene((17, 23, 3))
    image.requires_grad_(), depth.requires_grad_()
    result = image_loss(image, target, mask, depth, target_depth, 0.2, 0.5)
    assert not result.terms.requires_grad
    (3 * result.loss).backward()
    assert torch.equal(image.grad, 3 * result.grad_image)
    assert torch.equal(depth.grad, 3 * result.grad_depth)


def test_image_loss_independent_of_thread_count():
    arguments = *scene((200, 90, 3)), 0.2, 0.5
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(image_loss(*arguments))
    torch.set_num_threads(before)
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.parametrize("deep", [False, True])
def test_image_loss_passes_opcheck(deep):
    image, target, mask, depth, target_depth = scene((12, 9, 3))
    image.requires_grad_()
    depths = (depth.requires_grad_(), target_depth) if deep else (None, None)
    for squared in (False, True):
        torch.library.opcheck(torch.ops.gsplat_core.image_loss, (image, target, mask, *depths, 0.2, 0.5, squared))


@pytest.mark.slow
def test_image_loss_reference_passes_gradcheck():
    image, target, mask, depth, target_depth = scene((6, 7, 3))
    image, depth = image.double().requires_grad_(), depth.double().requires_grad_()
    for squared in (False, True):
        loss = lambda x, z, squared=squared: (
            reference_image_loss(x, target, mask, z, target_depth.double(), 0.3, 5.0, squared).loss
        )
        assert torch.autograd.gradcheck(loss, (image, depth), fast_mode=True)


def test_image_loss_rejects_invalid_inputs():
    image, target, mask, depth, target_depth = scene((4, 5, 3))
    with pytest.raises(InvalidInput, match=r"gsplat_core\.reference"):
        image_loss(image.double(), target)
    with pytest.raises(InvalidInput, match="mask must be"):
        image_loss(image, target, mask.T)
    with pytest.raises(InvalidInput, match="go together"):
        image_loss(image, target, mask, depth)
    with pytest.raises(InvalidInput, match="ssim_weight"):
        image_loss(image, target, mask, ssim_weight=1.5)
    with pytest.raises(InvalidInput, match="depth_weight"):
        image_loss(image, target, mask, depth, target_depth, depth_weight=float("nan"))
