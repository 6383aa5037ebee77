"""Implementation of `intrasplat doctor`: capabilities of this machine, missing components and remedies.

python -m services.cli.doctor     # prints whether a GPU is usable; exit code 0 with a GPU, 1 without (for `make demo`)
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import typer

from services import product_version
from services.cli.terminal import BAD_INPUT, OK
from services.supervisor.gpu_sharing import CONTROL as MPS_CONTROL

PACKAGES = (
    "torch",
    "numpy",
    "opencv-contrib-python-headless",
    "safetensors",
    "typer",
    "rich",
    "pydantic",
    "pyzmq",
    "fastapi",
)


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    value: str
    ok: bool = True
    advice: str = ""
    """Remedy if the check failed, or a possible improvement."""
    needed: bool = True
    """True if the program does not work without the component."""


def doctor_command(*, as_json: bool) -> int:
    """Print the result of each check of this machine.

    Returns:
        The exit code; 2 if a needed component is missing.
    """
    checks = [*_versions(), *_processor(), *_core(), *_video(), *_holoscan()]
    broken = [check for check in checks if check.needed and not check.ok]
    if as_json:
        typer.echo(json.dumps({"ok": not broken, "checks": [asdict(check) for check in checks]}, indent=2))
        return BAD_INPUT if broken else OK
    width = max(len(check.name) for check in checks)
    for check in checks:
        mark = "ok" if check.ok else "MISSING" if check.needed else "-"
        typer.echo(f"{mark:8}{check.name:{width}}  {check.value}")
        if check.advice:
            typer.echo(f"{'':{8 + width}}  -> {check.advice}")
    typer.echo("everything that is needed is here" if not broken else f"{len(broken)} things are missing")
    return BAD_INPUT if broken else OK


def _versions() -> list[Check]:
    checks = [
        Check("intrasplat", product_version()),
        Check(
            "Python",
            f"{platform.python_version()} ({sys.executable})",
            sys.version_info >= (3, 11),
            "" if sys.version_info >= (3, 11) else "install Python 3.11 or later",
        ),
        Check("system", f"{platform.system()} {platform.release()} {platform.machine()}"),
    ]
    for name in PACKAGES:
        try:
            checks.append(Check(name, version(name)))
        except PackageNotFoundError:
            checks.append(Check(name, "not installed", False, f"pip install {name}"))
    return checks


def _processor() -> list[Check]:
    import torch

    from gsplat_core.machine import usable_cores
    from services.reports.schema import processor_name

    threads, cores = torch.get_num_threads(), usable_cores()
    advice = "" if threads <= cores else f"set OMP_NUM_THREADS={cores}: more threads than cores slow each other down"
    return [
        Check("processor", f"{processor_name()}, {cores} usable cores"),
        Check("vectors of the processor", torch.backends.cpu.get_cpu_capability()),
        Check("threads", f"{threads} (OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'not set')})", advice=advice),
    ]


def _core() -> list[Check]:
    import torch

    from gsplat_core.errors import NativeLibraryMissing

    try:
        from gsplat_core.ops.native import LIBRARY_PATH, instruction_set
    except NativeLibraryMissing as error:
        return [Check("compiled core", "missing", False, str(error))]
    names = sorted(
        name.removeprefix("gsplat_core::")
        for name in torch._C._dispatch_get_all_op_names()
        if name.startswith("gsplat_core::")
    )
    where: dict[str, list[str]] = {"CPU": [], "CUDA": []}
    for name in names:
        for key, found in where.items():
            if torch._C._dispatch_has_kernel_for_dispatch_key(f"gsplat_core::{name}", key):
                found.append(name)
    return [
        Check("compiled core", str(LIBRARY_PATH)),
        Check("instruction set in use", instruction_set()),
        Check("ops on the CPU", f"{len(where['CPU'])}: {', '.join(where['CPU'])}"),
        *_cuda(where["CUDA"]),
    ]


def _cuda(ops: list[str]) -> list[Check]:
    """Check for a usable GPU, for compiled CUDA kernels, and that the kernels support the GPU."""
    from gsplat_core.ops.native import CUDA_MISSING, cuda_build, cuda_refusal

    graphics = find_graphics()
    gpu = Check("GPU", graphics.found, graphics.usable, graphics.advice, needed=False)
    if CUDA_MISSING is not None:
        advice = (
            "`make cuda` builds them for this GPU; until then everything runs on the CPU"
            if graphics.usable
            else "not needed: everything runs on the CPU"
        )
        return [gpu, Check("CUDA kernels", CUDA_MISSING, False, advice, needed=False)]
    refusal = cuda_refusal() if graphics.usable else None
    built = Check(
        "CUDA kernels",
        f"built by {cuda_build().replace('for', 'for compute capability')}"
        + (f", which this GPU refuses: {refusal}" if refusal else ""),
        refusal is None,
        "" if refusal is None else "`make cuda` builds them for this GPU; until then use --device cpu",
        needed=False,
    )
    return [gpu, built, Check("ops on the GPU", f"{len(ops)}: {', '.join(ops)}", needed=False), _mps()]


def _mps() -> Check:
    """Check for the program that lets several streams use one GPU at the same time."""
    program = shutil.which(MPS_CONTROL)
    advice = "" if program else "only needed for several streams on one GPU (setting gpu.mps); NVIDIA's driver has it"
    return Check("Multi-Process Service", program or "not installed", program is not None, advice, needed=False)


def _video() -> list[Check]:
    import tempfile
    from pathlib import Path

    import av
    import numpy as np

    from operators.errors import OutputError
    from operators.sinks.video import CODEC, VideoFile

    try:
        with tempfile.TemporaryDirectory() as folder, VideoFile(Path(folder) / "probe.mp4", 64, 48, 30.0) as video:
            video.write(np.zeros((48, 64, 3), np.uint8))
    except OutputError as error:
        return [Check("video", "cannot be written", False, str(error))]
    return [Check("video", f"PyAV {av.__version__} writes {CODEC}")]


def _holoscan() -> list[Check]:
    if importlib.util.find_spec("holoscan") is None:
        return [
            Check(
                "Holoscan engine", "not installed", False, "optional: pip install 'intrasplat[holoscan]'", needed=False
            )
        ]
    return [Check("Holoscan engine", version("holoscan-cu13"), needed=False)]


OLDEST = (8, 0)
"""Minimum compute capability: the CUDA kernels use Ampere instructions."""
DRIVER, DEVICE, WSL = Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"), Path("/dev/dxg")


@dataclass(frozen=True)
class Graphics:
    """Result of the GPU detection: what was found, whether it is usable, and the remedy."""

    usable: bool
    found: str
    advice: str = ""
    """Remedy; empty if the GPU is usable or there is no remedy."""


def find_graphics() -> Graphics:
    """Query torch, and inspect the driver's files for the reason if torch sees no GPU."""
    import torch

    if torch.version.cuda is None:
        return Graphics(False, f"none that torch {torch.__version__} could use: it was built without CUDA")
    if not torch.cuda.is_available():
        return _unseen(torch.version.cuda)
    names, capabilities = [], []
    for k in range(torch.cuda.device_count()):
        capabilities.append(torch.cuda.get_device_capability(k))
        names.append("{} (compute capability {}.{})".format(torch.cuda.get_device_name(k), *capabilities[-1]))
    found = ", ".join(names)
    if capabilities[0] < OLDEST:
        return Graphics(False, found, "the CUDA kernels need compute capability {}.{} or later".format(*OLDEST))
    return Graphics(True, found)


def _unseen(cuda: str) -> Graphics:
    """Explain why torch sees no GPU. A container always has the host driver's version file, but not the device file."""
    if DEVICE.exists() or WSL.exists():
        return Graphics(
            False,
            f"one is here, and torch, built for CUDA {cuda}, cannot start it ({_why_cuda_does_not_start()})",
            f"install an NVIDIA driver for CUDA {cuda} or later; CUDA_VISIBLE_DEVICES must not hide the GPU",
        )
    if DRIVER.exists():
        return Graphics(
            False, "none here, though this machine has NVIDIA's driver", "in a container, start it with `--gpus all`"
        )
    return Graphics(
        False, "none: this machine has no NVIDIA driver", "not needed; with an NVIDIA GPU, install its driver"
    )


def _why_cuda_does_not_start() -> str:
    import torch

    try:
        torch.cuda.init()
    except (RuntimeError, AssertionError) as error:
        return str(error).splitlines()[0].rstrip(". ")
    return "it says no more"


def main() -> int:
    """Print whether the GPU works.

    Returns:
        The exit code; 0 if a GPU is usable.
    """
    graphics = find_graphics()
    print("NVIDIA GPU:", graphics.found + (f"; {graphics.advice}" if graphics.advice else ""))  # noqa: T201 - its purpose
    return 0 if graphics.usable else 1


if __name__ == "__main__":
    sys.exit(main())
