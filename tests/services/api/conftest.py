"""A control plane with in-memory parts, and clients of each role."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from services.api import Parts, new_app
from services.api.state import ControlState
from services.audit import Wanted, search
from services.auth.keys import Role
from services.settings import ServiceSettings

_spec = importlib.util.spec_from_file_location("control_fakes", Path(__file__).with_name("fakes.py"))
assert _spec is not None and _spec.loader is not None
fakes = importlib.util.module_from_spec(_spec)
sys.modules["control_fakes"] = fakes
_spec.loader.exec_module(fakes)


@dataclass(frozen=True)
class Plane:
    """Running application with clients."""

    app: FastAPI
    client: TestClient
    keys: dict[str, str]

    @property
    def control(self) -> ControlState:
        return self.app.state.control

    @property
    def parts(self) -> Any:
        return self.control.parts

    def headers(self, role: str = "admin") -> dict[str, str]:
        return {"Authorization": f"Bearer {self.keys[role]}"} if role in self.keys else {}

    def ask(self, method: str, path: str, role: str = "admin", **options: Any) -> Any:
        headers = {**self.headers(role), **options.pop("headers", {})}
        return self.client.request(method, path, headers=headers, **options)

    def events(self) -> list[tuple[str, str, str]]:
        """Return the audit log's entries, oldest first."""
        return [
            (entry.event, entry.subject, entry.outcome)
            for entry in reversed(search(self.control.audit.path, Wanted(), 1000).entries)
        ]


@pytest.fixture
def new_plane(tmp_path) -> Iterator[Any]:
    opened = []

    def make(parts: Parts | None = None, **settings: Any) -> Plane:
        folder = tmp_path / f"data{len(opened)}"
        server = {"allowed_hosts": ["testserver"], **settings.pop("server", {})}
        app = new_app(ServiceSettings(paths={"data": folder}, server=server, **settings), parts or fakes.fake_parts())
        store = app.state.control.keys
        keys = {role: store.create(f"test-{role}", Role(role))[1] for role in ("viewer", "operator")}
        keys["admin"] = (folder / "admin.key").read_text().strip()
        client = TestClient(app, raise_server_exceptions=False)
        client.__enter__()
        opened.append(client)
        return Plane(app, client, keys)

    yield make
    for client in opened:
        client.__exit__(None, None, None)


@pytest.fixture
def plane(new_plane) -> Plane:
    return new_plane()
