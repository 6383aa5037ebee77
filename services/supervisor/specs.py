"""Specification models of streams and their processes."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from gsplat_core.errors import InvalidSetting
from operators.options import Option
from operators.settings import CallerCaptureOptions, CallerEngineOptions
from services.bus.runtime import Role, StreamFolder, read_json, write_json

StreamName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]


class _Strict(BaseModel):
    """Base class of the specifications. Rejects unknown fields and type conversions, such as true
    for the number 1."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


@dataclass(frozen=True, kw_only=True)
class SourceSpec(CallerCaptureOptions):
    """Source of a stream and the processing in the capture process."""

    address: Annotated[str, Option("Source address in the format of `intrasplat live`", commands=(), least_length=1)]


@dataclass(frozen=True, kw_only=True)
class EngineSpec(CallerEngineOptions):
    """Reconstruction settings of a stream."""

    gpu: Annotated[
        int | None,
        Option("Index of the GPU (`CUDA_VISIBLE_DEVICES`)", commands=(), null="the first one", ge=0, le=1023),
    ] = None


class ProcessLimits(_Strict):
    """Time limits of stream processes, in seconds."""

    orphan_after_s: float = Field(default=600.0, gt=0)
    """Time without supervisor requests after which a process ends itself."""
    drain_s: float = Field(default=10.0, gt=0)
    """Time from a stop request to the kill."""
    start_s: float = Field(default=120.0, gt=0)
    """Time from the process start to the first heartbeat."""
    heartbeat_s: float = Field(default=3.0, gt=0)
    """Time without heartbeats after which a process counts as hung."""
    hung_s: float = Field(default=10.0, gt=0)
    """Time without publications after which an engine counts as hung, once it has shown a picture.
    A working engine at least repeats its last picture."""


class StreamSpec(_Strict):
    """Specification of a stream. Construction raises pydantic's ValidationError for invalid values."""

    name: StreamName
    source: SourceSpec
    engine: EngineSpec = EngineSpec()
    limits: ProcessLimits = ProcessLimits()

    def part(self, role: Role) -> dict[str, Any]:
        """Return the specification of one process."""
        about = self.source if role == "capture" else self.engine
        return {
            "stream": self.name,
            "role": role,
            role: asdict(about),
            "limits": self.limits.model_dump(mode="json"),
        }

    def digest(self, role: Role) -> str:
        """Return a digest that changes if the process has to be restarted."""
        return hashlib.sha256(repr(sorted(self.part(role).items())).encode()).hexdigest()

    def write(self, role: Role, folder: StreamFolder) -> Path:
        """Write the specification file of a process, readable by its owner only because the address
        may contain a password."""
        path = folder.spec(role)
        write_json(path, {**self.part(role), "digest": self.digest(role)})
        return path


class ProcessSpec(_Strict):
    """Specification that a process reads from its file."""

    stream: StreamName
    role: Role
    digest: str
    capture: SourceSpec | None = None
    engine: EngineSpec | None = None
    limits: ProcessLimits

    @staticmethod
    def read(path: Path) -> ProcessSpec:
        """Read a file written by `StreamSpec.write`.

        Raises:
            InvalidSetting: if the file is unreadable or invalid.
        """
        try:
            return ProcessSpec.model_validate(read_json(path))
        except OSError as error:
            raise InvalidSetting(f"{path} cannot be read: {error.strerror}") from None
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise InvalidSetting(f"{path}: {where}: {first['msg']}") from None


def assigned(specs: list[StreamSpec], gpus: int) -> list[StreamSpec]:
    """Assign GPUs to CUDA streams, least loaded first. Streams that name a GPU keep it.

    Args:
        specs: the streams.
        gpus: number of GPUs.

    Returns:
        The streams with their GPUs.
    """
    if gpus < 1:
        return specs
    load = [0] * gpus
    for spec in specs:
        if spec.engine.device == "cuda" and spec.engine.gpu is not None and spec.engine.gpu < gpus:
            load[spec.engine.gpu] += 1
    placed = []
    for spec in specs:
        if spec.engine.device == "cuda" and spec.engine.gpu is None:
            gpu = load.index(min(load))
            load[gpu] += 1
            spec = spec.model_copy(update={"engine": replace(spec.engine, gpu=gpu)})
        placed.append(spec)
    return placed
