"""SE(3): twists and poses lead to each other, exactly and with gradients, also where series stand for quotients."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.poses.se3 import between, exp, hat, inverse, log

TWISTS = [
    [0.0] * 6,
    [1.0, -2.0, 3.0, 0.0, 0.0, 0.0],
    [1.0, -2.0, 3.0, 1e-9, -2e-9, 1e-9],
    [0.3, 0.2, -0.1, 9e-5, 1e-5, 0.0],
    [0.3, 0.2, -0.1, 1.2e-4, 1e-5, 0.0],
    [4.0, 5.0, -6.0, 0.5, -1.0, 0.7],
    [4.0, 5.0, -6.0, 3.1, 0.0, 0.0],
]


@pytest.mark.parametrize("twist", TWISTS)
def test_exp_is_the_matrix_exponential(twist):
    twist = torch.tensor(twist, dtype=torch.float64)
    generator = torch.zeros(4, 4, dtype=torch.float64)
    generator[:3, :3], generator[:3, 3] = hat(twist[3:]), twist[:3]
    torch.testing.assert_close(exp(twist), torch.linalg.matrix_exp(generator), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("twist", TWISTS)
def test_log_inverts_exp(twist):
    twist = torch.tensor(twist, dtype=torch.float64)
    torch.testing.assert_close(log(exp(twist)), twist, rtol=1e-9, atol=1e-11)


def test_exp_and_log_keep_leading_dimensions():
    twists = torch.tensor(TWISTS, dtype=torch.float64).reshape(7, 1, 6).expand(7, 3, 6)
    poses = exp(twists)
    assert poses.shape == (7, 3, 4, 4) and log(poses).shape == (7, 3, 6)
    torch.testing.assert_close(inverse(poses) @ poses, torch.eye(4, dtype=torch.float64).expand(7, 3, 4, 4))


@pytest.mark.parametrize("twist", [TWISTS[1], TWISTS[3], TWISTS[5]])
def test_exp_and_log_gradients(twist):
    twist = torch.tensor(twist, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(exp, twist)
    assert torch.autograd.gradcheck(lambda t: log(exp(t)), twist)


def test_exp_gradient_at_zero_is_finite():
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    exp(twist).sum().backward()
    assert twist.grad is not None and torch.isfinite(twist.grad).all()


def test_between_interpolates_poses():
    first, second = exp(torch.tensor(TWISTS[5], dtype=torch.float64)), exp(torch.tensor(TWISTS[3], dtype=torch.float64))
    torch.testing.assert_close(between(first, second, 0.0), first)
    torch.testing.assert_close(between(first, second, 1.0), second)
    half = between(first, second, 0.5)
    torch.testing.assert_close(between(half, second, 0.5), between(first, second, 0.75))
