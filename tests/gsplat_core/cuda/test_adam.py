"""Adam on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import InvalidInput
from gsplat_core.ops.adam.adam import adam_step
from gsplat_core.reference.adam import adam_step as reference_adam_step

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("row_size", [1, 3, 48, 5000])
@pytest.mark.parametrize("rows", [0, 1, 2003])
def test_equals_the_reference_where_gradients_are_not_finite(gpu, rows, row_size):
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


def test_devices_must_agree(gpu):
    on_gpu, here = torch.zeros(4, device=gpu), torch.zeros(4)
    with pytest.raises(InvalidInput, match="one device"):
        adam_step(on_gpu, here, on_gpu.clone(), on_gpu.clone(), 1, 0.1)


def test_opcheck(gpu):
    parameter, gradient, first, second = (torch.rand(6, 3, device=gpu) for _ in range(4))
    arguments = (parameter, gradient, first, second, 2, 0.1, 0.9, 0.999, 1e-8, 3)
    torch.library.opcheck(torch.ops.gsplat_core.adam_.default, arguments)
