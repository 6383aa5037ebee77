"""Records of the API's requests and answers: models, recordings, replays, streams, keys, audit log and the service's state."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    Strict,
    field_validator,
    model_validator,
)

from operators.settings import CallerJobOptions, CallerRenderOptions, stream_options_schema
from services.auth.keys import MOST_STREAMS, Role
from services.exports.files import PICTURES, RenderWish
from services.settings import ResourceName, StreamSettings, masked_address


class VersionView(BaseModel):
    """Model version. `state`: uploaded, validated, ready, active, retired, or rejected with a reason."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    version: int = Field(examples=[3])
    state: str = Field(examples=["ready"])
    reason: str | None = None
    digest: str = Field(description="SHA-256 of the uploaded file; of a splat file, that of the model made from it.")
    size_bytes: int
    uploaded_at: datetime | str
    uploaded_by: str
    description: dict[str, Any] = Field(
        {},
        examples=[{"gaussians": 20480, "field": None, "renderer": "alpha"}],
        description="Results of the check: Gaussians, deformation field (null for a static model), renderer that trained the"
        " model, picture size, time window.",
    )


class ModelView(BaseModel):
    """Model and its active version."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    active: int | None = Field(examples=[3])


class RenderRequest(BaseModel):
    """Rendering of a model: a picture at one time, or a video over its time window."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"format": "png", "options": {"outputs": ["image", "normals"]}}]},
    )
    format: Literal["png", "mp4"] = "png"
    view: Literal["recorded", "orbit", "stereo"] = Field(
        "recorded", description="Camera: the model's own, an orbit, or a stereo pair side by side."
    )
    time_s: FiniteFloat | None = Field(
        None,
        strict=True,
        ge=-1e9,
        le=1e9,
        description="Time of a picture within the model's time window, in seconds. Default: the end of the window.",
        examples=[0.5],
    )
    options: CallerRenderOptions = CallerRenderOptions()

    @model_validator(mode="after")
    def _picture_or_video(self) -> RenderRequest:
        self.wish()
        return self

    def wish(self) -> RenderWish:
        """Return the request for the export program."""
        return RenderWish(PICTURES[self.format], self.options, self.view, self.time_s)


class Activation(BaseModel):
    """Version to activate, and the version that the caller expects to be active. A different active
    version refuses the request."""

    model_config = ConfigDict(extra="forbid", strict=True)
    version: int = Field(ge=1, le=2**31 - 1, examples=[3])
    expected_current: int | None = Field(
        ge=1, le=2**31 - 1, examples=[2], description="Version that the caller expects to be active; null: none."
    )


class RecordingDescription(BaseModel):
    """Properties found in a recording."""

    model_config = ConfigDict(extra="ignore")
    layout: str | None = Field(None, examples=["video"])
    frames: int | None = Field(None, examples=[900])
    frames_damaged: int | None = None
    width_px: int | None = Field(None, examples=[640])
    height_px: int | None = Field(None, examples=[512])
    fps: float | None = Field(None, examples=[30.0])
    duration_s: float | None = Field(None, examples=[30.0])
    fields: list[str] = Field([], examples=[["depth", "mask"]])
    calibration: str | None = None
    warnings: int = 0


class RecordingView(BaseModel):
    """Recording. `state`: uploaded, ready, rejected with a reason, or missing if its files are gone from the disk."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["case-7"])
    kind: str = Field(examples=["video"], description="`video` or `archive`.")
    state: str = Field(examples=["ready"])
    reason: str | None = None
    digest: str = Field(description="SHA-256 of the uploaded file.")
    size_bytes: int = Field(description="Size of the uploaded file in bytes.")
    kept_bytes: int = Field(description="Disk space used, in bytes.")
    uploaded_at: datetime | str
    uploaded_by: str
    description: RecordingDescription = RecordingDescription.model_validate({})


MOST_RECORDINGS = 2000


class ReplayRequest(BaseModel):
    """One recording or a batch of recordings, with replay options."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"recording": "case-7", "options": {"steps_per_frame": 20}}]},
    )
    recording: ResourceName | None = Field(None, examples=["case-7"])
    recordings: list[ResourceName] = Field([], max_length=MOST_RECORDINGS, examples=[[]])
    options: CallerJobOptions = CallerJobOptions()

    @model_validator(mode="after")
    def _one_or_many(self) -> ReplayRequest:
        if (self.recording is None) == (not self.recordings):
            raise ValueError("give `recording` or `recordings`, one of them")
        return self

    @property
    def names(self) -> list[str]:
        """Return the names of the recordings, also of a single one."""
        return self.recordings if self.recording is None else [self.recording]


class Submitted(BaseModel):
    """Queued replays, one per recording, in order."""

    id: str | None = Field(
        description="Id of the replay, if the request named one recording.", examples=["1f0c9a3b5d7e8f20"]
    )
    batch: str = Field(examples=["8f20c9a35d7e1f0b"])
    ids: list[str] = Field(examples=[["1f0c9a3b5d7e8f20"]])


class ReplayView(BaseModel):
    """Record of a job that replays an uploaded recording with chosen options. `state`: queued, running, done, failed or cancelled; `reason` explains it."""

    model_config = ConfigDict(from_attributes=True)
    id: str = Field(examples=["1f0c9a3b5d7e8f20"])
    number: int = Field(examples=[12])
    batch: str = Field(examples=["8f20c9a35d7e1f0b"])
    recording: str = Field(examples=["case-7"])
    options: dict[str, Any] = Field(
        examples=[{"steps_per_frame": 20}], description="Options that differ from the defaults."
    )
    state: str = Field(examples=["running"])
    reason: str | None = None
    attempts: int = Field(examples=[1], description="Number of attempts. A job is attempted again if its process dies.")
    frames_done: int = Field(examples=[300])
    frames: int | None = Field(None, examples=[900])
    psnr_db: float | None = Field(
        None, examples=[36.5], description="PSNR over tissue of the newest displayed frame (training error)."
    )
    previous_frame_db: float | None = Field(
        None, examples=[35.9], description="Baseline: PSNR over tissue of the previous raw frame."
    )
    next_frame_db: float | None = Field(
        None,
        examples=[34.8],
        description="PSNR over tissue of the newest frame, predicted before the model was trained on it.",
    )
    created_by: str
    created_at: str
    started_at: str | None = None
    ended_at: str | None = None
    results: list[str] = Field(
        [], examples=[["report.html", "report.json"]], description="Result files available for download."
    )


class BatchView(BaseModel):
    """Number of replays of a batch in each state."""

    batch: str = Field(examples=["8f20c9a35d7e1f0b"])
    states: dict[str, int] = Field(examples=[{"queued": 3, "running": 1, "done": 196, "failed": 0, "cancelled": 0}])


class ModelTarget(BaseModel):
    """Target model for a replay's model."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"model": "liver"}]})
    model: ResourceName


_DATE_AND_TIME = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d.*")


def _text(value: object) -> object:
    if not isinstance(value, str) or not _DATE_AND_TIME.fullmatch(value):
        raise ValueError("it is no date and time with a zone, such as 2026-11-23T20:30:00+01:00")
    return value


def _in_utc(moment: datetime) -> datetime:
    """Convert a timestamp to UTC.

    Raises:
        ValueError: if the result is not in the years 1 to 9999.
    """
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("it is before the year 1 or after the year 9999 in UTC") from error


Moment = Annotated[AwareDatetime, Strict(False), BeforeValidator(_text), AfterValidator(_in_utc)]


@dataclass(frozen=True)
class CheckResult:
    """Result of one health check. The service is ready if all needed checks are ok, and degraded if another check is not."""

    ok: bool
    detail: str = ""
    needed: bool = True


class Readiness(BaseModel):
    """Readiness of the service. `degraded` still counts as ready: a component that is not required,
    such as a camera, has a problem."""

    status: Literal["ready", "degraded", "not ready"]
    checks: dict[str, CheckResult] | None = None


class Alive(BaseModel):
    """Liveness of the process."""

    status: Literal["alive"] = "alive"


class Version(BaseModel):
    """Versions, and the available parts of this server."""

    version: str = Field(examples=["0.1.0"])
    api: str = "v1"
    python: str
    fastapi: str
    parts: list[str] = Field(examples=[["models", "streams"]])


class NewKey(BaseModel):
    """Body of a request that creates an API key. A name may have two valid keys of one role, for a change-over."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: ResourceName
    role: Literal["viewer", "operator", "admin"] = Field(examples=["viewer"])
    expires_at: Moment | None = Field(
        None, description="Expiry time, with a time zone; null: never.", examples=["2099-01-01T00:00:00Z"]
    )
    streams: list[ResourceName] | None = Field(
        None,
        min_length=1,
        max_length=MOST_STREAMS,
        description="Streams that the key is limited to; it can use nothing else. null: not limited. Not possible for the role"
        " admin.",
        examples=[["theatre-1"]],
    )

    @field_validator("expires_at")
    @classmethod
    def _to_come(cls, expires_at: datetime | None) -> datetime | None:
        if expires_at is not None and expires_at <= datetime.now(UTC):
            raise ValueError("it is over already; give a time to come")
        return expires_at


class KeyView(BaseModel):
    """API key without its secret."""

    model_config = ConfigDict(from_attributes=True)
    id: str = Field(examples=["1f0c9a3b"])
    name: str
    role: Role
    created_at: str
    expires_at: str | None = Field(None, description="Expiry time; null: never.")
    streams: list[str] | None = Field(None, description="Streams that the key is limited to; null: not limited.")
    last_used_at: str | None = Field(
        None,
        description="Time of the last use; null: never used, or used only by a server version that did not record it.",
    )
    expired: bool = False

    @field_validator("streams", mode="before")
    @classmethod
    def _as_list(cls, streams: tuple[str, ...] | list[str] | None) -> list[str] | None:
        return None if streams is None else list(streams)


class MadeKey(KeyView):
    """New key with its token, which is not stored and not returned again."""

    key: str = Field(examples=["intrasplat_1f0c9a3b_…"])


class CallerView(BaseModel):
    """Identity of the caller."""

    name: str = Field(examples=["console"])
    key_id: str
    role: Role
    streams: list[str] | None = Field(description="Streams that the key is limited to; null: not limited.")
    expires_at: str | None = Field(
        description="Expiry time of the key; null: never, or the caller signed in by OpenID Connect."
    )
    federated: bool = Field(description="True if the caller signed in by OpenID Connect.")


class TicketFor(BaseModel):
    """Target of a ticket."""

    model_config = ConfigDict(extra="forbid", strict=True)
    path: str = Field(
        pattern=r"^/v1/[A-Za-z0-9/._-]{1,200}$",
        description="Path of the later request, without its query.",
        examples=["/v1/streams/endoscope/display"],
    )


class Ticket(BaseModel):
    """Single-use ticket for one path, with its lifetime."""

    ticket: str
    expires_s: float


class EntryView(BaseModel):
    """Audit log entry."""

    model_config = ConfigDict(from_attributes=True)
    seq: int
    at: str = Field(description="Time of the entry in UTC.", examples=["2026-11-23T20:31:07.123+00:00"])
    event: str = Field(examples=["model.activate"])
    actor: str = Field(examples=["console (1f0c9a3b)"])
    role: str
    subject: str = Field(examples=["liver/3"])
    outcome: str = Field(examples=["done"])
    request_id: str
    detail: dict[str, str | int | float | bool | None]


class AuditPage(BaseModel):
    """Audit entries, newest first, with the digest of the newest entry of the log. A copy of the
    digest elsewhere reveals truncation of the log."""

    entries: list[EntryView]
    head_seq: int
    head_digest: str
    next_before: int | None = Field(
        description="Value of `before` for the next page; null on the last page. A filtered page may have few or no entries "
        "although more pages follow, because each request searches a part of the log."
    )


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
