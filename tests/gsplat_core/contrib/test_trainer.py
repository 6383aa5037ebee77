"""Losses and colour corrections of gsplat's example trainers, next to sums in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import contrib
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ssim import fused_ssim


def draw(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_l1_and_mse_loss_return_elementwise_differences():
    own, other = draw(2, 5, 3), draw(2, 5, 3, seed=1)
    assert torch.equal(contrib.l1_loss(own, other), (own - other).abs())
    assert torch.equal(contrib.mse_loss(own, other), (own - other) ** 2)


def test_ssim_loss_equals_fused_ssim_with_window_of_11_pixels():
    own, other = draw(1, 3, 20, 24).float().requires_grad_(), draw(1, 3, 20, 24, seed=1).float()
    loss = contrib.ssim_loss(own, other)
    assert loss.item() == pytest.approx(1 - fused_ssim(own, other).item())
    loss.backward()
    assert own.grad.any()
    with pytest.raises(InvalidInput, match="window_size must be 11 pixels, got 7"):
        contrib.ssim_loss(own, other, 7)


def test_depth_l1_loss_compares_inverse_depths():
    own = torch.tensor([2.0, 0.0, 4.0, -1.0], requires_grad=True)
    loss = contrib.depth_l1_loss(own, torch.tensor([4.0, 2.0, 0.0, 0.0]), scene_scale=3.0)
    assert loss.item() == pytest.approx(3 * (0.25 + 0.5 + 0.25 + 0) / 4)
    loss.backward()
    assert own.grad.tolist() == pytest.approx([-3 / 4 / 4, 0, -3 / 4 / 16, 0])


def test_opacity_and_scale_regularisers_are_means_of_activated_values():
    assert contrib.opacity_reg_loss(torch.tensor([0.0, 100.0])).item() == pytest.approx(0.75)
    assert contrib.scale_reg_loss(torch.tensor([[0.0, 0, 0], [1, 1, 1]])).item() == pytest.approx((1 + torch.e) / 2)


@pytest.mark.parametrize("shape", [(2, 3, 4, 5), (2, 3, 4, 1), (5, 7, 2, 3, 4)])
def test_total_variation_loss_is_sum_of_mean_squares(shape):
    values = draw(*shape)
    expected = 0.0
    for i in range(2, len(shape)):
        squares = [float(((values.select(i, k + 1) - values.select(i, k)) ** 2).mean()) for k in range(shape[i] - 1)]
        expected += sum(squares) / max(1, len(squares))
    assert contrib.total_variation_loss(values).item() == pytest.approx(expected)
    assert contrib.total_variation_loss(draw(2, 3, 1, 1)).item() == 0


def test_color_correct_affine_reverts_affine_change():
    ref = 0.2 + 0.5 * draw(1, 12, 9, 3)
    gain, shift = (
        torch.tensor([0.8, 1.2, 0.5], dtype=torch.float64),
        torch.tensor([0.1, -0.05, 0.3], dtype=torch.float64),
    )
    torch.testing.assert_close(contrib.color_correct_affine(ref * gain + shift, ref), ref)
    flat = torch.full_like(ref, 0.4)
    assert contrib.color_correct_affine(flat, ref).isfinite().all()
    with pytest.raises(InvalidInput, match="shapes must match"):
        contrib.color_correct_affine(ref, ref[..., :2])


def test_color_correct_quadratic_reverts_change_ignoring_saturated_pixels():
    img = 0.1 + 0.6 * draw(40, 30, 3)
    ref = 0.05 + 0.6 * img + 0.3 * img * img.roll(1, -1)
    saturated = ref.clone()
    saturated[:5] = 1.0
    found = contrib.color_correct_quadratic(img.float(), saturated.float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), ref, rtol=0, atol=1e-5)


def test_color_correct_quadratic_single_round_equals_least_squares_fit():
    img, ref = 0.1 + 0.8 * draw(50, 3), 0.1 + 0.8 * draw(50, 3, seed=1)
    squares = torch.stack([img[:, i] * img[:, j] for i in range(3) for j in range(i, 3)], 1)
    terms = torch.cat([squares, img, torch.ones(50, 1, dtype=img.dtype)], 1)
    expected = (terms @ torch.linalg.lstsq(terms, ref).solution).clamp(0, 1)
    torch.testing.assert_close(contrib.color_correct_quadratic(img, ref, num_iters=1), expected)
    assert contrib.color_correct_quadratic(torch.full((8, 8, 3), 0.5), torch.rand(8, 8, 3)).isfinite().all()
