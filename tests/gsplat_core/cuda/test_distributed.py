"""Gaussians distributed over GPUs with NCCL: equal to pictures and gradients of one GPU."""

from __future__ import annotations

import pytest
import torch

from benchmarks.gsplat.processes import differences

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs a second GPU"),
]


def test_distributed_rendering_over_gpus_equals_single_gpu():
    size = torch.cuda.device_count()
    found = differences(300, 2 * size, size, "cuda")
    assert len(found) == 14
    assert max(found.values()) < 1e-4
