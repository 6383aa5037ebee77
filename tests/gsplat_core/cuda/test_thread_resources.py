"""CUDA streams and events that the library creates for a thread are released with the thread."""

import ctypes
import itertools
import threading
import time

import torch

from gsplat_core.ops.hexplane_training import hexplane_train
from gsplat_core.ops.native import CUDA_LIBRARY_PATH
from gsplat_core.ops.plain_torch import PLANE_AXES


def resources() -> int:
    return int(ctypes.CDLL(str(CUDA_LIBRARY_PATH)).gsplat_core_cuda_resources())


def train_once() -> None:
    """An op that queues work on two streams."""
    generator = torch.Generator().manual_seed(0)
    sizes, channels, width = (9, 7, 8, 5), 32, 32
    planes = [0.6 + torch.rand(sizes[v], sizes[u], channels, generator=generator).cuda() for u, v in PLANE_AXES]
    shapes = list(itertools.pairwise([channels, width, width, 11]))
    weights = [torch.randn(b, a, generator=generator).cuda() / a**0.5 for a, b in shapes]
    biases = [torch.zeros(b, device="cuda") for _, b in shapes]
    means = torch.rand(700, 3, generator=generator).cuda()
    box = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], device="cuda")
    hexplane_train(means, box, torch.tensor([0.4], device="cuda"), planes, weights, biases)
    torch.cuda.synchronize()


def test_ended_threads_release_streams_and_events():
    before, inside = resources(), []

    def work() -> None:
        train_once()
        train_once()
        inside.append(resources())

    for _ in range(3):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert inside == [before + 2] * 3, "a stream and an event, once for a thread"
    # A thread's own objects go after Python has joined it, when the system's thread ends.
    deadline = time.monotonic() + 300
    while resources() != before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert resources() == before
