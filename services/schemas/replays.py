"""Records of recordings and replays in the API."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from operators.settings import CallerJobOptions
from services.settings import ResourceName


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
