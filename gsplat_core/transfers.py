"""Asynchronous copies of tensors within a GPU, and between it and the host through page-locked memory.

On the CPU, a transfer shares memory where possible instead of copying.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def tensor_of(array: NDArray, device: torch.device | str = "cpu") -> Tensor:
    """Return the array as a tensor on `device`.

    On the CPU the tensor shares the array's memory if torch permits. The copy to a GPU is staged through page-locked
    memory and enqueued on the current stream. The array may be changed immediately after the call.
    """
    array = np.ascontiguousarray(array)
    device = torch.device(device)
    if device.type == "cpu":
        return torch.from_numpy(array if array.flags.writeable else array.copy())
    staged = torch.empty(array.shape, dtype=_torch_type(array.dtype), device="cpu", pin_memory=True)
    np.copyto(staged.numpy(), array)
    return staged.to(device, non_blocking=True)


def copy_each(to: list[Tensor], values: list[Tensor]) -> None:
    """Copy each tensor of `values` into the tensor of `to` at the same index, with as few kernel launches as possible."""
    torch._foreach_copy_(to, values, non_blocking=True)


def _torch_type(dtype: np.dtype[Any]) -> torch.dtype:
    return torch.from_numpy(np.empty(0, dtype)).dtype


class StagedCopies:
    """Device-to-host copies in pieces through a small page-locked buffer on a separate stream.

    Neither other GPU work nor other threads wait for a large tensor. Not thread-safe.
    """

    PIECE_BYTES = 1 << 22

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        """Stream on which copies run; it must wait for the stream that computes the copied tensor."""
        self._staged = torch.empty(self.PIECE_BYTES, dtype=torch.uint8, pin_memory=True)
        self._arrived = torch.cuda.Event()

    def to_host(self, tensor: Tensor) -> Tensor:
        """Return a copy of a CUDA tensor in host memory, after waiting for it; a CPU tensor is returned itself."""
        if not tensor.is_cuda:
            return tensor
        with torch.cuda.stream(self.stream):
            values = tensor.contiguous()
            copied = torch.empty(values.shape, dtype=values.dtype)
            source, target = (each.view(-1).view(torch.uint8) for each in (values, copied))
            for first in range(0, source.numel(), self.PIECE_BYTES):
                piece = source[first : first + self.PIECE_BYTES]
                staged = self._staged[: piece.numel()]
                staged.copy_(piece, non_blocking=True)
                self._arrived.record(self.stream)
                self._arrived.synchronize()
                target[first : first + self.PIECE_BYTES].copy_(staged)
        return copied


class HostCopy:
    """Asynchronous copy of a tensor to the host.

    The copy is enqueued after the kernels that compute the tensor. Reading the values waits for it.
    """

    def __init__(self, tensor: Tensor) -> None:
        tensor = tensor.detach()
        self._arrived: torch.cuda.Event | None = None
        if tensor.device.type == "cuda":
            # Copy to page-locked memory, which torch's allocator keeps for later copies.
            self._values = tensor.contiguous().to("cpu", non_blocking=True)
            self._arrived = torch.cuda.Event()
            self._arrived.record(torch.cuda.current_stream(tensor.device))
        else:
            self._values = tensor

    def numpy(self) -> NDArray[Any]:
        """Return the values as an array after waiting for the copy; a CPU tensor shares its memory."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return self._values.numpy()

    def item(self) -> float:
        """Return the value of a one-element tensor after waiting for the copy."""
        return float(self.numpy().item())
