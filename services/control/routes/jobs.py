"""Replay jobs: start, status, cancel, delete."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import Header, Path, Query, Response
from pydantic import BaseModel, ConfigDict, Field, model_validator
from starlette.requests import HTTPConnection, Request

from operators.settings import CallerJobOptions
from services.control.auth.guard import CallerOf, new_router, requires
from services.control.problems import Missing, problem_answer
from services.control.recorded import recorded
from services.control.replay_parts import Jobs
from services.control.state import part
from services.settings import ResourceName

router = new_router("replays")
MOST_RECORDINGS = 2000
JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", examples=["1f0c9a3b5d7e8f20"])]
BatchId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", examples=["8f20c9a35d7e1f0b"])]
State = Literal["queued", "running", "done", "failed", "cancelled"]


class ReplayWanted(BaseModel):
    """One recording or a batch of recordings, with replay options."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"recording": "case-7", "options": {"steps_per_frame": 20}}]},
    )
    recording: ResourceName | None = Field(None, examples=["case-7"])
    recordings: list[ResourceName] = Field([], max_length=MOST_RECORDINGS, examples=[[]])
    options: CallerJobOptions = CallerJobOptions()

    @model_validator(mode="after")
    def _one_or_many(self) -> ReplayWanted:
        if (self.recording is None) == (not self.recordings):
            raise ValueError("give `recording` or `recordings`, one of them")
        return self

    @property
    def names(self) -> list[str]:
        """Return the recordings."""
        return self.recordings if self.recording is None else [self.recording]


class Submitted(BaseModel):
    """Queued replays, one per recording, in order."""

    id: str | None = Field(description="Of the replay, where one recording was named.", examples=["1f0c9a3b5d7e8f20"])
    batch: str = Field(examples=["8f20c9a35d7e1f0b"])
    ids: list[str] = Field(examples=[["1f0c9a3b5d7e8f20"]])


class ReplayView(BaseModel):
    """Replay job. `state`: queued, running, done, failed or cancelled; `reason` explains it."""

    model_config = ConfigDict(from_attributes=True)
    id: str = Field(examples=["1f0c9a3b5d7e8f20"])
    number: int = Field(examples=[12])
    batch: str = Field(examples=["8f20c9a35d7e1f0b"])
    recording: str = Field(examples=["case-7"])
    options: dict[str, Any] = Field(examples=[{"steps_per_frame": 20}], description="Those that are not the defaults.")
    state: str = Field(examples=["running"])
    reason: str | None = None
    attempts: int = Field(examples=[1], description="How often it was begun: again where its process died.")
    frames_done: int = Field(examples=[300])
    frames: int | None = Field(None, examples=[900])
    psnr_db: float | None = Field(
        None, examples=[36.5], description="Over tissue, of the newest displayed frame: its training error."
    )
    previous_frame_db: float | None = Field(
        None, examples=[35.9], description="Over tissue, of the raw frame before it, shown instead."
    )
    next_frame_db: float | None = Field(
        None,
        examples=[34.8],
        description="Over tissue, of the newest frame that was predicted before the model was trained on it.",
    )
    created_by: str
    created_at: str
    started_at: str | None = None
    ended_at: str | None = None
    results: list[str] = Field([], examples=[["report.html", "report.json"]], description="Files to download.")


class BatchView(BaseModel):
    """Number of replays of a batch in each state."""

    batch: str = Field(examples=["8f20c9a35d7e1f0b"])
    states: dict[str, int] = Field(examples=[{"queued": 3, "running": 1, "done": 196, "failed": 0, "cancelled": 0}])


def jobs_of(connection: HTTPConnection) -> Jobs:
    """Return the job store of this server."""
    return part(connection, lambda parts: parts.jobs, "replays")


def view_of(jobs: Jobs, job_id: str) -> ReplayView:
    """Return a replay with its available results."""
    job = jobs.get(job_id)
    return ReplayView.model_validate(job).model_copy(update={"results": list(jobs.files(job))})


@router.post(
    "/replays",
    status_code=202,
    responses={404: problem_answer("There is no recording of that name.")},
)
@requires("operator")
async def start_replays(
    request: Request,
    response: Response,
    caller: CallerOf,
    wanted: ReplayWanted,
    idempotency_key: str | None = Header(
        None,
        min_length=1,
        max_length=200,
        description="A second request with the same key starts nothing, and gets the same answer.",
    ),
) -> Submitted:
    """Queue a replay of one recording, or of each recording of a list."""
    jobs = jobs_of(request)
    detail: Mapping[str, Any] = {"recordings": len(wanted.names), "recording": wanted.recording}
    async with recorded(request, caller, "replay.start", wanted.recording or "batch", {**detail}) as said:
        made = await asyncio.to_thread(jobs.submit, wanted.names, wanted.options.chosen(), str(caller), idempotency_key)
        said["batch"], said["new"] = made.batch, made.is_new
    one = made.ids[0] if wanted.recording is not None else None
    response.headers["Location"] = f"/v1/batches/{made.batch}" if one is None else f"/v1/replays/{one}"
    return Submitted(id=one, batch=made.batch, ids=list(made.ids))


@router.get("/replays")
@requires("viewer")
async def replays(
    request: Request,
    count: int = Query(100, ge=1, le=500),
    before: int | None = Query(None, ge=0, le=2**31 - 1, description="Those whose number is smaller."),
    batch: str | None = Query(None, pattern=r"^[0-9a-f]{16}$", description="Of this batch alone."),
    state: State | None = Query(None, description="In this state alone."),
) -> list[ReplayView]:
    """List replays, newest first."""
    jobs = jobs_of(request)

    def found() -> list[ReplayView]:
        records = jobs.newest(count, before=before, batch=batch, state=state)
        return [ReplayView.model_validate(job).model_copy(update={"results": list(jobs.files(job))}) for job in records]

    return await asyncio.to_thread(found)


@router.get("/replays/{job_id}")
@requires("viewer")
async def replay(request: Request, job_id: JobId) -> ReplayView:
    """Return one replay."""
    return await asyncio.to_thread(view_of, jobs_of(request), job_id)


@router.get("/batches/{batch}")
@requires("viewer")
async def batch(request: Request, batch: BatchId) -> BatchView:
    """Return the progress of a batch."""
    states = await asyncio.to_thread(jobs_of(request).counts, batch)
    if not any(states.values()):
        raise Missing("there is no batch with this id; POST /v1/replays answers with the id of one")
    return BatchView(batch=batch, states=dict(states))


@router.post("/replays/{job_id}/cancel")
@requires("operator")
async def cancel_replay(request: Request, caller: CallerOf, job_id: JobId) -> ReplayView:
    """Cancel a replay: a queued one at once, a running one within a second. 409 if it has ended."""
    jobs = jobs_of(request)
    async with recorded(request, caller, "replay.cancel", job_id):
        await asyncio.to_thread(jobs.cancel, job_id, str(caller))
    return await asyncio.to_thread(view_of, jobs, job_id)


@router.delete("/replays/{job_id}", status_code=204)
@requires("admin")
async def delete_replay(request: Request, caller: CallerOf, job_id: JobId) -> None:
    """Delete an ended replay with its results. 409 if it has not ended; cancel it first."""
    jobs = jobs_of(request)
    async with recorded(request, caller, "replay.delete", job_id):
        await asyncio.to_thread(jobs.delete, job_id)
