"""The CUDA kernels: every test here needs the GPU."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def needs_gpu(gpu: torch.device) -> None:
    """Require a GPU; skip without one, or fail in CI."""
