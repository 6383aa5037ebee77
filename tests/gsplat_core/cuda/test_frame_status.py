"""The status of a series of frames, folded on the device."""

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.frame import accumulate_status_


def ints(*values):
    return torch.tensor(values, dtype=torch.int32, device="cuda")


def test_accumulate_status_keeps_maximum_and_counts_overflows():
    totals, step = ints(0, 0, 0, 0), torch.full((1,), 7, dtype=torch.int64, device="cuda")
    frames = [ints(5, 3, 0, 0), ints(9, 2, 1, 0), ints(4, 6, 1, 0), ints(1, 1, 0, 0)]
    fits = [float(accumulate_status_(status, totals, step)) for status in frames]
    assert fits == [1, 0, 0, 1]
    assert totals.tolist() == [9, 6, 2, 0]
    assert step.tolist() == [9]


def test_accumulate_status_rejects_invalid_inputs():
    step = torch.ones(1, dtype=torch.int64, device="cuda")
    with pytest.raises(InvalidInput, match="float32"):
        accumulate_status_(ints(1, 2, 0, 0).float(), ints(0, 0, 0, 0), step)
    with pytest.raises(InvalidInput, match="step must be"):
        accumulate_status_(ints(1, 2, 0, 0), ints(0, 0, 0, 0), step.int())
    with pytest.raises(InvalidInput, match="totals"):
        accumulate_status_(ints(1, 2, 0, 0), ints(0, 0), step)


def test_accumulate_status_passes_opcheck():
    step = torch.ones(1, dtype=torch.int64, device="cuda")
    torch.library.opcheck(torch.ops.gsplat_core.accumulate_status_, (ints(1, 2, 0, 0), ints(0, 0, 0, 0), step))
