"""Transfers between host and device: shared memory on the CPU, non-blocking copies on a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.transfers import HostCopy, StagedCopies, tensor_of


def test_transfers_on_cpu_share_memory():
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    tensor = tensor_of(array)
    array[1, 2] = 7
    assert tensor[1, 2] == 7
    assert HostCopy(tensor).numpy()[1, 2] == 7
    tensor[0, 0] = 9
    assert HostCopy(tensor).numpy()[0, 0] == 9


def test_tensor_of_copies_read_only_array():
    array = np.arange(4, dtype=np.uint8)
    array.setflags(write=False)
    tensor = tensor_of(array)
    tensor[0] = 5
    assert array[0] == 0


def test_host_copy_item_returns_single_value():
    assert HostCopy(torch.tensor(2.5, requires_grad=True)).item() == 2.5
    with pytest.raises(ValueError, match="size 1"):
        HostCopy(torch.zeros(2)).item()


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int64, np.bool_])
def test_transfer_to_gpu_and_back_keeps_values(gpu, dtype):
    array = (np.arange(60).reshape(5, 12) % 7).astype(dtype)[:, ::2]
    there = tensor_of(array, gpu)
    assert there.device == gpu
    np.testing.assert_array_equal(HostCopy(there).numpy(), array)
    np.testing.assert_array_equal(HostCopy(there.T[1:]).numpy(), array.T[1:])
    assert tensor_of(array[:0], gpu).shape == (0, 6)


@pytest.mark.cuda
def test_transfers_unaffected_by_later_changes(gpu):
    array = np.zeros(1 << 20, np.float32)
    torch.cuda._sleep(10_000_000)  # the copies below are queued behind this
    there = tensor_of(array, gpu)
    array += 1
    seen = HostCopy(there)
    there += 2
    assert not seen.numpy().any()
    assert (HostCopy(there).numpy() == 2).all()


@pytest.mark.cuda
@pytest.mark.parametrize("shape", [(), (0, 3), (5, 7), (3, StagedCopies.PIECE_BYTES // 4 + 1)])
def test_staged_copies_equal_tensor(gpu, shape):
    values = torch.arange(int(np.prod(shape)), dtype=torch.float32).reshape(shape)
    there = values.to(gpu)
    copies = StagedCopies(gpu)
    copies.stream.wait_stream(torch.cuda.default_stream(gpu))
    assert torch.equal(copies.to_host(there), values)
    assert copies.to_host(values) is values


@pytest.mark.cuda
def test_staged_copies_do_not_wait_for_other_streams(gpu):
    values = torch.ones(3 * StagedCopies.PIECE_BYTES // 4, device=gpu)
    copies = StagedCopies(gpu)
    copies.stream.wait_stream(torch.cuda.default_stream(gpu))
    torch.cuda._sleep(3_000_000_000)  # a second or two on the default stream
    busy = torch.cuda.Event()
    busy.record(torch.cuda.default_stream(gpu))
    assert (copies.to_host(values) == 1).all()
    assert not busy.query()
