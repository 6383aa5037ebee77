"""Numbers carried to the device by a launch."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import InvalidInput
from gsplat_core.ops.scalars import MOST_SCALARS, store_scalars_


@pytest.mark.parametrize("count", [0, 1, 26, MOST_SCALARS])
def test_store_scalars_writes_all_values(count):
    values = [0.5 * i - 3 for i in range(count)]
    to = torch.full((count + 1,), 7.0, device="cuda")[1:]  # a view that starts anywhere
    store_scalars_(to, values)
    assert to.tolist() == values


def test_store_scalars_later_values_do_not_affect_earlier_launches():
    to = torch.zeros(1, device="cuda")
    seen = torch.empty(500, device="cuda")
    for i in range(500):
        store_scalars_(to, [i])
        seen[i : i + 1] = to
    assert torch.equal(seen.cpu(), torch.arange(500.0))


def test_store_scalars_rejects_invalid_inputs():
    with pytest.raises(InvalidInput, match="got 65 values"):
        store_scalars_(torch.zeros(65, device="cuda"), [0.0] * 65)
    with pytest.raises(InvalidInput, match="got 2 values"):
        store_scalars_(torch.zeros(3, device="cuda"), [0.0] * 2)
    with pytest.raises(InvalidInput, match="float64"):
        store_scalars_(torch.zeros(1, device="cuda", dtype=torch.float64), [0.0])


def test_store_scalars_passes_opcheck():
    torch.library.opcheck(torch.ops.gsplat_core.store_scalars_, (torch.zeros(2, device="cuda"), [1.0, 2.0]))
