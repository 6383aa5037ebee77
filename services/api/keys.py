"""API keys: listed, created and revoked by administrators; every caller may query its own key and create single-use tickets.

A token is returned only at creation.
"""

from __future__ import annotations

import asyncio

from starlette.requests import Request

from services.api.guard import CallerOf, new_router, recorded, requires
from services.api.problems import Conflicting, Missing
from services.api.state import ControlState, control_of
from services.auth.keys import ApiKey, KeyConflict, Role, limits_of
from services.schemas import CallerView, KeyView, MadeKey, NewKey, Ticket, TicketFor

router = new_router("keys")


@router.get("/me")
@requires("viewer", scope="any")
async def who_am_i(request: Request, caller: CallerOf) -> CallerView:
    """Return name, role and limits of the calling key."""
    key = next((key for key in control_of(request).keys.all() if key.id == caller.key_id), None)
    return CallerView(
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


@router.post("/tickets", status_code=201)
@requires("viewer", scope="any")
async def give_ticket(request: Request, caller: CallerOf, wanted: TicketFor) -> Ticket:
    """Create a ticket with the role of this key; send it as `?ticket=…`."""
    tickets = control_of(request).tickets
    return Ticket(ticket=tickets.give(caller, wanted.path), expires_s=tickets.lifetime_s)
