"""Command `snapshot` of an engine: writes the current live model as a bundle."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from gsplat_core.io.bundle import save_bundle
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.transfers import StagedCopies
from operators.applications.live import LiveApplication
from operators.reconstruct import LiveReconstructOp
from services.bus.messages import text_of
from services.errors import CommandRefused

WAIT_S = 5.0
"""Seconds to wait for the end of a frame."""


class LiveSnapshots:
    """Writer for the model of the running reconstruction.

    Snapshots do not delay pictures. The model is copied after a frame's picture is published, and
    written in the command thread in pieces, so that other threads can run.
    """

    def __init__(self) -> None:
        self._graph: LiveApplication | None = None
        self._copies: StagedCopies | None = None

    @contextmanager
    def of(self, graph: LiveApplication) -> Iterator[None]:
        """Register the running reconstruction while the block runs."""
        self._graph = graph
        try:
            yield
        finally:
            self._graph = None

    def take(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `snapshot {folder}`: write the model into a new folder.

        Args:
            arguments: arguments of the command.

        Returns:
            Header of the snapshot: sequence number, model version, Gaussian count and timings.

        Raises:
            BadMessage: if the folder is missing.
            BundleError: if the bundle cannot be written.
            CommandRefused: if no reconstruction runs or no frame arrives.
        """
        folder = Path(text_of(arguments, "folder"))
        running: LiveReconstructOp | None = getattr(self._graph, "reconstruct", None)
        if running is None:
            raise CommandRefused("no live reconstruction runs; what is shown is a finished model, or nothing yet")
        model, seq, pause_ns = self._asked(running)
        began_s = time.monotonic()
        self._write(model, folder)
        return {
            "seq": seq,
            "model_version": model.version,
            "gaussians": model.gaussians.count,
            "time_window_s": list(model.time_window_s),
            "pause_ms": round(pause_ns * 1e-6, 3),
            "written_ms": round((time.monotonic() - began_s) * 1e3, 3),
        }

    def _asked(self, running: LiveReconstructOp) -> tuple[Model, int, int]:
        """Request the model after the next frame.

        The GPU snapshot is released here, because training needs another slot while one is held.

        Returns:
            A copy of the model, the frame's sequence number and the pause of the training in
            nanoseconds.
        """
        request = running.request_model()
        answer = request.wait(WAIT_S)
        if answer is None:
            why = request.refused or f"no frame has come for {WAIT_S:g} s"
            raise CommandRefused(f"there is no model to write: {why}")
        return self._copied(answer.model), answer.frame.seq, answer.pause_ns

    def _copied(self, model: Model | Snapshot) -> Model:
        """Copy the model. On a GPU, use a separate stream that waits only for the model's tensors."""
        if model.device.type != "cuda":
            return model.as_model()
        if self._copies is None:
            self._copies = StagedCopies(model.device)
        stream = self._copies.stream
        with torch.cuda.stream(stream):
            if isinstance(model, Model):
                stream.wait_stream(torch.cuda.default_stream(model.device))
            return model.as_model()

    def _write(self, model: Model, folder: Path) -> None:
        if self._copies is None:
            save_bundle(model, folder)
        else:
            with torch.cuda.stream(self._copies.stream):
                save_bundle(model, folder, to_host=self._copies.to_host)
