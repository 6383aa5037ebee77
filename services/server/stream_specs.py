"""Conversion of an API stream to the specification of its processes."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gsplat_core.errors import InvalidSetting
from services.control.parts import NewStream
from services.server.source_options import check_source_options
from services.supervisor.specs import EngineSpec, SourceSpec, StreamSpec

OF_SOURCE = frozenset(SourceSpec.model_fields) - {"address"}
OF_ENGINE = frozenset(EngineSpec.model_fields) - {"device", "gpu"}
KNOWN: Mapping[str, tuple[str, ...]] = {
    "field": ("auto", "basis", "hexplane"),
    "renderer": ("alpha",),
    "tool_mask": ("recorded", "builtin", "onnx", "none"),
    "depth": ("auto", "recorded", "stereo", "light", "parallax", "onnx", "none"),
}
"""Names in the engine's registries, repeated here because the registries load torch. A test
compares both."""
WITH_FILE = frozenset({"onnx"})
"""Names of `KNOWN` that need a file, as in `onnx:/models/depth.onnx`."""
NVIDIA = Path("/proc/driver/nvidia/gpus")


def spec_of(stream: NewStream) -> StreamSpec:
    """Build the specification of a stream.

    Raises:
        InvalidSetting: if an option is unknown or out of range.
    """
    options = {name: value for name, value in stream.options.items() if value is not None}
    for name in sorted(set(options) - OF_SOURCE - OF_ENGINE):
        near = difflib.get_close_matches(name, OF_SOURCE | OF_ENGINE, n=1, cutoff=0.0)[0]
        raise InvalidSetting(f"a stream has no option {name!r:.60}; the nearest is {near!r}")
    device, gpu = _device(stream.device)
    check_source_options(stream.source)
    for name, known in KNOWN.items():
        if name in options:
            _check_choice(name, options[name], known)
    try:
        return StreamSpec(
            name=stream.name,
            source=SourceSpec(address=stream.source, **_of(options, OF_SOURCE)),
            engine=EngineSpec(device=device, gpu=gpu, **_of(options, OF_ENGINE)),
        )
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        raise InvalidSetting(f"{first['loc'][-1]}: {first['msg']}") from None


def _check_choice(option: str, given: Any, known: Sequence[str]) -> None:
    """Check the value of a named option.

    Raises:
        InvalidSetting: if the name is unknown, or a file is missing or superfluous.
    """
    name, colon, file = str(given).partition(":")
    if name not in known or not isinstance(given, str):
        raise InvalidSetting(f"{option} is {given!r:.60}; choose {', '.join(known)}")
    if name not in WITH_FILE and colon:
        raise InvalidSetting(f"{option} is {given!r:.60}; nothing follows {name}, write {name!r}")
    if name in WITH_FILE and not Path(file).is_absolute():
        raise InvalidSetting(
            f"{option} is {given!r:.60}; give the absolute path of a file, as {name}:/models/{option}.onnx"
        )
    if name in WITH_FILE and not (Path(file).suffix == ".onnx" and Path(file).is_file()):
        raise InvalidSetting(f"{option}: {file!r:.200} is no file of the server that ends in .onnx; check the path")


def gpus() -> int:
    """Return the number of NVIDIA GPUs from the driver's files, without loading a library."""
    return len(list(NVIDIA.iterdir())) if NVIDIA.is_dir() else 0


def _device(wanted: str) -> tuple[Any, int | None]:
    if wanted == "auto":
        return ("cuda" if gpus() else "cpu"), None
    kind, _, number = wanted.partition(":")
    return kind, int(number) if number else None


def _of(options: Mapping[str, Any], names: frozenset[str]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name in names}
