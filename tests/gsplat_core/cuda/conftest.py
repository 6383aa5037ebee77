"""The CUDA kernels: a GPU that torch sees, and the library built. Without them these tests are skipped, saying why."""

from __future__ import annotations

import os

import pytest
import torch

from gsplat_core.ops import native


@pytest.fixture(scope="session", autouse=True)
def gpu() -> torch.device:
    """The GPU to test on. FAIL_WITHOUT_CUDA=1 fails the test where there is none, instead of skipping it."""
    why = None if torch.cuda.is_available() else f"torch {torch.__version__} sees no GPU"
    if why is None and native.CUDA_MISSING is not None:
        why = f"the CUDA kernels are {native.CUDA_MISSING}"
    if why is not None:
        if os.environ.get("FAIL_WITHOUT_CUDA") == "1":
            pytest.fail(why)
        pytest.skip(why)
    return torch.device("cuda", 0)
