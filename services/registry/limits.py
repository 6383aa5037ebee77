"""How much an upload and its check may take."""

from __future__ import annotations

from dataclasses import dataclass

GIB = 1 << 30


@dataclass(frozen=True)
class RegistryLimits:
    """Budgets of one version. Every bound is included."""

    upload_bytes: int = 4 * GIB
    """The uploaded file."""
    gaussians: int = 2_000_000
    model_bytes: int = 4 * GIB
    """The tensors of the model, as they lie in memory."""
    pixels: int = 4096 * 4096
    """The picture of the model's camera."""
    check_memory_bytes: int = 12 * GIB
    """What the checking process may take beside torch itself."""
    check_s: float = 120.0
    """Processor time of the check beside the start of torch. More rejects the version."""
    check_passed_s: float = 600.0
    """How long a check may last, the start of its process included. More says that the machine is too busy, and nothing about the version."""

    checks_at_once: int = 1
    """Further checks wait for their turn."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"RegistryLimits.{name} must be positive, got {value!r}")
