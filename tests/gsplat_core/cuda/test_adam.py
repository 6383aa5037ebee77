"""Adam on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import InvalidInput
from gsplat_core.ops.adam import adam_step, adam_step_at_, adam_step_queued
from gsplat_core.reference.training import adam_step as reference_adam_step
from gsplat_core.training.steps.optimiser import FusedAdam


@pytest.mark.parametrize("row_size", [1, 3, 48, 5000])
@pytest.mark.parametrize("rows", [0, 1, 2003])
def test_adam_step_equals_reference_with_non_finite_gradients(gpu, rows, row_size):
    generator = torch.Generator().manual_seed(0)
    draw = lambda: torch.randn(rows, row_size, generator=generator)
    parameter, first, second = draw().to(gpu), torch.zeros(rows, row_size).to(gpu), torch.zeros(rows, row_size).to(gpu)
    expected = [t.double().cpu() for t in (parameter, first, second)]
    for step in range(1, 4):
        gradient = draw()
        gradient[::7, row_size // 2] = torch.nan
        gradient[3:4, 0] = -torch.inf
        gradient[-1:, -1] = 1e30  # finite, but its square is not
        skipped = adam_step(parameter, gradient.to(gpu), first, second, step, 0.1, row_size=row_size)
        usable = gradient.masked_fill(gradient.abs() > 1e20, torch.nan).double()
        assert skipped == reference_adam_step(expected[0], usable, *expected[1:], step, 0.1, row_size=row_size)
        for actual, wanted in zip((parameter, first, second), expected, strict=True):
            torch.testing.assert_close(actual.cpu().double(), wanted, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("row_size", [1, 3, 48, 5000])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_adam_step_leaves_hidden_rows_unchanged_and_uncounted(gpu, row_size, share):
    generator = torch.Generator().manual_seed(4)
    rows = 2003
    shown = torch.rand(rows, generator=generator) < share
    start = torch.randn(rows, row_size, generator=generator)
    ours, marked = ([start.to(gpu), *torch.zeros(2, rows, row_size, device=gpu)] for _ in range(2))
    exact = [t.double().cpu() for t in ours]
    for step in range(1, 4):
        gradient = torch.randn(rows, row_size, generator=generator)
        gradient[::7, row_size // 2] = torch.nan
        unshown_is_nan = gradient.masked_fill(~shown[:, None], torch.nan)
        skipped = adam_step_queued(
            ours[0], gradient.to(gpu), *ours[1:], step, 0.1, row_size=row_size, shown=shown.to(gpu)
        )
        assert skipped.item() == shown[::7].sum()
        adam_step(marked[0], unshown_is_nan.to(gpu), *marked[1:], step, 0.1, row_size=row_size)
        reference_adam_step(exact[0], unshown_is_nan.double(), *exact[1:], step, 0.1, row_size=row_size)
    assert torch.equal(ours[0][~shown.to(gpu)].cpu(), start[~shown])
    for now, then, wanted in zip(ours, marked, exact, strict=True):
        assert torch.equal(now, then)
        torch.testing.assert_close(now.cpu().double(), wanted, rtol=1e-5, atol=2e-6)


def test_adam_step_rejects_mixed_devices(gpu):
    on_gpu, here = torch.zeros(4, device=gpu), torch.zeros(4)
    with pytest.raises(InvalidInput, match="one device"):
        adam_step(on_gpu, here, on_gpu.clone(), on_gpu.clone(), 1, 0.1)
    with pytest.raises(InvalidInput, match="shown must be bool on cuda"):
        adam_step_queued(*(on_gpu.clone() for _ in range(4)), 1, 0.1, shown=here.bool())


@pytest.mark.parametrize("row_size", [1, 3, 5000])
def test_captured_adam_step_reads_current_rate_and_step(gpu, row_size):
    generator = torch.Generator().manual_seed(0)
    parameter = torch.randn(41, row_size, generator=generator).to(gpu)
    first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
    exact = [t.double().cpu() for t in (parameter, first, second)]
    rate, step = torch.zeros(3, device=gpu)[1:2], torch.ones(1, dtype=torch.int64, device=gpu)
    skipped = torch.zeros(1, dtype=torch.int64, device=gpu)
    gradient = torch.zeros_like(parameter)
    arguments = (parameter, gradient, first, second, rate, step, skipped)
    adam_step_at_(*arguments, row_size=row_size)  # changes nothing: rate and gradient are 0
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        adam_step_at_(*arguments, row_size=row_size)
    left_alone = 0
    for number, learning_rate in ((1, 0.1), (2, 0.05), (1000, 0.1), (10_000_000, 0.2)):
        now = torch.randn(41, row_size, generator=generator)
        now[::9, 0] = torch.nan
        gradient.copy_(now)
        rate.fill_(learning_rate)
        step.fill_(number)
        graph.replay()
        left_alone += reference_adam_step(exact[0], now.double(), *exact[1:], number, learning_rate, row_size=row_size)
    assert skipped.item() == left_alone
    for actual, wanted in zip((parameter, first, second), exact, strict=True):
        torch.testing.assert_close(actual.cpu().double(), wanted, rtol=1e-5, atol=2e-6)


def test_adam_ops_pass_opcheck(gpu):
    parameter, gradient, first, second = (torch.ones(10, 3, device=gpu) for _ in range(4))
    rate, step, skipped = torch.ones(1, device=gpu), *torch.ones(2, 1, dtype=torch.int64, device=gpu).unbind()
    shown = torch.arange(10, device=gpu) % 2 == 0
    arguments = (parameter, gradient, first, second, 2, 0.1, 0.9, 0.999, 1e-8, 3)
    torch.library.opcheck(torch.ops.gsplat_core.adam_.default, arguments)
    torch.library.opcheck(torch.ops.gsplat_core.adam_.default, (*arguments, shown))
    torch.library.opcheck(
        torch.ops.gsplat_core.adam_at_,
        (parameter, gradient, first, second, rate, step.clone(), 0.9, 0.999, 1e-8, 3, skipped.clone()),
    )


@pytest.mark.filterwarnings("ignore:Synchronization debug mode:UserWarning")
def test_fused_adam_does_not_synchronise(gpu):
    values = {"means": torch.zeros(5, 3, device=gpu), "sh": torch.zeros(5, 4, 3, device=gpu)}
    optimiser = FusedAdam(values, {"means": 0.1, "sh": 0.1})
    gradients = {name: torch.ones_like(t) for name, t in values.items()}
    gradients["means"][2, 1] = torch.nan
    try:
        torch.cuda.set_sync_debug_mode("error")
        for _ in range(2):
            skipped = optimiser.step(values, gradients)
        optimiser.append(2)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert skipped == 1 and optimiser.skipped == 2
    assert all(moment.device == gpu and moment.shape[0] == 7 for moment in optimiser.first_moments.values())
