"""API keys: listed, made and revoked by administrators. A key is shown once, when it is made."""

from __future__ import annotations

import asyncio
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.auth.keys import KeyConflict
from services.control.auth.roles import Role
from services.control.problems import Conflicting, Missing
from services.control.recorded import recorded
from services.control.state import control_of
from services.settings import ResourceName

router = new_router("keys")


class NewKey(BaseModel):
    """A name may have two keys with one role, the old and the new one, while callers change over."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: ResourceName
    role: Literal["viewer", "operator", "admin"] = Field(examples=["viewer"])


class KeyView(BaseModel):
    """A key, without what makes it one."""

    model_config = ConfigDict(from_attributes=True)
    id: str = Field(examples=["1f0c9a3b"])
    name: str
    role: Role
    created_at: str


class MadeKey(KeyView):
    """A key with its secret, which is not kept and not shown again."""

    key: str = Field(examples=["intrasplat_1f0c9a3b_…"])


@router.get("/keys")
@requires("admin")
async def keys(request: Request) -> list[KeyView]:
    """Every key."""
    return [KeyView.model_validate(key) for key in control_of(request).keys.all()]


@router.post("/keys", status_code=201)
@requires("admin")
async def make_key(request: Request, caller: CallerOf, new: NewKey) -> MadeKey:
    """Make a key."""
    store = control_of(request).keys
    async with recorded(request, caller, "key.create", new.name, {"role": new.role}) as said:
        try:
            key, token = await asyncio.to_thread(store.create, new.name, Role(new.role))
        except KeyConflict as error:
            raise Conflicting(str(error)) from error
        said["key_id"] = key.id
    return MadeKey(id=key.id, name=key.name, role=key.role, created_at=key.created_at, key=token)


@router.delete("/keys/{key_id}", status_code=204)
@requires("admin")
async def revoke_key(request: Request, caller: CallerOf, key_id: str) -> None:
    """Revoke a key: it is refused from now on."""
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
