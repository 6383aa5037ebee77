"""Detection of a usable GPU by torch, and reasons for its absence from the driver's files."""

from __future__ import annotations

import pytest
import torch

from services.cli import doctor


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """Return a function that simulates files of NVIDIA's driver and the GPUs seen by torch."""

    def make(files: str = "", capabilities: tuple[tuple[int, int], ...] = (), cuda: str | None = "13.0") -> None:
        for name in ("DRIVER", "DEVICE", "WSL"):
            path = tmp_path / name
            if name in files.split():
                path.touch()
            monkeypatch.setattr(doctor, name, path)
        monkeypatch.setattr(torch.version, "cuda", cuda)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: bool(capabilities))
        monkeypatch.setattr(torch.cuda, "device_count", lambda: len(capabilities))
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda k: capabilities[k])
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda k: f"GPU {k}")

    return make


def test_find_graphics_reports_gpus_of_torch(machine, capsys):
    machine("DRIVER DEVICE", ((9, 0), (8, 6)))
    assert doctor.find_graphics() == doctor.Graphics(
        True, "GPU 0 (compute capability 9.0), GPU 1 (compute capability 8.6)"
    )
    assert doctor.main() == 0
    assert "GPU 0" in capsys.readouterr().out


def test_find_graphics_rejects_gpu_with_old_compute_capability(machine):
    machine("DRIVER DEVICE", ((7, 5),))
    assert not doctor.find_graphics().usable
    assert "7.5" in doctor.find_graphics().found and "8.0" in doctor.find_graphics().advice


@pytest.mark.parametrize(
    ("files", "cuda", "found", "advice"),
    [
        ("", "13.0", "no NVIDIA driver", "not needed"),
        ("DRIVER", "13.0", "none here", "--gpus all"),
        ("DRIVER", None, "built without CUDA", ""),
    ],
)
def test_find_graphics_gives_reason_for_missing_gpu(machine, capsys, files, cuda, found, advice):
    machine(files, cuda=cuda)
    seen = doctor.find_graphics()
    assert not seen.usable and found in seen.found and advice in seen.advice
    assert doctor.main() == 1
    assert found in capsys.readouterr().out


@pytest.mark.parametrize("files", ["DRIVER DEVICE", "WSL"])
def test_find_graphics_reports_cuda_init_error_of_torch(machine, monkeypatch, files):
    machine(files)

    def refuse() -> None:
        raise RuntimeError("The NVIDIA driver on your system is too old (found version 12040). Please update.\nMore")

    monkeypatch.setattr(torch.cuda, "init", refuse)
    seen = doctor.find_graphics()
    assert not seen.usable and "too old (found version 12040)" in seen.found and "More" not in seen.found
    assert "CUDA 13.0 or later" in seen.advice
