"""Accepted devices, and the host settings of an application on each."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops import native
from operators.applications.session import check_device, scheduler_for, seeded
from operators.errors import DeviceMissing
from operators.graph import Application, GreedyScheduler, MultiThreadScheduler


def test_check_device_requires_cuda_in_torch_and_built_kernels(monkeypatch):
    check_device("cpu")
    with pytest.raises(DeviceMissing, match="'tpu' is not known; use --device cpu or cuda"):
        check_device("tpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        DeviceMissing, match=f"torch {torch.__version__.split('+')[0]}.* finds no GPU; use --device cpu"
    ):
        check_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(native, "CUDA_MISSING", "not built (so is this test's reason)")
    with pytest.raises(DeviceMissing, match=r"the CUDA kernels are not built \(so is this test's reason\)"):
        check_device("cuda")
    monkeypatch.setattr(native, "CUDA_MISSING", None)
    check_device("cuda")


def test_scheduler_is_greedy_on_cpu_and_multithreaded_on_cuda():
    app = Application()
    assert isinstance(scheduler_for("cpu", app), GreedyScheduler)
    assert isinstance(scheduler_for("cuda", app), MultiThreadScheduler)


def test_seeded_repeats_random_numbers_and_restores_global_state():
    def drawn() -> torch.Tensor:
        with seeded(7, "cpu"):
            return torch.rand(3)

    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second = drawn(), drawn()
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    torch.testing.assert_close(torch.rand(3), expected, rtol=0, atol=0)
