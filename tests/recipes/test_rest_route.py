"""The recipe of a REST route in CONTRIBUTING.md: a guarded route with an audit entry; and the places of a console page."""

from __future__ import annotations

import re

from fastapi import Request
from starlette.testclient import TestClient

from services.api import Parts, new_app
from services.api.guard import CallerOf, new_router, recorded, requires
from services.audit import Wanted, search
from services.auth.keys import Role
from services.console import FILES, PAGE
from services.settings import ServiceSettings

router = new_router("notes")
notes = {"1": "first"}


@router.delete("/notes/{number}", status_code=204)
@requires("operator")
async def delete_note(request: Request, caller: CallerOf, number: str) -> None:
    """Delete a note."""
    async with recorded(request, caller, "note.delete", number):
        notes.pop(number, None)


def test_a_route_is_guarded_audited_and_documented(tmp_path):
    settings = ServiceSettings(paths={"data": tmp_path}, server={"allowed_hosts": ["testserver"]})
    app = new_app(settings, Parts(routers=[router]))
    control = app.state.control
    keys = {role: control.keys.create(role, Role(role))[1] for role in ("viewer", "operator")}
    with TestClient(app) as client:

        def delete(**headers: str) -> int:
            return client.delete("/v1/notes/1", headers=headers).status_code

        assert delete() == 401
        assert delete(Authorization=f"Bearer {keys['viewer']}") == 403
        assert notes == {"1": "first"}
        assert delete(Authorization=f"Bearer {keys['operator']}") == 204
        assert notes == {}
        assert client.get("/openapi.json").json()["paths"]["/v1/notes/{number}"]["delete"]["summary"]
    entries = [
        (entry.event, entry.subject, entry.outcome) for entry in search(control.audit.path, Wanted(), 100).entries
    ]
    assert ("note.delete", "1", "done") in entries


def test_each_page_of_the_console_has_its_tab_section_and_served_module():
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    tabs = re.findall(r'role="tab" id="tab-(\w+)" aria-controls="(\w+)"', page)
    assert len(tabs) > 5
    for name, section in tabs:
        assert name == section
        assert re.search(rf'<section id="{section}" role="tabpanel" aria-labelledby="tab-{name}"', page), name
    imported = {
        module
        for script in PAGE.glob("*.js")
        for module in re.findall(r'from "\./([\w.]+)"', script.read_text(encoding="utf-8"))
    }
    assert imported | {"main.js"} == {name for name in FILES if name.endswith(".js")}
    assert {path.name for path in PAGE.iterdir()} == {*FILES, "index.html"}
