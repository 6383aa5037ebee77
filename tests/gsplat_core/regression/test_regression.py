"""Splat regression: closed-form losses, the Bures-Wasserstein distance, birth-death moves and fits."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import InvalidInput, reference
from gsplat_core.errors import InvalidSetting
from gsplat_core.regression import (
    FitOptions,
    Splats,
    births_and_deaths,
    fit,
    loss_and_gradients,
    probabilities,
)


def bumps(seed, points=300, dims=2, channels=1, count=4):
    g = torch.Generator().manual_seed(seed)
    x, centres = torch.rand(points, dims, generator=g), torch.rand(count, dims, generator=g)
    heights = torch.randn(count, channels, generator=g)
    return x, torch.exp(-(x[:, None] - centres).square().sum(-1) / 0.02) @ heights


def random_splats(count=5, dims=2, channels=2):
    g = torch.Generator().manual_seed(9)
    factors = 0.3 * torch.eye(dims) + 0.1 * torch.randn(count, dims, dims, generator=g)
    return Splats(torch.rand(count, dims, generator=g), factors, torch.randn(count, channels, generator=g))


def test_the_loss_and_its_gradients_are_those_of_autograd(device, assert_near):
    points, targets = bumps(1, channels=2)
    splats = random_splats()
    loss, gradients = loss_and_gradients(
        Splats(*(t.to(device) for t in (splats.centres, splats.factors, splats.values))),
        points.to(device),
        targets.to(device),
    )
    leaves = [t.double().requires_grad_() for t in (splats.centres, splats.factors, splats.values)]
    off = targets.double() - reference.splat_regression(points.double(), *leaves)
    wanted = off.square().sum() / len(points)
    assert_near(loss.cpu(), wanted)
    for actual, expected in zip(gradients, torch.autograd.grad(wanted, leaves), strict=True):
        assert_near(actual.cpu(), expected, of_largest=1e-4)


def test_the_metric_divides_by_the_mass():
    splats = random_splats()
    _, gradients = loss_and_gradients(splats, *bumps(1, channels=2))
    divided = gradients.divided_by_mass(splats.masses)
    torch.testing.assert_close(divided.centres * splats.masses[:, None], gradients.centres)
    torch.testing.assert_close(divided.factors * splats.masses[:, None, None], gradients.factors)


def test_probabilities_follow_the_distance_from_the_mean():
    phi = torch.tensor([-1.0, 0.0, 1.0, torch.nan])
    death, birth = probabilities(phi, 0.5)
    spread = math.sqrt(2 / 3)
    torch.testing.assert_close(death, torch.tensor([0, 0, 1 - math.exp(-0.5 / spread), 0]))
    torch.testing.assert_close(birth, torch.tensor([1 - math.exp(-0.5 / spread), 0, 0, 0]))
    assert not any(p.any() for p in probabilities(torch.ones(4), 0.5))


def test_births_replace_deaths():
    phi = torch.randn(2000, generator=torch.Generator().manual_seed(1))
    moves = births_and_deaths(phi, 0.5, torch.Generator().manual_seed(2))
    assert 100 < len(moves.dying) == len(moves.parents)
    assert (phi[moves.dying] > phi.mean()).all()
    assert (phi[moves.parents] < phi.mean()).all()
    assert len(moves.dying.unique()) == len(moves.dying)
    assert len(births_and_deaths(torch.ones(5), 0.5, torch.Generator()).dying) == 0


@pytest.mark.slow
def test_a_fit_from_one_corner_leaves_it(device):
    points, values = bumps(3, points=400)
    g = torch.Generator().manual_seed(4)
    start = Splats(
        0.05 * torch.rand(24, 2, generator=g),
        0.05 * torch.eye(2).repeat(24, 1, 1),
        1e-3 * torch.randn(24, 1, generator=g),
    )
    start = Splats(*(t.to(device) for t in (start.centres, start.factors, start.values)))
    points, values = points.to(device), values.to(device)
    fitted = fit(points, values, start=start, options=FitOptions(steps=600))
    assert float(fitted.losses[-1]) < 0.2 * float(fitted.losses[0])
    again = fit(points, values, start=start, options=FitOptions(steps=600))
    assert torch.equal(fitted.losses, again.losses)
    torch.testing.assert_close((fitted.splats(points) - values).square().sum().cpu() / len(points), fitted.losses[-1])


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_a_fit_without_a_start_in_every_dimension(dims):
    points, values = bumps(1, 200, dims, 3)
    fitted = fit(points, values, 30, FitOptions(steps=150, start_width=0.15))
    assert fitted.losses.shape == (151,)
    assert float(fitted.losses[-1]) < 0.7 * float(fitted.losses[0])


def test_wrong_arguments_are_refused():
    points, values = bumps(1)
    with pytest.raises(InvalidInput, match=r"got \[300, 2\] and \[10, 1\]"):
        fit(points, values[:10])
    with pytest.raises(InvalidInput, match="count is 0"):
        fit(points, values, 0)
    with pytest.raises(InvalidSetting, match="birth_until is 2"):
        FitOptions(birth_until=2)
