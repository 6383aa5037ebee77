"""API keys: listed, created and revoked by administrators. A token is returned only at creation.
Every caller may query its own key."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.auth.key_changes import limits_of
from services.control.auth.keys import MOST_STREAMS, ApiKey, KeyConflict
from services.control.auth.roles import Role
from services.control.moments import Moment
from services.control.problems import Conflicting, Missing
from services.control.recorded import recorded
from services.control.state import ControlState, control_of
from services.settings import ResourceName

router = new_router("keys")


class NewKey(BaseModel):
    """New key. A name may have two valid keys with the same role, for a change-over."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: ResourceName
    role: Literal["viewer", "operator", "admin"] = Field(examples=["viewer"])
    expires_at: Moment | None = Field(
        None, description="Refused from then on, with a time zone; null: never.", examples=["2099-01-01T00:00:00Z"]
    )
    streams: list[ResourceName] | None = Field(
        None,
        min_length=1,
        max_length=MOST_STREAMS,
        description="Streams that the key is limited to: it can use nothing else. null: not limited. Not for an administrator.",
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
    expires_at: str | None = Field(None, description="Refused from then on; null: never.")
    streams: list[str] | None = Field(None, description="Streams that it is limited to; null: not limited.")
    last_used_at: str | None = Field(None, description="null: never, or by a version that did not note it.")
    expired: bool = False

    @field_validator("streams", mode="before")
    @classmethod
    def _as_list(cls, streams: tuple[str, ...] | list[str] | None) -> list[str] | None:
        return None if streams is None else list(streams)


class MadeKey(KeyView):
    """New key with its token, which is not stored and not returned again."""

    key: str = Field(examples=["intrasplat_1f0c9a3b_…"])


class Myself(BaseModel):
    """Identity of the caller."""

    name: str = Field(examples=["console"])
    key_id: str
    role: Role
    streams: list[str] | None = Field(description="Streams that the key is limited to; null: not limited.")
    expires_at: str | None = Field(description="null: never, or a person who has signed in elsewhere.")
    federated: bool = Field(description="A person of an OpenID Connect issuer.")


@router.get("/me")
@requires("viewer", scope="any")
async def who_am_i(request: Request, caller: CallerOf) -> Myself:
    """Return name, role and limits of the calling key."""
    key = next((key for key in control_of(request).keys.all() if key.id == caller.key_id), None)
    return Myself(
        name=caller.name, key_id=caller.key_id, role=caller.role, federated=caller.federated,
        streams=None if caller.streams is None else sorted(caller.streams),
        expires_at=None if key is None else key.expires_at,
    )  # fmt: skip


@router.get("/keys")
@requires("admin")
async def keys(request: Request) -> list[KeyView]:
    """List every key, including expired ones, with the time of its last use."""
    control = control_of(request)
    used = control.keys.last_used()
    return [_view(key, used.get(key.id)) for key in control.keys.all()]


@router.post("/keys", status_code=201)
@requires("admin")
async def make_key(request: Request, caller: CallerOf, new: NewKey) -> MadeKey:
    """Create a key. 409 if the name already has two valid keys, or one with another role."""
    async with recorded(request, caller, "key.create", new.name, {"role": new.role}) as said:
        key, token = await asyncio.to_thread(_made, control_of(request), new)
        said.update({"key_id": key.id, **limits_of(key)})
    return MadeKey(**_view(key, None).model_dump(), key=token)


@router.delete("/keys/{key_id}", status_code=204)
@requires("admin")
async def revoke_key(request: Request, caller: CallerOf, key_id: str) -> None:
    """Revoke a key; later requests with it are refused."""
    store = control_of(request).keys
    if all(key.id != key_id for key in store.all()):
        raise Missing("there is no key with this number; GET /v1/keys lists them")
    async with recorded(request, caller, "key.revoke", key_id):
        try:
            await asyncio.to_thread(store.revoke, key_id)
        except KeyError as error:
            raise Missing("there is no key with this number; GET /v1/keys lists them") from error
        except KeyConflict as error:
            raise Conflicting(str(error)) from error


def _made(control: ControlState, new: NewKey) -> tuple[ApiKey, str]:
    try:
        return control.keys.create(new.name, Role(new.role), expires_at=new.expires_at, streams=new.streams)
    except KeyConflict as error:
        raise Conflicting(str(error)) from error


def _view(key: ApiKey, used_at: str | None) -> KeyView:
    return KeyView.model_validate(key).model_copy(update={"last_used_at": used_at, "expired": key.has_expired()})
