"""The basis field on CUDA against the reference in float64: values, gradients, Adam, capture, and the field that uses them."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.deformation import BasisField, BasisRates
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.basis_field import (
    basis_field,
    basis_field_add_colours_,
    basis_field_backward,
    basis_field_backward_adam_,
    basis_field_move_to_,
)
from gsplat_core.scene.gaussians import Gaussians

RATES = (1e-2, 2e-3, 3e-3, 4e-3, 5e-4, 6e-4)


def bumps(n, b, seed=0):
    random = torch.Generator().manual_seed(seed)
    centers = torch.arange(b, dtype=torch.float32).repeat(n, 1) + 0.3 * torch.randn(n, b, generator=random)
    return centers, 0.3 * torch.randn(n, b, generator=random), torch.randn(n, b, 13, generator=random)


def gradient_of(n, seed=1, columns=13):
    return torch.randn(n, columns, generator=torch.Generator().manual_seed(seed))


def training_state(n, b, convert):
    field = [convert(t) for t in bumps(n, b)]
    moments = [[torch.zeros_like(t) for t in field] for _ in range(2)]
    return field, *moments, torch.zeros_like(field[0], dtype=torch.int32)


@pytest.mark.parametrize("n", [0, 1, 2503])
@pytest.mark.parametrize("b", [1, 4, 26, 33, 100])
def test_basis_field_forward_and_backward_equal_reference(gpu, n, b):
    field = bumps(n, b)
    ours, exact = [t.to(gpu) for t in field], [t.double() for t in field]
    for tau in (-3.0, 0.0, b / 2, b + 30.0):  # at the last none is active
        for padded in (False, True):
            wanted = reference.basis_field(*exact, tau, padded=padded)
            deltas = basis_field(*ours, torch.tensor([tau], device=gpu), padded=padded)
            torch.testing.assert_close(deltas.cpu().double(), wanted, rtol=1e-5, atol=1e-5)
            assert torch.equal(deltas, basis_field(*ours, tau, padded=padded))
            gradient = gradient_of(n, columns=16 if padded else 13)
            seen = basis_field_backward(gradient.to(gpu), *ours, tau)
            for s, w in zip(seen, reference.basis_field_backward(gradient.double(), *exact, tau), strict=True):
                torch.testing.assert_close(s.cpu().double(), w, rtol=5e-5, atol=2e-5)


@pytest.mark.parametrize("n", [0, 1, 2503])
@pytest.mark.parametrize("b", [1, 4, 33, 100])
def test_basis_field_add_colours_equals_reference(gpu, n, b):
    centers, log_widths, weights = bumps(n, b)
    change = gradient_of(n, columns=3)
    change[::7] = torch.nan
    centers[3::11, 0] = torch.nan
    for tau in (-9.0, 0.0, b / 2, b + 30.0):
        wanted, seen = weights.double(), weights.to(gpu)
        reference.basis_field_add_colours_(centers.double(), log_widths.double(), wanted, tau, change.double())
        time = torch.tensor([tau], device=gpu)
        basis_field_add_colours_(centers.to(gpu), log_widths.to(gpu), seen, time, change.to(gpu))
        near = (seen.cpu().double() - wanted).abs() <= 1e-4 + 1e-4 * wanted.abs()
        # Bumps whose squares add up to just about the least that is asked for may fall on either side.
        assert float(near.flatten(1).all(1).double().mean() if n else 1.0) >= 0.998


@pytest.mark.parametrize("n", [0, 1, 2503])
@pytest.mark.parametrize("b", [1, 4, 33, 100])
def test_basis_field_move_to_equals_reference(gpu, n, b):
    centers, log_widths, weights = bumps(n, b)
    target = gradient_of(n)
    target[::7, 5] = torch.nan
    centers[3::11, 0] = torch.nan
    weights[4::13, 0, 2] = torch.inf
    for tau in (-9.0, 0.0, b / 2, b + 30.0):
        wanted, seen = weights.double(), weights.to(gpu)
        reference.basis_field_move_to_(centers.double(), log_widths.double(), wanted, tau, target.double())
        time = torch.tensor([tau], device=gpu)
        basis_field_move_to_(centers.to(gpu), log_widths.to(gpu), seen, time, target.to(gpu))
        seen = seen.cpu().double()
        near = ((seen - wanted).abs() <= 1e-4 + 1e-4 * wanted.abs()) | (seen == wanted)
        # Bumps whose squares add up to just about the least that is asked for may fall on either side.
        assert float(near.flatten(1).all(1).double().mean() if n else 1.0) >= 0.998


def test_basis_field_autograd_uses_compiled_backward(gpu):
    field = [t.to(gpu).requires_grad_() for t in bumps(20, 10)]
    gradient = gradient_of(20).to(gpu)
    basis_field(*field, 4.4).backward(gradient)
    for parameter, wanted in zip(field, basis_field_backward(gradient, *(p.detach() for p in field), 4.4), strict=True):
        assert torch.equal(parameter.grad, wanted)


@pytest.mark.parametrize(("n", "b"), [(0, 5), (1, 4), (300, 26), (50, 70)])
def test_basis_field_fused_adam_equals_reference_and_is_deterministic(gpu, n, b):
    exact = training_state(n, b, lambda t: t.double())
    twins = [training_state(n, b, lambda t: t.to(gpu)) for _ in range(2)]
    for step in range(12):
        gradient, tau = gradient_of(n, step), (step % 4) * 1.37
        gradient[::5] = 0
        gradient[3::7, 4] = torch.nan
        wide = torch.cat([gradient, torch.full((n, 3), torch.nan)], 1).to(gpu)
        reference.basis_field_backward_adam_(gradient.double(), tau, *exact, RATES)
        basis_field_backward_adam_(gradient.to(gpu), tau, *twins[0], RATES)
        times = torch.tensor([0.0, tau], device=gpu)[1:]  # a view that is aligned to 4 bytes only
        rates = torch.tensor([0.0, *RATES], device=gpu)[1:]
        basis_field_backward_adam_(wide, times, *twins[1], rates)
    ours, same = ((*t[0], *t[1], *t[2], t[3]) for t in twins)
    assert all(torch.equal(a, b) for a, b in zip(ours, same, strict=True))
    assert torch.equal(twins[0][3].cpu(), exact[3])
    for s, w, rate in zip(twins[0][0], exact[0], (5e-4, 6e-4, 1e-2), strict=True):
        # Adam divides by the gradient's own size, so a gradient near zero may differ by a part of one step.
        difference = (s.cpu().double() - w).abs()
        assert difference.numel() == 0 or (difference.max() < 0.5 * rate and difference.mean() < 1e-3 * rate)
    for ours_moments, wanted_moments in zip(twins[0][1:3], exact[1:3], strict=True):
        for s, w in zip(ours_moments, wanted_moments, strict=True):
            torch.testing.assert_close(s.cpu().double(), w, rtol=2e-3, atol=2e-4)


def test_basis_field_adam_bias_correction_at_high_step_counts(gpu):
    exact, ours = training_state(4, 5, lambda t: t.double()), training_state(4, 5, lambda t: t.to(gpu))
    for state in (exact, ours):
        state[3].copy_(torch.tensor([0, 1, 50, 1_000_000])[:, None].expand(4, 5))
    gradient = gradient_of(4)
    before = [t.clone() for t in exact[0]]
    reference.basis_field_backward_adam_(gradient.double(), 2.0, *exact, RATES)
    basis_field_backward_adam_(gradient.to(gpu), 2.0, *ours, RATES)
    step = (exact[0][2] - before[2]).abs()
    assert ((ours[0][2].cpu().double() - exact[0][2]).abs() < 1e-4 * step + 1e-6).all()


def test_basis_field_captured_step_reads_current_time_and_rates(gpu):
    state, fused = (training_state(200, 26, lambda t: t.to(gpu)) for _ in range(2))
    tau, rates = torch.zeros(1, device=gpu), torch.zeros(6, device=gpu)
    gradient = gradient_of(200, columns=16).to(gpu)

    def step():
        deltas = basis_field(*state[0], tau, padded=True)
        basis_field_backward_adam_(gradient, tau, *state, rates)
        return deltas

    first = [t.clone() for t in (*state[0], *state[1], *state[2], state[3])]
    step()
    for tensor, old in zip((*state[0], *state[1], *state[2], state[3]), first, strict=True):
        tensor.copy_(old)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    for time, scale in ((3.0, 1.0), (7.5, 0.5), (40.0, 1.0)):
        tau.fill_(time)
        rates.copy_(scale * torch.tensor(RATES))
        graph.replay()
        deltas = basis_field(*fused[0], time, padded=True)
        assert torch.equal(captured, deltas)
        basis_field_backward_adam_(gradient, time, *fused, [scale * r for r in RATES])
    for a, b in zip(
        (*state[0], *state[1], *state[2], state[3]), (*fused[0], *fused[1], *fused[2], fused[3]), strict=True
    ):
        assert torch.equal(a, b)


def test_basis_field_nan_affects_only_own_gaussian_while_active(gpu):
    for which in (0, 1, 2):
        field = [t.to(gpu) for t in bumps(9, 20)]
        field[which][4, 2] = torch.nan
        deltas = basis_field(*field, 2.0)
        assert deltas[4].isnan().all() and deltas[[0, 1, 2, 3, 5, 6, 7, 8]].isfinite().all()
    assert basis_field(*field, 18.0).isfinite().all(), "the NaN weight is of a bump far from this time"


def test_basis_field_extreme_widths_do_not_overflow(gpu):
    field = bumps(3, 4)
    field[1][0, :], field[1][1, :] = 500.0, -500.0
    for tau in (0.5, 7.7):
        actual = basis_field(*(t.to(gpu) for t in field), tau).cpu()
        torch.testing.assert_close(actual, reference.basis_field(*field, tau), rtol=2e-5, atol=2e-6)


def test_basis_field_accepts_non_contiguous_inputs(gpu):
    centers, log_widths, weights = (t.to(gpu) for t in bumps(33, 26))
    expected = basis_field(centers, log_widths, weights, 5.0)
    strided = weights.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert torch.equal(basis_field(centers.T.contiguous().T, log_widths, strided, 5.0), expected)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_basis_field_ops_pass_opcheck(gpu):
    field, m, v, steps = training_state(5, 7, lambda t: t.to(gpu))
    ops, tau, gradient = torch.ops.gsplat_core, torch.full((1,), 3.0, device=gpu), gradient_of(5).to(gpu)
    leaves = [t.clone().requires_grad_() for t in field]
    torch.library.opcheck(ops.basis_field.default, (*leaves, tau, True))
    torch.library.opcheck(ops.basis_field_backward.default, (gradient, *field, tau))
    rates = torch.tensor(RATES, device=gpu)
    torch.library.opcheck(
        ops.basis_field_backward_adam_.default,
        (gradient, tau, *field, *m, *v, steps, rates, 0.9, 0.999, 1e-8),
    )


def test_basis_field_rejects_invalid_inputs(gpu):
    field = [t.to(gpu) for t in bumps(3, 4)]
    with pytest.raises(InvalidInput, match=r"tau must be 1 float32 on cuda:0, got .* on cpu"):
        basis_field(*field, torch.zeros(1))
    with pytest.raises(InvalidInput, match="one device"):
        basis_field(field[0], field[1].cpu(), field[2], 0.0)
    with pytest.raises(InvalidInput, match=r"float64.*gsplat_core\.reference"):
        basis_field(field[0].double(), *field[1:], 0.0)


def test_basis_field_training_and_growth_equal_cpu(gpu):
    here, there = BasisField(40, (0.0, 1.0)), BasisField(40, (0.0, 1.0)).to(gpu)
    for step, time_s in enumerate((0.1, 0.9, 1.4, 1.6)):
        if step == 2:
            keep = torch.arange(0, 40, 2)
            for field, device in ((here, "cpu"), (there, gpu)):
                field.select(keep.to(device))
                field.append(7)
                field.append(3, parents=torch.arange(3, device=device))
                field.extend((0.2, 1.8), hold_at_s=0.9)
        gradient = gradient_of(here.count, step)
        for field in (here, there):
            field.adam_step(time_s, gradient.to(field.weights.device), BasisRates())
    for ours, wanted in zip(there.training_tensors(), here.training_tensors(), strict=True):
        assert ours.device == gpu
        # On a GPU there is capacity behind the bumps and Gaussians that are in use.
        in_use = ours[tuple(slice(0, size) for size in wanted.shape)]
        torch.testing.assert_close(in_use.cpu(), wanted, rtol=1e-3, atol=1e-5)
    gaussians = Gaussians(*(torch.zeros(30, *s) for s in ((3,), (4,), (3,), (), (1, 3)))).to(gpu)
    tau = torch.full((1,), there.frame_time(1.3), device=gpu)
    torch.testing.assert_close(
        there.frame_deltas(gaussians)(tau)[:, :13].cpu(), here.deltas(1.3).detach(), rtol=1e-3, atol=1e-5
    )


@pytest.mark.filterwarnings("ignore:Synchronization debug mode:UserWarning")
def test_basis_field_adam_step_does_not_synchronise(gpu):
    field = BasisField(40, (0.0, 1.0)).to(gpu)
    gradient = gradient_of(40).to(gpu)
    field.adam_step(0.5, gradient, BasisRates())
    try:
        torch.cuda.set_sync_debug_mode("error")
        field.adam_step(0.5, gradient, BasisRates())
        field.deltas(0.3)
    finally:
        torch.cuda.set_sync_debug_mode("default")
