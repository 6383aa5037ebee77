"""The command `snapshot` of an engine: the live model as it stands, written as a bundle."""

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
from operators.applications.live import LiveApplication
from operators.live_reconstruct import LiveReconstructOp
from services.bus.commands import text_of
from services.bus.errors import CommandRefused

WAIT_S = 5.0
"""How long to wait for the end of a frame; without frames there is none."""


class LiveSnapshots:
    """Writes the model of the reconstruction that runs now. The picture does not wait: the model is copied after a frame's picture is on its way,
    and written in the thread of the commands."""

    def __init__(self) -> None:
        self._graph: LiveApplication | None = None

    @contextmanager
    def of(self, graph: LiveApplication) -> Iterator[None]:
        """While entered, that graph is the reconstruction that runs."""
        self._graph = graph
        try:
            yield
        finally:
            self._graph = None

    def take(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """`snapshot {folder}`: write the model into a new folder. Raises BadMessage, BundleError, CommandRefused without a reconstruction."""
        folder = Path(text_of(arguments, "folder"))
        running: LiveReconstructOp | None = getattr(self._graph, "reconstruct", None)
        if running is None:
            raise CommandRefused("no live reconstruction runs; what is shown is a finished model, or nothing yet")
        request = running.request_model()
        answer = request.wait(WAIT_S)
        if answer is None:
            why = request.refused or f"no frame has come for {WAIT_S:g} s"
            raise CommandRefused(f"there is no model to write: {why}")
        began_s = time.monotonic()
        model = on_host(answer.model)
        save_bundle(model, folder)
        return {
            "seq": answer.frame.seq,
            "model_version": model.version,
            "gaussians": model.gaussians.count,
            "time_window_s": list(model.time_window_s),
            "pause_ms": round(answer.pause_ns * 1e-6, 3),
            "written_ms": round((time.monotonic() - began_s) * 1e3, 3),
        }


def on_host(model: Model | Snapshot) -> Model:
    """In host memory. On a GPU it is copied on a stream of its own, and training is not waited for beyond what the model is made of."""
    if model.device.type != "cuda":
        return model.as_model()
    stream = torch.cuda.Stream(model.device)
    with torch.cuda.stream(stream):
        if isinstance(model, Model):
            stream.wait_stream(torch.cuda.default_stream(model.device))
        copied = model.as_model().to("cpu")
    stream.synchronize()
    return copied
