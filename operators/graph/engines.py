"""Selection of the engine that runs an application."""

from __future__ import annotations

from typing import Literal

from operators.graph.application import Fragment
from operators.graph.graph import RunResult

Engine = Literal["embedded", "holoscan"]


def run(app: Fragment, engine: Engine = "embedded") -> RunResult:
    """Run an application on the embedded schedulers or on the Holoscan SDK. Results and counts are
    the same.

    Args:
        app: the application.
        engine: `embedded` or `holoscan`.

    Raises:
        EngineMissing: the SDK is not installed or cannot be loaded.
        EngineUnsupported: the SDK cannot run the graph faithfully.
        GraphError: as `Fragment.run` raises it.
    """
    if engine == "embedded":
        return app.run()
    if engine == "holoscan":
        from operators.graph.holoscan import HoloscanScheduler

        return app.run_on(HoloscanScheduler(app.scheduler()))
    raise ValueError(f"unknown engine {engine!r}; choose embedded or holoscan")
