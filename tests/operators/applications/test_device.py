"""Accepted devices, and the host settings of an application on each."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops import native
from operators.applications.session import check_device, scheduler_for, seeded
from operators.errors import DeviceMissing
from operators.graph import Application, GreedyScheduler, MultiThreadScheduler


def test_a_gpu_needs_torch_to_see_it_and_its_kernels(monkeypatch):
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


def test_the_host_computes_in_one_thread_where_it_trains_and_in_many_beside_a_gpu():
    app = Application()
    assert isinstance(scheduler_for("cpu", app), GreedyScheduler)
    assert isinstance(scheduler_for("cuda", app), MultiThreadScheduler)


def test_random_numbers_are_the_same_inside_and_untouched_outside():
    def drawn() -> torch.Tensor:
        with seeded(7, "cpu"):
            return torch.rand(3)

    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second = drawn(), drawn()
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    torch.testing.assert_close(torch.rand(3), expected, rtol=0, atol=0)
