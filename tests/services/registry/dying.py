"""A process that changes a registry and dies by SIGKILL at a step: `python dying.py FOLDER DATABASE_URL UPLOAD ACTION [STEP]`.

DATABASE_URL may be empty: SQLite in the folder. Without a step it does the same again and again until somebody ends it.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from services.registry.models import ModelRegistry
from tests.services.registry.stub_check import ALWAYS_READY

ACTIONS: dict[str, Callable[[ModelRegistry, Path], object]] = {
    "upload": lambda registry, upload: registry.upload("liver", upload, None, "surgeon"),
    "check": lambda registry, upload: registry.check("liver", 3),
    "activate": lambda registry, upload: registry.activate("liver", 2, 1, "admin"),
    "rollback": lambda registry, upload: registry.rollback("liver", "admin"),
    "delete": lambda registry, upload: registry.delete("liver", 3, "admin"),
}
"""Changes to a model with versions 1, 2 and, except for an upload, 3."""


def swap_for_ever(registry: ModelRegistry) -> None:
    """Activate versions 1 and 2 in turn, and write a dot for each time."""
    while True:
        active = registry.active("liver").version
        registry.activate("liver", 3 - active, active, "admin")
        os.write(1, b".")


def main(folder: str, database_url: str, upload: str, action: str, step: str | None = None) -> None:
    def die_there(reached: str) -> None:
        if reached == step:
            os.kill(os.getpid(), signal.SIGKILL)

    given: Any = {"database_url": database_url or None, "check_program": ALWAYS_READY, "reached": die_there}
    with ModelRegistry(Path(folder), **given) as registry:
        if action == "swap":
            swap_for_ever(registry)
        ACTIONS[action](registry, Path(upload))


if __name__ == "__main__":
    main(*sys.argv[1:])
