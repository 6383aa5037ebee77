"""Where the heavy work runs."""

from __future__ import annotations

from operators.errors import DeviceMissing

DEVICES = ("cpu", "cuda")


def check_device(device: str) -> None:
    """Raises DeviceMissing where this machine or this version cannot run on `device`."""
    import torch

    if device == "cpu":
        return
    if device != "cuda":
        raise DeviceMissing(f"device {device!r} is not known; use --device {' or '.join(DEVICES)}")
    if not torch.cuda.is_available():
        raise DeviceMissing(
            f"device cuda was asked for, and torch {torch.__version__} sees no GPU; use --device cpu, "
            "or let `intrasplat doctor` say what is missing"
        )
    raise DeviceMissing(
        "device cuda was asked for, and the splatting core of this version runs on the CPU only; use --device cpu"
    )
