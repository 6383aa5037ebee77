"""Records of the service in the API: health, version, keys, tickets and audit log."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    field_validator,
)

from services.auth.keys import MOST_STREAMS
from services.auth.roles import Role
from services.settings import ResourceName

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
