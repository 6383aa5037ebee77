"""`SelectiveAdam` against Adam without bias correction, written out in float64."""

import pytest
import torch

from gsplat_core import SelectiveAdam
from gsplat_core.errors import InvalidInput


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_selective_adam_updates_only_visible_rows_without_bias_correction(dtype):
    random = torch.Generator().manual_seed(0)
    parameter = torch.randn(9, 2, 3, generator=random).to(dtype).requires_grad_()
    wanted = parameter.detach().double().clone()
    first, second = torch.zeros_like(wanted), torch.zeros_like(wanted)
    optimizer = SelectiveAdam([{"params": parameter, "lr": 0.02, "name": "sh"}], eps=1e-15, betas=(0.9, 0.99))
    for step in range(5):
        parameter.grad = torch.randn(9, 2, 3, generator=random).to(dtype)
        visible = torch.rand(9, generator=random) < 0.6
        g = parameter.grad.double()
        if step == 2:
            visible[4] = True
            parameter.grad[4, 0, 1] = torch.nan  # the row keeps its values
        rows = visible.clone()
        rows[4] &= step != 2
        first[rows] = 0.9 * first[rows] + 0.1 * g[rows]
        second[rows] = 0.99 * second[rows] + 0.01 * g[rows] ** 2
        wanted[rows] -= 0.02 * first[rows] / (second[rows].sqrt() + 1e-15)
        optimizer.step(visible if step % 2 else visible.float()[:, None])
    torch.testing.assert_close(parameter.detach().double(), wanted, rtol=1e-5, atol=1e-6)
    assert optimizer.state[parameter]["exp_avg"].shape == parameter.shape


@pytest.mark.parametrize("length", [1, 2, 3, 5, 12])
def test_selective_adam_refuses_mask_of_wrong_length(length):
    parameter = torch.zeros(4, 3, requires_grad=True)
    parameter.grad = torch.ones(4, 3)
    with pytest.raises(InvalidInput, match="one per row"):
        SelectiveAdam([parameter], 1e-8, (0.9, 0.999)).step(torch.ones(length, dtype=torch.bool))
