"""Output of `doctor` about the GPU and its kernels, for each state of a machine."""

from __future__ import annotations

import pytest

from gsplat_core.ops import native
from services.cli import doctor

GPU = doctor.Graphics(True, "NVIDIA H200 (compute capability 9.0)")
NONE = doctor.Graphics(False, "none: this machine has no NVIDIA driver", "not needed")


@pytest.fixture
def doctor_checks(monkeypatch):
    """Return a function that gives doctor's checks by name for a machine, a kernel build and an answer of the GPU."""

    def look(machine: doctor.Graphics, missing: str | None, refusal: str | None = None) -> dict[str, doctor.Check]:
        monkeypatch.setattr(doctor, "find_graphics", lambda: machine)
        monkeypatch.setattr(native, "CUDA_MISSING", missing)
        monkeypatch.setattr(native, "cuda_build", lambda: "nvcc 13.0 for 8.0, 9.0")
        monkeypatch.setattr(native, "cuda_refusal", lambda: refusal)
        checks = {check.name: check for check in doctor._cuda(["adam_", "composite"])}
        assert not any(check.needed for check in checks.values())
        return checks

    return look


def test_doctor_reports_working_cuda_kernels(doctor_checks):
    checks = doctor_checks(GPU, None)
    assert all(check.ok for check in checks.values() if check.name != "Multi-Process Service")
    assert checks["CUDA kernels"].value == "built by nvcc 13.0 for compute capability 8.0, 9.0"
    assert checks["ops on the GPU"].value == "2: adam_, composite"


def test_doctor_finds_program_for_several_streams_on_one_gpu(doctor_checks, monkeypatch):
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    assert doctor_checks(GPU, None)["Multi-Process Service"].value == "/usr/bin/nvidia-cuda-mps-control"
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    found = doctor_checks(GPU, None)["Multi-Process Service"]
    assert not found.ok and "gpu.mps" in found.advice


def test_doctor_advises_make_cuda_for_gpu_without_kernels(doctor_checks):
    checks = doctor_checks(GPU, "not built")
    assert checks["GPU"].ok and not checks["CUDA kernels"].ok
    assert "make cuda" in checks["CUDA kernels"].advice


def test_doctor_reports_kernels_that_gpu_refuses(doctor_checks):
    checks = doctor_checks(GPU, None, "no kernel image is available for execution on the device")
    assert not checks["CUDA kernels"].ok and "no kernel image" in checks["CUDA kernels"].value
    assert "--device cpu" in checks["CUDA kernels"].advice


def test_doctor_does_not_run_kernels_without_gpu(doctor_checks):
    checks = doctor_checks(NONE, None, "must not be asked")
    assert not checks["GPU"].ok and checks["CUDA kernels"].ok and "must not" not in checks["CUDA kernels"].value


def test_doctor_gives_no_build_advice_without_gpu_and_kernels(doctor_checks):
    checks = doctor_checks(NONE, "not built")
    assert (
        "everything runs on the CPU" in checks["CUDA kernels"].advice
        and "make cuda" not in checks["CUDA kernels"].advice
    )


def test_doctor_lists_and_counts_cpu_ops():
    value = next(check.value for check in doctor._core() if check.name == "ops on the CPU")
    count, _, names = value.partition(": ")
    listed = names.split(", ")
    assert listed == sorted(set(listed)) and len(listed) == int(count) > 20
    import torch

    for name in listed:
        assert torch._C._dispatch_has_kernel_for_dispatch_key(f"gsplat_core::{name}", "CPU")
