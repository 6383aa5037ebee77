"""The Adam op against torch.optim.Adam and the reference; gradients that are not finite; threads."""

import math

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.adam import adam_step, adam_step_at_, adam_step_queued
from gsplat_core.reference.training import adam_step as reference_adam_step


def state(*shape, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    parameter = torch.randn(shape, generator=generator, dtype=dtype)
    return parameter, torch.zeros_like(parameter), torch.zeros_like(parameter)


@pytest.mark.parametrize("shape", [(), (1,), (0, 3), (7, 3), (1000, 16, 3), (70001,)])
def test_adam_step_equals_torch_adam(shape):
    parameter, first, second = state(*shape)
    other = parameter.clone().requires_grad_()
    optimiser = torch.optim.Adam([other], lr=0.02, betas=(0.9, 0.999), eps=1e-10)
    generator = torch.Generator().manual_seed(1)
    for step in range(1, 6):
        gradient = torch.randn(shape, generator=generator)
        assert adam_step(parameter, gradient, first, second, step, 0.02, (0.9, 0.999), 1e-10) == 0
        other.grad = gradient.clone()
        optimiser.step()
        torch.testing.assert_close(parameter, other.detach(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("row_size", [1, 3, 48])
def test_adam_step_equals_reference_with_non_finite_gradients(row_size):
    ours = state(2000, 48)
    expected = [t.double() for t in ours]
    generator = torch.Generator().manual_seed(2)
    for step in range(1, 4):
        gradient = torch.randn(2000, 48, generator=generator)
        gradient[::7, 5] = torch.nan
        gradient[3, 3] = -torch.inf
        gradient[1999, 47] = 1e30  # finite, but its square is not
        parameter, first, second = ours
        skipped = adam_step(parameter, gradient, first, second, step, 0.1, row_size=row_size)
        usable = gradient.masked_fill(gradient.abs() > 1e20, torch.nan).double()
        assert skipped == reference_adam_step(expected[0], usable, *expected[1:], step, 0.1, row_size=row_size)
        assert skipped == math.ceil(2000 / 7) + 2
        for a, b in zip(ours, expected, strict=True):
            torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=2e-6)


def test_adam_step_keeps_skipped_row_unchanged():
    parameter, first, second = state(5, 3)
    adam_step(parameter, torch.ones(5, 3), first, second, 1, 0.1)
    before = [t.clone() for t in (parameter, first, second)]
    gradient = torch.ones(5, 3)
    gradient[2, 1] = torch.inf
    assert adam_step(parameter, gradient, first, second, 2, 0.1, row_size=3) == 1
    for now, then in zip((parameter, first, second), before, strict=True):
        assert torch.equal(now[2], then[2])
        assert (now[[0, 1, 3, 4]] != then[[0, 1, 3, 4]]).all()


@pytest.mark.parametrize("row_size", [1, 3, 4000])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.95, 1.0])
def test_adam_step_leaves_hidden_rows_unchanged_and_uncounted(row_size, share):
    generator = torch.Generator().manual_seed(4)
    rows = 12 if row_size == 4000 else 3000
    shown = torch.rand(rows, generator=generator) < share
    ours, marked = state(rows, row_size), state(rows, row_size)
    exact = [t.double() for t in ours]
    for step in range(1, 4):
        gradient = torch.randn(rows, row_size, generator=generator)
        gradient[::7, row_size // 2] = torch.nan
        unshown_is_nan = gradient.masked_fill(~shown[:, None], torch.nan)
        skipped = adam_step_queued(ours[0], gradient, *ours[1:], step, 0.1, row_size=row_size, shown=shown)
        assert skipped == shown[::7].sum()
        adam_step(marked[0], unshown_is_nan, *marked[1:], step, 0.1, row_size=row_size)
        reference_adam_step(exact[0], unshown_is_nan.double(), *exact[1:], step, 0.1, row_size=row_size)
    for now, then, wanted, start in zip(ours, marked, exact, state(rows, row_size), strict=True):
        assert torch.equal(now, then) and torch.equal(now[~shown], start[~shown])
        torch.testing.assert_close(now.double(), wanted, rtol=1e-5, atol=2e-6)


def test_adam_step_independent_of_thread_count():
    gradient = torch.randn(100_003, generator=torch.Generator().manual_seed(3))
    gradient[::101] = torch.nan
    shown = torch.rand(100_003, generator=torch.Generator().manual_seed(4)) < 0.7
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        tensors = state(100_003)
        counts = [adam_step_queued(tensors[0], gradient, *tensors[1:], 1, 0.1, shown=rows) for rows in (None, shown)]
        results.append((*tensors, *counts))
    torch.set_num_threads(before)
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
def test_adam_op_passes_opcheck():
    parameter, first, second = state(10, 3)
    arguments = (parameter, torch.ones(10, 3), first, second, 1, 0.1, 0.9, 0.999, 1e-8, 3)
    torch.library.opcheck(torch.ops.gsplat_core.adam_, arguments)
    torch.library.opcheck(torch.ops.gsplat_core.adam_, (*arguments, torch.arange(10) % 2 == 0))


def test_adam_step_rejects_invalid_inputs():
    parameter, first, second = state(4, 3)
    gradient = torch.ones(4, 3)
    with pytest.raises(InvalidInput, match=r"gsplat_core\.reference"):
        adam_step(parameter.double(), gradient.double(), first.double(), second.double(), 1, 0.1)
    with pytest.raises(InvalidInput, match="contiguous"):
        adam_step(state(3, 4)[0].T, gradient, first, second, 1, 0.1)
    with pytest.raises(InvalidInput, match="first_moment"):
        adam_step(parameter, gradient, first[:2], second, 1, 0.1)
    with pytest.raises(InvalidInput, match="row_size"):
        adam_step(parameter, gradient, first, second, 1, 0.1, row_size=5)
    with pytest.raises(InvalidInput, match="step 0"):
        adam_step(parameter, gradient, first, second, 0, 0.1)
    with pytest.raises(InvalidInput, match=r"each of 4 rows, got torch.bool \[3\]"):
        adam_step_queued(parameter, gradient, first, second, 1, 0.1, row_size=3, shown=torch.ones(3).bool())
    with pytest.raises(InvalidInput, match=r"shown must be bool .*float32"):
        adam_step_queued(parameter, gradient, first, second, 1, 0.1, row_size=3, shown=torch.ones(4))
    with pytest.raises(RuntimeError, match="one value for each of the 4 rows, got 3"):
        torch.ops.gsplat_core.adam_(
            parameter, gradient, first, second, 1, 0.1, 0.9, 0.999, 1e-8, 3, torch.ones(3, dtype=torch.bool)
        )


def test_adam_step_at_equals_adam_step():
    gradient = torch.randn(50, 3, generator=torch.Generator().manual_seed(5))
    gradient[7, 1] = torch.nan
    on_host, at, skipped = state(50, 3), state(50, 3), torch.full((1,), 4)
    for step in (1, 2, 100_000):
        rate = torch.tensor([0.125])
        assert adam_step(on_host[0], gradient, *on_host[1:], step, 0.125, row_size=3) == 1
        adam_step_at_(at[0], gradient, *at[1:], rate, torch.tensor([step]), skipped, row_size=3)
    assert all(torch.equal(a, b) for a, b in zip(on_host, at, strict=True)) and skipped.item() == 7
    arguments = (at[0], gradient, *at[1:], rate, torch.tensor([3]), 0.9, 0.999, 1e-8, 3, skipped)
    torch.library.opcheck(torch.ops.gsplat_core.adam_at_, arguments)
    with pytest.raises(InvalidInput, match=r"step must be one torch.int64 .*float32"):
        adam_step_at_(at[0], gradient, *at[1:], rate, torch.ones(1), skipped)
