"""Counting frames on the device."""

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.frame.frame_count import count_frame_

pytestmark = pytest.mark.cuda


def words(*values):
    return torch.tensor(values, dtype=torch.int32, device="cuda")


def test_the_most_of_all_frames_and_how_many_were_cut():
    most, step = words(0, 0, 0, 0), torch.full((1,), 7, dtype=torch.int64, device="cuda")
    frames = [words(5, 3, 0, 0), words(9, 2, 1, 0), words(4, 6, 1, 0), words(1, 1, 0, 0)]
    fits = [float(count_frame_(status, most, step)) for status in frames]
    assert fits == [1, 0, 0, 1]
    assert most.tolist() == [9, 6, 2, 0]
    assert step.tolist() == [9]


def test_wrong_input_is_refused():
    step = torch.ones(1, dtype=torch.int64, device="cuda")
    with pytest.raises(InvalidInput, match="float32"):
        count_frame_(words(1, 2, 0, 0).float(), words(0, 0, 0, 0), step)
    with pytest.raises(InvalidInput, match="step must be"):
        count_frame_(words(1, 2, 0, 0), words(0, 0, 0, 0), step.int())
    with pytest.raises(InvalidInput, match="most"):
        count_frame_(words(1, 2, 0, 0), words(0, 0), step)


def test_opcheck():
    step = torch.ones(1, dtype=torch.int64, device="cuda")
    torch.library.opcheck(torch.ops.gsplat_core.count_frame_, (words(1, 2, 0, 0), words(0, 0, 0, 0), step))
