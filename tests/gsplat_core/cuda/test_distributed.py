"""Gaussians shared out over GPUs with NCCL: one GPU's pictures and gradients."""

from __future__ import annotations

import pytest
import torch

from benchmarks.gsplat.processes import differences

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs a second GPU"),
]


def test_each_gpu_renders_its_cameras_with_the_gaussians_of_all():
    size = torch.cuda.device_count()
    found = differences(300, 2 * size, size, "cuda")
    assert len(found) == 14
    assert max(found.values()) < 1e-4
