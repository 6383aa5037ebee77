"""The terms of the image loss in plain torch, the oracle: values worked out by hand, gradients by finite differences, nothing from nothing."""

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.reference.training import inverse_depth_l1, masked_l1, masked_squared_error, masked_ssim_loss


def images(height=9, width=13, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    image, target = torch.rand(2, height, width, 3, generator=generator, dtype=dtype)
    mask = (torch.rand(height, width, generator=generator) > 0.3).to(torch.uint8)
    return image.requires_grad_(), target, mask


def depths(height=7, width=5, seed=1):
    generator = torch.Generator().manual_seed(seed)
    depth, target = 30 + 40 * torch.rand(2, height, width, generator=generator, dtype=torch.float64)
    return depth.requires_grad_(), target


def test_masked_l1_averages_over_tissue_only():
    image = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    target = torch.tensor([[[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    assert masked_l1(image, target, torch.tensor([[1, 0]])).item() == pytest.approx(0.1)
    assert masked_l1(image, target).item() == pytest.approx(3.3 / 6)


def test_masked_squared_error_averages_over_tissue_only():
    image = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    target = torch.tensor([[[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    assert masked_squared_error(image, target, torch.tensor([[1, 0]])).item() == pytest.approx(0.09 / 0.02 / 3)
    assert masked_squared_error(image, target).item() == pytest.approx(3.09 / 0.02 / 6)


def test_ssim_loss_zero_for_equal_images_and_ignores_masked_pixels():
    image, _, mask = images()
    assert masked_ssim_loss(image, image.detach(), mask).item() == pytest.approx(0, abs=1e-12)
    changed = torch.where(mask[..., None] != 0, image, torch.ones_like(image))
    assert masked_ssim_loss(changed, image.detach(), mask).item() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("loss", [masked_l1, masked_squared_error, masked_ssim_loss])
def test_image_losses_pass_gradcheck(loss):
    image, target, mask = images(6, 7)
    assert torch.autograd.gradcheck(lambda x: loss(x, target, mask), (image,))


@pytest.mark.parametrize("loss", [inverse_depth_l1])
def test_depth_losses_pass_gradcheck(loss):
    depth, target = depths()
    target[0, 0] = 0
    mask = torch.ones(7, 5)
    mask[3] = 0
    assert torch.autograd.gradcheck(lambda x: loss(x, target, mask), (depth,))


@pytest.mark.parametrize("loss", [masked_l1, masked_ssim_loss])
def test_image_losses_with_empty_mask_are_zero(loss):
    image, target, mask = images()
    value = loss(image, target, torch.zeros_like(mask))
    value.backward()
    assert value.item() == 0
    assert torch.equal(image.grad, torch.zeros_like(image))


@pytest.mark.parametrize("loss", [masked_l1, masked_ssim_loss])
def test_image_losses_ignore_masked_nan(loss):
    image, target, mask = images()
    with torch.no_grad():
        image[mask == 0] = torch.nan
    value = loss(image, target, mask)
    value.backward()
    assert torch.isfinite(value)
    assert torch.isfinite(image.grad).all()


@pytest.mark.parametrize("loss", [inverse_depth_l1])
def test_depth_loss_of_unknown_depth_is_zero(loss):
    depth, target = depths()
    value = loss(depth, torch.zeros_like(target))
    value.backward()
    assert value.item() == 0
    assert torch.equal(depth.grad, torch.zeros_like(depth))


def test_inverse_depth_l1_closed_form():
    depth = torch.tensor([[50.0, 20.0, 0.0]], requires_grad=True)
    target = torch.tensor([[100.0, 0.0, 40.0]])
    value = inverse_depth_l1(depth, target)
    value.backward()
    assert value.item() == pytest.approx(0.01)
    assert torch.allclose(depth.grad, torch.tensor([[-1 / 2500, 0, 0]]))


def test_image_losses_reject_mismatched_shapes():
    image, target, mask = images()
    with pytest.raises(InvalidInput, match="image and target"):
        masked_l1(image, target[:-1], mask)
    with pytest.raises(InvalidInput, match="mask must be"):
        masked_ssim_loss(image, target, mask[:-1])
