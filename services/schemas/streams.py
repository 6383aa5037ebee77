"""Records of streams in the API: settings, state, virtual camera and snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from operators.settings import stream_options_schema
from services.schemas.models import VersionView
from services.settings import ResourceName, StreamSettings
from services.settings.sections import masked_address

MOST_OPTIONS = 50
Option = str | int | FiniteFloat | bool | list[str] | None


class StreamOptions(BaseModel):
    """Source and reconstruction options by name; null restores the default."""

    model_config = ConfigDict(extra="forbid", strict=True)
    options: dict[str, Option] = Field(
        max_length=MOST_OPTIONS, examples=[{"tool_mask": "builtin"}], json_schema_extra=stream_options_schema()
    )


class StreamRequest(StreamSettings):
    """Body of a request that creates a stream."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: ResourceName
    start: bool = Field(True, description="Start the stream immediately.")
    options: dict[str, Any] = Field({}, max_length=MOST_OPTIONS, json_schema_extra=stream_options_schema())

    @field_validator("options")
    @classmethod
    def _plain(cls, options: dict[str, Any]) -> dict[str, Any]:
        return StreamOptions(options=options).options


class StreamView(BaseModel):
    """Stream. `state`: stopped, starting, live, behind, stale, frozen, source lost or failed; `reason` explains it."""

    name: str = Field(examples=["endoscope"])
    source: str = Field(examples=["rtsp://10.0.0.5/stream"])
    show: str = Field(examples=["live"])
    device: str = Field(examples=["cuda:0"])
    options: dict[str, Any]
    state: str = Field(examples=["live"])
    reason: str | None = None
    processes: dict[str, dict[str, Any]] = Field(
        {},
        description="State of the capture and engine process: `state`, `reason`, `pid`, `restarts`, `rate_hz` (frames captured"
        " or pictures displayed per second), `heard_s` (seconds since the last heartbeat) and `figures`. The "
        "figures of the engine contain the newest `picture` with its `age_ms` and its `psnr_db`, which is a "
        "training error and not the score of a held-out frame.",
    )
    viewers: dict[str, int] = Field(
        {}, description="Number of open displays per picture.", examples=[{"raw": 1, "shown": 2}]
    )

    @field_validator("source")
    @classmethod
    def _without_credentials(cls, source: str) -> str:
        return masked_address(source)

    @field_validator("options", "processes", "viewers", mode="before")
    @classmethod
    def _as_dict(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        return dict(values)


class VirtualCamera(BaseModel):
    """Position of the virtual camera relative to the endoscope. It orbits the centre of the endoscope's picture."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"azimuth_deg": 20, "elevation_deg": 10}]}
    )
    azimuth_deg: float = Field(0.0, ge=-75, le=75, description="Rotation to the right, in degrees.")
    elevation_deg: float = Field(0.0, ge=-75, le=75, description="Rotation upwards, in degrees.")
    zoom: float = Field(1.0, ge=0.25, le=4, description="Magnification.")


class SnapshotRequest(BaseModel):
    """Body of a request for a snapshot: where it is stored."""

    model_config = ConfigDict(extra="forbid", strict=True)
    model: ResourceName | None = Field(
        None,
        description="Model that gets the snapshot as its next version. Default: the snapshot is stored as a file.",
        examples=["liver"],
    )


class SnapshotView(BaseModel):
    """Model of a stream at one frame."""

    model_config = ConfigDict(from_attributes=True)
    id: str | None = Field(
        None,
        examples=["1f0c9a3b5d7e8f20"],
        description="Id of the stored file; null if the snapshot became a model version.",
    )
    stream: str = Field(examples=["theatre-1"])
    taken_at: datetime | str
    taken_by: str
    seq: int = Field(description="Sequence number of the frame.")
    model_version: int = Field(description="Version of the live model, as in the metadata of pictures.")
    gaussians: int
    time_window_s: list[float] = Field(
        description="First and last time of the model, in seconds.", examples=[[2.0, 5.0]]
    )
    pause_ms: float = Field(description="Pause of training in milliseconds. The frame's picture is not delayed.")
    size_bytes: int
    digest: str = Field(description="SHA-256 of the manifest, which contains the SHA-256 of the tensors.")
    version: VersionView | None = Field(None, description="Model version created from the snapshot.")
