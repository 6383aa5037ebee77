"""The C++ basis-field ops against their definition in plain torch."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.basis_field import (
    basis_field,
    basis_field_backward,
    basis_field_backward_adam_,
)

RATES = (1e-2, 2e-3, 3e-3, 4e-3, 5e-4, 6e-4)


def bumps(n, b, dtype=torch.float32, seed=0):
    random = torch.Generator().manual_seed(seed)
    centers = torch.arange(b, dtype=torch.float64).repeat(n, 1) + 0.3 * torch.randn(n, b, generator=random).double()
    log_widths = 0.3 * torch.randn(n, b, generator=random)
    weights = torch.randn(n, b, 13, generator=random)
    return tuple(t.to(dtype) for t in (centers, log_widths, weights))


def gradient_of(n, seed=1):
    return torch.randn(n, 13, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("n", [0, 1, 2500])
@pytest.mark.parametrize("b", [1, 4, 16, 26, 33])
def test_basis_field_forward_and_backward_equal_reference(n, b):
    field = bumps(n, b)
    gradient = gradient_of(n)
    for tau in (-3.0, 0.0, b / 2, b + 30.0):
        torch.testing.assert_close(basis_field(*field, tau), reference.basis_field(*field, tau), rtol=1e-5, atol=1e-5)
        seen = basis_field_backward(gradient, *field, tau)
        wanted = reference.basis_field_backward(gradient, *field, tau)
        for s, w in zip(seen, wanted, strict=True):
            torch.testing.assert_close(s, w, rtol=5e-5, atol=2e-5)
        active = ~(((tau - field[0]) * torch.exp(-field[1])).abs() > 4.0)
        assert all((s[~active] == 0).all() for s in seen)


def test_basis_field_reference_passes_gradcheck():
    centers, log_widths, weights = (t.requires_grad_() for t in bumps(3, 6, torch.float64))
    assert torch.autograd.gradcheck(lambda c, l, w: reference.basis_field(c, l, w, 2.2), (centers, log_widths, weights))
    gradient = gradient_of(3).double()
    reference.basis_field(centers, log_widths, weights, 2.2).backward(gradient)
    by_hand = reference.basis_field_backward(gradient, centers, log_widths, weights, 2.2)
    for parameter, wanted in zip((centers, log_widths, weights), by_hand, strict=True):
        torch.testing.assert_close(parameter.grad, wanted)


def test_basis_field_autograd_uses_compiled_backward():
    field = tuple(t.requires_grad_() for t in bumps(20, 10))
    gradient = gradient_of(20)
    basis_field(*field, 4.4).backward(gradient)
    for parameter, wanted in zip(field, reference.basis_field_backward(gradient, *field, 4.4), strict=True):
        torch.testing.assert_close(parameter.grad, wanted.detach(), rtol=5e-5, atol=5e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_basis_field_ops_pass_opcheck():
    field = tuple(t.requires_grad_() for t in bumps(5, 7))
    tau, rates = torch.tensor([3.0]), torch.tensor(RATES)
    for padded in (False, True):
        torch.library.opcheck(torch.ops.gsplat_core.basis_field.default, (*field, tau, padded))
    plain = bumps(5, 7)
    torch.library.opcheck(torch.ops.gsplat_core.basis_field_backward.default, (gradient_of(5), *plain, tau))
    moments = [torch.zeros_like(t) for t in (*plain, *plain)]
    steps = torch.zeros(5, 7, dtype=torch.int32)
    torch.library.opcheck(
        torch.ops.gsplat_core.basis_field_backward_adam_.default,
        (gradient_of(5), tau, *plain, *moments, steps, rates, 0.9, 0.999, 1e-8),
    )


def training_state(n, b, dtype=torch.float32):
    field = bumps(n, b, dtype)
    return field, [torch.zeros_like(t) for t in field], [torch.zeros_like(t) for t in field]


@pytest.mark.parametrize(("n", "b"), [(0, 5), (1, 4), (300, 26)])
def test_basis_field_fused_adam_equals_reference_over_many_steps(n, b):
    seen, seen_m, seen_v = training_state(n, b)
    wanted, wanted_m, wanted_v = training_state(n, b, torch.float64)
    seen_steps, wanted_steps = torch.zeros(n, b, dtype=torch.int32), torch.zeros(n, b, dtype=torch.int32)
    for step in range(12):
        gradient, tau = gradient_of(n, step), (step % 4) * 1.37
        basis_field_backward_adam_(gradient, tau, seen, seen_m, seen_v, seen_steps, RATES)
        reference.basis_field_backward_adam_(gradient.double(), tau, wanted, wanted_m, wanted_v, wanted_steps, RATES)
    assert torch.equal(seen_steps, wanted_steps)
    for s, w, rate in zip(seen, wanted, (5e-4, 6e-4, 1e-2), strict=True):
        # Adam divides by the gradient's own size, so a gradient near zero may differ by a part of one step.
        difference = (s.double() - w).abs()
        assert difference.numel() == 0 or difference.max() < 0.5 * rate
        assert difference.numel() == 0 or difference.mean() < 1e-3 * rate


def test_basis_field_adam_leaves_hidden_gaussians_unchanged():
    seen, m, v = training_state(50, 7)
    steps = torch.zeros(50, 7, dtype=torch.int32)
    basis_field_backward_adam_(gradient_of(50), 3.0, seen, m, v, steps, RATES)
    before = [t.clone() for t in (*seen, *m, *v, steps)]
    hidden = gradient_of(50, 1)
    hidden[::2] = 0
    basis_field_backward_adam_(hidden, 3.0, seen, m, v, steps, RATES)
    after = (*seen, *m, *v, steps)
    assert all(torch.equal(a[::2], b[::2]) for a, b in zip(after, before, strict=True))
    assert not any(torch.equal(a[1::2], b[1::2]) for a, b in zip(after, before, strict=True))


def test_basis_field_fused_adam_equals_torch_adam_with_all_bumps_active():
    seen, m, v = training_state(50, 3)
    wanted = [t.clone().requires_grad_() for t in seen]
    optimiser = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(wanted, (1e-3, 2e-3, 3e-3), strict=True)])
    steps = torch.zeros(50, 3, dtype=torch.int32)
    for step in range(5):
        gradient = gradient_of(50, step)
        basis_field_backward_adam_(gradient, 1.0, seen, m, v, steps, (3e-3, 3e-3, 3e-3, 3e-3, 1e-3, 2e-3))
        optimiser.zero_grad()
        reference.basis_field(*wanted, 1.0).backward(gradient)
        optimiser.step()
    for s, w in zip(seen, wanted, strict=True):
        torch.testing.assert_close(s, w.detach(), rtol=1e-4, atol=3e-5)


def test_basis_field_adam_leaves_inactive_bumps_unchanged():
    field, m, v = training_state(40, 26)
    before = [t.clone() for t in field]
    steps = torch.zeros(40, 26, dtype=torch.int32)
    basis_field_backward_adam_(gradient_of(40), 3.0, field, m, v, steps, RATES)
    inactive = ((3.0 - before[0]) * torch.exp(-before[1])).abs() > 4.001
    assert inactive.any() and (steps[inactive] == 0).all()
    for tensor, old in zip(field, before, strict=True):
        assert torch.equal(tensor[inactive], old[inactive])
        assert not torch.equal(tensor, old)
    for moment in (*m, *v):
        assert (moment[inactive] == 0).all()


def test_basis_field_nan_affects_only_own_gaussian_while_active():
    for which in (0, 1, 2):
        field = bumps(9, 20)
        field[which][4, 2] = float("nan")
        for function in (basis_field, reference.basis_field):
            deltas = function(*field, 2.0)
            assert deltas[4].isnan().all()
            assert deltas[[0, 1, 2, 3, 5, 6, 7, 8]].isfinite().all()
    assert basis_field(*field, 18.0).isfinite().all(), "the NaN weight is of a bump far from this time"


def test_basis_field_padding_is_ignored():
    field = bumps(50, 26)
    padded = basis_field(*field, 3.0, padded=True)
    assert torch.equal(padded[:, :13], basis_field(*field, 3.0)) and (padded[:, 13:] == 0).all()
    assert torch.equal(reference.basis_field(*field, 3.0, padded=True)[:, 13:], torch.zeros(50, 3))
    gradient = gradient_of(50)
    wide = torch.cat([gradient, torch.full((50, 3), torch.nan)], 1)
    tau = torch.tensor([3.0])
    for function in (basis_field_backward, reference.basis_field_backward):
        for narrow, same in zip(function(gradient, *field, 3.0), function(wide, *field, tau), strict=True):
            assert torch.equal(narrow, same)
    for function in (basis_field_backward_adam_, reference.basis_field_backward_adam_):
        results = []
        for g, time, rates in ((gradient, 3.0, RATES), (wide, tau, torch.tensor(RATES))):
            state, m, v = training_state(50, 26)
            steps = torch.zeros(50, 26, dtype=torch.int32)
            function(g, time, state, m, v, steps, rates)
            results.append((*state, *m, *v, steps))
        assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("bad", [float("nan"), float("-inf"), 1e30])
@pytest.mark.parametrize("function", [basis_field_backward_adam_, reference.basis_field_backward_adam_])
def test_basis_field_adam_skips_gaussian_with_non_finite_gradient(function, bad):
    field, m, v = training_state(20, 7)
    steps = torch.zeros(20, 7, dtype=torch.int32)
    function(gradient_of(20), 3.0, field, m, v, steps, RATES)
    before = [t.clone() for t in (*field, *m, *v, steps)]
    gradient = gradient_of(20, 1)
    gradient[::3, 5] = bad  # 1e30 is finite, and its square is not
    function(gradient, 3.0, field, m, v, steps, RATES)
    for now, old in zip((*field, *m, *v, steps), before, strict=True):
        assert torch.equal(now[::3], old[::3]) and now.isfinite().all()
        assert not torch.equal(now[1::3], old[1::3])


def test_basis_field_extreme_widths_do_not_overflow():
    field = bumps(3, 4)
    field[1][0, :] = 500.0
    field[1][1, :] = -500.0
    for tau in (0.5, 7.7):
        torch.testing.assert_close(basis_field(*field, tau), reference.basis_field(*field, tau), rtol=2e-5, atol=2e-6)


def test_basis_field_independent_of_thread_count():
    def train(threads):
        old = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            field, m, v = training_state(5000, 12)
            steps = torch.zeros(5000, 12, dtype=torch.int32)
            basis_field_backward_adam_(gradient_of(5000), 3.0, field, m, v, steps, RATES)
            return (*field, basis_field(*field, 3.3), *basis_field_backward(gradient_of(5000), *field, 3.3))
        finally:
            torch.set_num_threads(old)

    assert all(torch.equal(a, b) for a, b in zip(train(1), train(2), strict=True))


def test_basis_field_rejects_invalid_inputs():
    centers, log_widths, weights = field = bumps(3, 4)
    with pytest.raises(InvalidInput, match=r"\[3, 4, 12\]"):
        basis_field(centers, log_widths, weights[..., :12], 0.0)
    with pytest.raises(InvalidInput, match=r"float64.*gsplat_core\.reference"):
        basis_field(centers.double(), log_widths, weights, 0.0)
    with pytest.raises(InvalidInput, match=r"\[3, 13\] or \[3, 16\]"):
        basis_field_backward(gradient_of(2), centers, log_widths, weights, 0.0)
    with pytest.raises(InvalidInput, match=r"tau must be 1 float32 .*\[2\]"):
        basis_field(centers, log_widths, weights, torch.zeros(2))
    moments = [torch.zeros_like(t) for t in field]
    with pytest.raises(InvalidInput, match="6 numbers, got 5"):
        basis_field_backward_adam_(
            gradient_of(3), 0.0, field, moments, moments, torch.zeros(3, 4, dtype=torch.int32), RATES[:5]
        )
    with pytest.raises(InvalidInput, match="int32"):
        basis_field_backward_adam_(gradient_of(3), 0.0, field, moments, moments, torch.zeros(3, 4), RATES)
