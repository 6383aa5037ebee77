"""Which engine runs an application."""

from __future__ import annotations

from typing import Literal

from operators.graph.application import Fragment
from operators.graph.graph import RunResult

Engine = Literal["embedded", "holoscan"]


def run(app: Fragment, engine: Engine = "embedded") -> RunResult:
    """Run an application on our own schedulers (`embedded`) or on the Holoscan SDK (`holoscan`).

    Results, errors and counts are the same. Raises what Fragment.run raises; EngineMissing without the SDK and
    EngineUnsupported for what it cannot do.
    """
    if engine == "embedded":
        return app.run()
    if engine == "holoscan":
        from operators.graph.holoscan import HoloscanScheduler

        return app.run_on(HoloscanScheduler(app.scheduler()))
    raise ValueError(f"unknown engine {engine!r}; choose embedded or holoscan")
