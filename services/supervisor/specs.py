"""What a stream is asked for."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from gsplat_core.errors import InvalidSetting
from services.bus.runtime import Role, StreamFolder, read_json, write_json

StreamName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]


class _Strict(BaseModel):
    """Base class of the specifications: no unknown names, and no value that pydantic would convert, such as true for the number 1."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class SourceSpec(_Strict):
    """Where a stream's frames come from, and what is done to them in the capture process."""

    address: Annotated[str, StringConstraints(min_length=1, max_length=4096)]
    """As `intrasplat live` takes it."""
    scale: float = Field(default=1.0, gt=0, le=4)
    fps: float | None = Field(default=None, gt=0, le=1000)
    """Play a recording at this rate in place of its own."""
    loop: bool = True
    """Play a recording over and over."""


class EngineSpec(_Strict):
    """How a stream is reconstructed."""

    device: Literal["cpu", "cuda"] = "cpu"
    gpu: int | None = Field(default=None, ge=0, le=1023)
    """Which GPU (`CUDA_VISIBLE_DEVICES`); None: whichever is the first."""
    engine_scale: float | None = Field(default=None, gt=0, le=1)
    """Size of what is reconstructed beside the stream's pictures. None: the whole, and on a CPU what this machine keeps up with
    (`services.supervisor.engine_size`)."""
    field: str = "auto"
    renderer: str = "alpha"
    seed: int = Field(default=0, ge=0, lt=2**31)
    budget_ms: float | None = Field(default=None, gt=0, le=10_000)
    tool_mask: str = "builtin"
    depth: Annotated[str, StringConstraints(min_length=1, max_length=4096)] = "auto"
    """Where depth comes from, as `intrasplat live` takes it."""
    eyes: Literal["left", "both"] = "left"
    """Which pictures of a stereo scope are trained on."""
    poses: Literal["given", "estimated"] = "given"
    """Where the scope is: as the frames say, or as is estimated from the pictures."""
    out_of_body: Literal["withhold", "off"] = "withhold"


class ProcessLimits(_Strict):
    """How long processes may take, and how long they stay by themselves."""

    orphan_after_s: float = Field(default=600.0, gt=0)
    """A process that no supervisor asks for anything ends after so long."""
    drain_s: float = Field(default=10.0, gt=0)
    """From being asked to stop to being killed."""
    start_s: float = Field(default=120.0, gt=0)
    """From the start of a process to its first heartbeat."""
    heartbeat_s: float = Field(default=3.0, gt=0)
    """A process that says nothing for so long does not work any more."""
    hung_s: float = Field(default=10.0, gt=0)
    """Nor does an engine that has shown something and publishes nothing for so long: it would at least repeat its last picture with another age."""


class StreamSpec(_Strict):
    """A stream. Raises pydantic's ValidationError for what cannot be one."""

    name: StreamName
    source: SourceSpec
    engine: EngineSpec = EngineSpec()
    limits: ProcessLimits = ProcessLimits()

    def part(self, role: Role) -> dict[str, Any]:
        """What one of its processes has to know."""
        about = self.source if role == "capture" else self.engine
        return {
            "stream": self.name,
            "role": role,
            role: about.model_dump(mode="json"),
            "limits": self.limits.model_dump(mode="json"),
        }

    def digest(self, role: Role) -> str:
        """Changes when that process has to be started anew."""
        return hashlib.sha256(repr(sorted(self.part(role).items())).encode()).hexdigest()

    def write(self, role: Role, folder: StreamFolder) -> Path:
        """Write the file for that process; it may hold a password, and only its owner may read it."""
        path = folder.spec(role)
        write_json(path, {**self.part(role), "digest": self.digest(role)})
        return path


class ProcessSpec(_Strict):
    """What a process reads from its file."""

    stream: StreamName
    role: Role
    digest: str
    capture: SourceSpec | None = None
    engine: EngineSpec | None = None
    limits: ProcessLimits

    @staticmethod
    def read(path: Path) -> ProcessSpec:
        """From a file that `StreamSpec.write` wrote. Raises InvalidSetting."""
        try:
            return ProcessSpec.model_validate(read_json(path))
        except OSError as error:
            raise InvalidSetting(f"{path} cannot be read: {error.strerror}") from None
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise InvalidSetting(f"{path}: {where}: {first['msg']}") from None


def assigned(specs: list[StreamSpec], gpus: int) -> list[StreamSpec]:
    """The streams, each on CUDA with a GPU of its own as long as there are enough; those that name one keep it."""
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
            spec = spec.model_copy(update={"engine": spec.engine.model_copy(update={"gpu": gpu})})
        placed.append(spec)
    return placed
