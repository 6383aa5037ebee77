"""Splat regression: closed-form losses, the Bures-Wasserstein distance, birth-death moves and fits."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import InvalidInput, reference, regression
from gsplat_core.errors import InvalidSetting
from gsplat_core.regression import (
    BirthDeath,
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


def test_regression_loss_and_gradients_equal_autograd(device, assert_near):
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


def test_regression_gradients_divided_by_mass():
    splats = random_splats()
    _, gradients = loss_and_gradients(splats, *bumps(1, channels=2))
    divided = gradients.divided_by_mass(splats.masses)
    torch.testing.assert_close(divided.centres * splats.masses[:, None], gradients.centres)
    torch.testing.assert_close(divided.factors * splats.masses[:, None, None], gradients.factors)


def test_birth_death_probabilities_by_distance_from_mean():
    phi = torch.tensor([-1.0, 0.0, 1.0, torch.nan])
    death, birth = probabilities(phi, 0.5)
    spread = math.sqrt(2 / 3)
    torch.testing.assert_close(death, torch.tensor([0, 0, 1 - math.exp(-0.5 / spread), 0]))
    torch.testing.assert_close(birth, torch.tensor([1 - math.exp(-0.5 / spread), 0, 0, 0]))
    assert not any(p.any() for p in probabilities(torch.ones(4), 0.5))


def test_births_replace_deaths_one_to_one():
    phi = torch.randn(2000, generator=torch.Generator().manual_seed(1))
    moves = births_and_deaths(phi, 0.5, torch.Generator().manual_seed(2))
    assert 100 < len(moves.dying) == len(moves.parents)
    assert (phi[moves.dying] > phi.mean()).all()
    assert (phi[moves.parents] < phi.mean()).all()
    assert len(moves.dying.unique()) == len(moves.dying)
    assert len(births_and_deaths(torch.ones(5), 0.5, torch.Generator()).dying) == 0


def fitting(seed=5):
    """A fit whose splats are all near the origin, with a target that is 0 but for one distant bump."""
    g = torch.Generator().manual_seed(seed)
    points = torch.rand(300, 2, generator=g)
    values = torch.exp(-(points - torch.tensor([0.8, 0.7])).square().sum(-1, keepdim=True) / 0.005)
    start = Splats(0.05 * torch.rand(6, 2, generator=g), 0.05 * torch.eye(2).repeat(6, 1, 1), torch.full((6, 1), 1e-3))
    return regression._Fitting(points, values, start, FitOptions(), g), points, values


def test_regression_copies_placed_at_largest_loss_slope(monkeypatch):
    monkeypatch.setattr(regression, "BIRTH_PLACES", 300)
    fit_, points, values = fitting()
    parents = torch.tensor([2, 4])
    state = fit_._random.get_state()
    places = fit_._places(parents)
    fit_._random.set_state(state)
    drawn = points[torch.randint(300, (2, 300), generator=fit_._random)]
    splats = fit_._splats
    for place, candidates, parent in zip(places, drawn, parents, strict=True):
        value = torch.zeros(300, 1, dtype=torch.float64, requires_grad=True)
        alone = reference.splat_regression(
            points.double(), candidates.double(), splats.factors[parent].double().repeat(300, 1, 1), value
        )
        off = splats(points).double() - values.double()
        (slopes,) = torch.autograd.grad((off * alone).sum(), value)
        assert torch.equal(place, candidates[slopes[:, 0].abs().argmax()])
    assert ((places - torch.tensor([0.8, 0.7])).norm(dim=1) < 0.1).all()


def test_regression_copies_share_shape_and_value_of_parent():
    fit_, points, _ = fitting()
    before = fit_._splats.factors.clone(), fit_._splats.values.clone(), fit_._splats.centres.clone()
    fit_._first[0][3], fit_._second[2][3] = 7.0, 9.0
    fit_._move(BirthDeath(torch.tensor([0, 5, 1]), torch.tensor([3, 3, 4])))
    splats = fit_._splats
    torch.testing.assert_close(
        splats.values[[0, 5, 3, 1, 4, 2]],
        before[1][[3, 3, 3, 4, 4, 2]] / torch.tensor([[3.0], [3], [3], [2], [2], [1]]),
    )
    torch.testing.assert_close(splats.factors[[0, 5, 1]], before[0][[3, 3, 4]])
    torch.testing.assert_close(splats.centres[2:5], before[2][2:5])
    assert ((splats.centres[[0, 5, 1], None] == points).all(-1).sum(1) == 1).all()
    assert (fit_._first[0][[0, 5]] == 7).all() and (fit_._second[2][[0, 5]] == 9).all()
    fit_._move(BirthDeath(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)))
    torch.testing.assert_close(splats.values, fit_._splats.values)


@pytest.mark.slow
def test_regression_fit_escapes_start_in_corner(device):
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
    assert float(fitted.losses[-1]) < 0.01 * float(fitted.losses[0])
    again = fit(points, values, start=start, options=FitOptions(steps=600))
    assert torch.equal(fitted.losses, again.losses)
    torch.testing.assert_close((fitted.splats(points) - values).square().sum().cpu() / len(points), fitted.losses[-1])


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_regression_fit_without_start_in_every_dimension(dims):
    points, values = bumps(1, 200, dims, 3)
    fitted = fit(points, values, 30, FitOptions(steps=150, start_width=0.15))
    assert fitted.losses.shape == (151,)
    assert float(fitted.losses[-1]) < 0.5 * float(fitted.losses[0])


def test_regression_rejects_invalid_arguments():
    points, values = bumps(1)
    with pytest.raises(InvalidInput, match=r"got \[300, 2\] and \[10, 1\]"):
        fit(points, values[:10])
    with pytest.raises(InvalidInput, match="count is 0"):
        fit(points, values, 0)
    with pytest.raises(InvalidInput, match="1 of 300 values are NaN or infinite"):
        fit(points, values.index_fill(0, torch.tensor([7]), math.nan))
    two_channels = random_splats(channels=2)  # one channel of targets would be broadcast to both
    with pytest.raises(InvalidInput, match=r"targets must be .* = \[300, 2\], got \[300, 1\]"):
        fit(points, values, start=two_channels)
    with pytest.raises(InvalidInput, match=r"targets must be .* got \[300\]"):
        loss_and_gradients(random_splats(channels=1), points, values[:, 0])
    with pytest.raises(InvalidSetting, match="birth_until is 2"):
        FitOptions(birth_until=2)
