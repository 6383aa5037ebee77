"""The CUDA kernels: every test here needs the GPU."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test of this folder, so that `-m cuda` selects it."""
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.cuda)


@pytest.fixture(scope="session", autouse=True)
def needs_gpu(gpu: torch.device) -> None:
    """Require a GPU; skip without one, or fail in CI."""
