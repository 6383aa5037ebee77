"""Single-use tickets for the URL of a WebSocket or a picture, where a browser cannot send a key."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.state import control_of

router = new_router("keys")


class TicketFor(BaseModel):
    """Target of a ticket."""

    model_config = ConfigDict(extra="forbid", strict=True)
    path: str = Field(
        pattern=r"^/v1/[A-Za-z0-9/._-]{1,200}$",
        description="The path that will be asked for, without its query.",
        examples=["/v1/streams/endoscope/display"],
    )


class Ticket(BaseModel):
    """Single-use ticket for one path, with its lifetime."""

    ticket: str
    expires_s: float


@router.post("/tickets", status_code=201)
@requires("viewer", scope="any")
async def give_ticket(request: Request, caller: CallerOf, wanted: TicketFor) -> Ticket:
    """Create a ticket with the role of this key; send it as `?ticket=…`."""
    tickets = control_of(request).tickets
    return Ticket(ticket=tickets.give(caller, wanted.path), expires_s=tickets.lifetime_s)
