"""Asking a reconstruction that runs for its whole model."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot


@dataclass(frozen=True)
class ModelAnswer:
    """The model as it stood after a frame."""

    model: Model | Snapshot
    frame: Frame
    pause_ns: int
    """How long the reconstruction stood still for it."""


class ModelRequest:
    """One question and its answer, between two threads."""

    def __init__(self) -> None:
        self._answered = threading.Event()
        self._answer: ModelAnswer | None = None
        self.refused = ""
        """Why there is no answer."""

    def answer(self, model: Model | Snapshot, frame: Frame, pause_ns: int) -> None:
        """Give the model."""
        self._answer = ModelAnswer(model, frame, pause_ns)
        self._answered.set()

    def refuse(self, why: str) -> None:
        """Say that there will be none."""
        self.refused = why
        self._answered.set()

    def wait(self, timeout_s: float) -> ModelAnswer | None:
        """The answer; None when it was refused, or has not come in time."""
        self._answered.wait(timeout_s)
        return self._answer
