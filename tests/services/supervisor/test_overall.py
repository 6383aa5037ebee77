"""Overall state of a stream from the states of its two processes."""

from __future__ import annotations

from typing import Any

import pytest

from services.supervisor.process import ProcessState
from services.supervisor.stream import overall


def process(state: str, picture: str | None = None) -> ProcessState:
    figures: dict[str, Any] = {} if picture is None else {"picture": {"state": picture}}
    return ProcessState(state, f"why {state}", 7, 0, figures, 0.1)


@pytest.mark.parametrize(
    ("capture", "engine", "expected"),
    [
        (process("failed"), process("running", "live"), ("failed", "why failed")),
        (process("live"), process("failed"), ("failed", "why failed")),
        (process("stalled"), process("running", "live"), ("source lost", "why stalled")),
        (process("reconnecting"), process("running", "live"), ("source lost", "why reconnecting")),
        (process("lost"), process("running", "live"), ("source lost", "why lost")),
        (process("ended"), process("running", "live"), ("source lost", "why ended")),
        (process("opening"), process("running", "live"), ("starting", "why opening")),
        (process("live"), process("down"), ("starting", "the camera's picture is live; the engine is down: why down")),
        (process("live"), process("running"), ("starting", "the first picture is being made")),
        (process("live"), process("running", "live"), ("live", None)),
        (process("live"), process("running", "stale"), ("stale", None)),
        (process("live"), process("running", "frozen"), ("frozen", None)),
        (process("live"), process("running", "source lost"), ("source lost", None)),
    ],
)
def test_overall_state_is_that_of_worst_process(
    capture: ProcessState, engine: ProcessState, expected: tuple[str, str | None]
) -> None:
    assert overall(capture, engine) == expected
