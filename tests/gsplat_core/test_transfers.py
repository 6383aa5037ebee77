"""Between host and device: shared memory on the CPU, copies that wait for nobody on a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.transfers import HostCopy, tensor_of


def test_on_the_cpu_nothing_is_copied():
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    tensor = tensor_of(array)
    array[1, 2] = 7
    assert tensor[1, 2] == 7
    assert HostCopy(tensor).numpy()[1, 2] == 7
    tensor[0, 0] = 9
    assert HostCopy(tensor).numpy()[0, 0] == 9


def test_an_array_that_must_not_be_written_to_is_copied():
    array = np.arange(4, dtype=np.uint8)
    array.setflags(write=False)
    tensor = tensor_of(array)
    tensor[0] = 5
    assert array[0] == 0


def test_one_value():
    assert HostCopy(torch.tensor(2.5, requires_grad=True)).item() == 2.5
    with pytest.raises(ValueError, match="size 1"):
        HostCopy(torch.zeros(2)).item()


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int64, np.bool_])
def test_there_and_back_again(gpu, dtype):
    array = (np.arange(60).reshape(5, 12) % 7).astype(dtype)[:, ::2]
    there = tensor_of(array, gpu)
    assert there.device == gpu
    np.testing.assert_array_equal(HostCopy(there).numpy(), array)
    np.testing.assert_array_equal(HostCopy(there.T[1:]).numpy(), array.T[1:])
    assert tensor_of(array[:0], gpu).shape == (0, 6)


@pytest.mark.cuda
def test_later_changes_on_either_side_are_not_seen(gpu):
    array = np.zeros(1 << 20, np.float32)
    torch.cuda._sleep(10_000_000)  # the copies below are queued behind this
    there = tensor_of(array, gpu)
    array += 1
    seen = HostCopy(there)
    there += 2
    assert not seen.numpy().any()
    assert (HostCopy(there).numpy() == 2).all()
