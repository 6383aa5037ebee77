"""Program of a process that activates versions concurrently with another process. Does not load torch."""

from __future__ import annotations

from services.errors import Conflict
from services.registry.models import ModelRegistry
from tests.services.registry.stub_check import ALWAYS_READY

ROUNDS = 5


def activate_together(folder, database_url, version, gate, results):
    """Compete in each round, as a separate process, to replace version 1."""
    with ModelRegistry(folder, database_url=database_url, check_program=ALWAYS_READY) as registry:
        for _ in range(ROUNDS):
            gate.wait()
            try:
                registry.activate("liver", version, 1, f"process {version}")
                results.put(version)
            except Conflict as error:
                results.put(str(error))
            gate.wait()
