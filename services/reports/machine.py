"""Facts about the machine of the measurement."""

from __future__ import annotations

import platform

import torch

from gsplat_core.ops.native import instruction_set
from gsplat_core.threads import usable_cores


def machine_facts() -> dict[str, str]:
    """Return names and values of the facts, formatted for people."""
    return {
        "Processor": f"{processor_name()}, {usable_cores()} cores",
        "Instruction set": instruction_set(),
        "System": f"{platform.system()} {platform.release()}",
        "Python": platform.python_version(),
        "torch": torch.__version__,
    }


def processor_name() -> str:
    """Return the processor's marketing name if the system reports it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except FileNotFoundError:
        pass
    return platform.processor() or platform.machine()
