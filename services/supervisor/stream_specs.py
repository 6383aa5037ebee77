"""Conversion of an API stream to the specification of its processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from operators.options import Section, options_for
from operators.settings import check_stream_options
from operators.sources.registry import check_address
from services.api.parts import NewStream
from services.supervisor.specs import EngineSpec, SourceSpec, StreamSpec

NVIDIA = Path("/proc/driver/nvidia/gpus")


def spec_of(stream: NewStream) -> StreamSpec:
    """Build the specification of a stream.

    Raises:
        InvalidSetting: if an option is unknown or out of range.
    """
    options = {name: value for name, value in stream.options.items() if value is not None}
    check_stream_options(options)
    device, gpu = _device(stream.device)
    check_address(stream.source)

    def of(kind: type[Section]) -> dict[str, Any]:
        return {name: value for name, value in options.items() if name in options_for(kind, "stream")}

    return StreamSpec(
        name=stream.name,
        source=SourceSpec(address=stream.source, **of(SourceSpec)),
        engine=EngineSpec(device=device, gpu=gpu, **of(EngineSpec)),
    )


def gpus() -> int:
    """Return the number of NVIDIA GPUs from the driver's files, without loading a library."""
    return len(list(NVIDIA.iterdir())) if NVIDIA.is_dir() else 0


def _device(wanted: str) -> tuple[Any, int | None]:
    if wanted == "auto":
        return ("cuda" if gpus() else "cpu"), None
    kind, _, number = wanted.partition(":")
    return kind, int(number) if number else None
