"""Request for the whole model of a running reconstruction, between two threads."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot


@dataclass(frozen=True)
class ModelAnswer:
    """The whole model as of a given frame."""

    model: Model | Snapshot
    frame: Frame
    pause_ns: int
    """Time for which training paused to copy the model, in nanoseconds."""


class ModelRequest:
    """Future of a model: the training thread answers or refuses, the requesting thread waits."""

    def __init__(self) -> None:
        self._answered = threading.Event()
        self._answer: ModelAnswer | None = None
        self.refused = ""
        """Reason for the refusal; empty unless refused."""

    def answer(self, model: Model | Snapshot, frame: Frame, pause_ns: int) -> None:
        """Complete the request with a model.

        Args:
            model: the whole model.
            frame: newest frame that the model includes.
            pause_ns: time for which training paused, in nanoseconds.
        """
        self._answer = ModelAnswer(model, frame, pause_ns)
        self._answered.set()

    def refuse(self, why: str) -> None:
        """Complete the request without a model; `why` is the reason for the user."""
        self.refused = why
        self._answered.set()

    def wait(self, timeout_s: float) -> ModelAnswer | None:
        """Wait for the answer. Return None if the request was refused or `timeout_s` seconds
        elapsed.
        """
        self._answered.wait(timeout_s)
        return self._answer
