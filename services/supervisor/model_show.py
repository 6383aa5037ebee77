"""Display of finished models in place of the live reconstruction, by the commands `show_model`, `show_live` and
`show_previous`."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput, UserError
from gsplat_core.io.bundle import load_bundle
from gsplat_core.rendering.renderer import RendererOptions, new_renderer
from gsplat_core.scene.frames import Frame
from operators.applications.limits import check_picture
from operators.messages import PictureState
from operators.rasterize import displayed
from operators.sources.source import SourceState
from services.bus.messages import text_of
from services.bus.runtime import read_json, write_json
from services.errors import BadMessage, BusError, CommandRefused
from services.supervisor.capture import CapturedSource
from services.supervisor.screen import SCORES, Layers, LayerScene, Screen
from services.supervisor.worker import EngineSpec, Worker


class NotFinite(InvalidInput):
    """A rendered picture contains non-finite values."""


class FinishedModel:
    """Model from a bundle, with its own renderer. For use by one thread at a time.

    The constructor renders a picture as warm-up.

    Raises:
        BundleError: if the bundle cannot be loaded.
        CommandRefused: if the warm-up picture is not finite.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        version: int,
        *,
        device: str,
        renderer: str,
        options: RendererOptions | None = None,
    ) -> None:
        self.name, self.version = name, version
        self._model = load_bundle(folder).to(device)
        self._camera = self._model.camera
        check_picture(self._camera, 1.0)
        self._renderer = new_renderer(renderer, self._camera, torch.device(device), options=options)
        self._renderer.prepare(self._model)
        try:
            self.picture(0.0)
        except NotFinite as error:
            raise CommandRefused(str(error)) from None

    def at(self, stream_s: float) -> float:
        """Map a stream time to a time in the model's time window, which repeats after its end.

        Args:
            stream_s: time of the stream in seconds.

        Returns:
            Model time in seconds.
        """
        start_s, end_s = self._model.time_window_s
        return start_s + math.fmod(max(0.0, stream_s), end_s - start_s) if end_s > start_s else start_s

    def scene(self, stream_s: float, header: Mapping[str, Any]) -> LayerScene:
        """Return the scene at a stream time for the layer pictures. Not metric, because bundles state no unit."""
        return LayerScene(self._model, self._camera, self.at(stream_s), header)

    def picture(self, stream_s: float) -> NDArray[np.uint8]:
        """Render the model through its own camera.

        Args:
            stream_s: time of the stream in seconds.

        Returns:
            RGB uint8 [H, W, 3].

        Raises:
            NotFinite: if the picture or the Gaussians have non-finite values.
        """
        time_s = self.at(stream_s)
        with torch.inference_mode():
            image = self._renderer.render(self._camera, time_s, ("image",)).result().image
            # The renderer skips non-finite Gaussians, so the picture alone would not show them.
            drawn = (image, *self._model.at(time_s).tensors().values())
            if not all(bool(torch.isfinite(values).all()) for values in drawn):
                raise NotFinite(
                    f"{self.name} {self.version} has values that are not finite at {time_s:.3f} s of its time"
                )
            return displayed(image).copy()


log = logging.getLogger(__name__)
LOOK_S = 0.1
REPEAT_NS = 200_000_000
LATE_IN_A_ROW = 5
"""Consecutive late pictures that count as a missed time limit. A single late picture may be caused by other load on
the machine."""


@dataclass(frozen=True)
class Showing:
    """Displayed model, with the arguments of the command `show_model` that requested it."""

    model: FinishedModel
    asked: Mapping[str, Any]
    """Arguments of the command, stored so that the next engine process can repeat it."""
    most_ms: float | None

    def __str__(self) -> str:
        return f"{self.model.name or 'the model'} {self.model.version}"


class ModelShow:
    """Display thread for finished models. For each arriving frame it renders the selected model at the frame's time.

    A new selection takes effect between two pictures, and the previous model is kept for a rollback. A model with
    non-finite pictures, or with repeatedly more than `most_ms` per picture, is replaced by the previous model or the
    live reconstruction. The selection is stored in a file, so the next engine process restores it.
    """

    def __init__(self, worker: Worker, spec: EngineSpec, screen: Screen, layers: Layers | None = None) -> None:
        self._worker, self._spec, self._screen, self._layers = worker, spec, screen, layers
        self._file = worker.folder.path / "engine.show"
        self._lock = threading.Lock()
        self._changing = threading.Lock()
        self._current: Showing | None = None
        self._previous: Showing | None = None
        self._late = 0
        self._gave_way: list[dict[str, Any]] = []
        """Name, version and reason of the last eight models that were rolled back."""
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Display the model that the previous engine process displayed, if any; discard its record if it is unusable."""
        try:
            said = read_json(self._file)
            self.show(said)
        except FileNotFoundError:
            return
        except (UserError, BusError) as error:
            log.error("the model that was shown is not shown again: %s", error)
            self._file.unlink()

    def show(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `show_model {folder, version, name?, most_ms?}`: load a model and display it.
        Returns after the model has rendered a picture; on errors the current display is unchanged.

        Args:
            arguments: arguments of the command.

        Returns:
            The version and the preparation time.

        Raises:
            BadMessage: if an argument is not valid.
            BundleError: if the bundle cannot be loaded.
            CommandRefused: if the model renders non-finite values.
        """
        folder, version = text_of(arguments, "folder"), arguments.get("version")
        name, most_ms = arguments.get("name", ""), arguments.get("most_ms")
        if type(version) is not int or version < 1 or not isinstance(name, str):
            raise BadMessage(f"version is {version!r:.40} and name {name!r:.40}; give a whole number and a text")
        if most_ms is not None and not (isinstance(most_ms, int | float) and most_ms > 0):
            raise BadMessage(f"most_ms is {most_ms!r:.40}; give milliseconds, or leave it out")
        with self._changing:
            began_s = time.monotonic()
            model = FinishedModel(
                Path(folder), name, version,
                device=self._spec.device, renderer=self._spec.renderer, options=self._spec.renderer_options,
            )  # fmt: skip
            asked = {"folder": folder, "version": version, "name": name, "most_ms": most_ms}
            with self._lock:
                self._previous = self._current
                self._put(Showing(model, asked, most_ms))
                self._screen.want("model")
                if self._thread is None:
                    self._thread = threading.Thread(target=self._show_models, name="models")
                    self._thread.start()
            return {"version": version, "prepared_s": round(time.monotonic() - began_s, 3)}

    def show_live(self, _: Mapping[str, Any]) -> None:
        """Handle `show_live`: display the live reconstruction from its next picture on."""
        with self._changing, self._lock:
            self._to_live()

    def show_previous(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `show_previous`: display the previous model again.

        Raises:
            CommandRefused: if there is no previous model.
        """
        with self._changing, self._lock:
            if self._current is None or self._previous is None:
                raise CommandRefused("no model was shown before this one")
            before, self._previous = self._previous, self._current
            self._put(before)
            return {"version": before.model.version}

    def figures(self) -> dict[str, Any]:
        """Return the displayed model and recent rollbacks for the heartbeats."""
        with self._lock:
            current = self._current
            shown = None if current is None else {"name": current.model.name, "version": current.model.version}
            return {"model": shown, "gave_way": list(self._gave_way)}

    def close(self) -> None:
        """Wait for the display thread to end. The process must already be stopping."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def _show_models(self) -> None:
        """Render at the time of each frame until the live reconstruction takes over or the process stops."""
        stop = self._worker.stop_requested
        try:
            source = CapturedSource(self._worker.folder, stop)
        except UserError:
            return  # stopped before the source was open
        source.open()
        frame: Frame | None = None
        repeated_ns = 0
        try:
            while not stop():
                came = source.read(LOOK_S)
                frame, now_ns = came or frame, time.monotonic_ns()
                if frame is None or (came is None and now_ns - repeated_ns < REPEAT_NS):
                    continue
                repeated_ns = now_ns
                if not self._draw(frame, came is not None, source.state) and self._live_has_taken_over():
                    return
        finally:
            source.close()

    def _live_has_taken_over(self) -> bool:
        with self._lock:
            if self._screen.wanted != "live":
                return False
            self._current = self._thread = None
            return True

    def _draw(self, frame: Frame, new: bool, source: SourceState) -> bool:
        """Render and publish one picture.

        Returns:
            False if it was not published.
        """
        with self._lock:
            showing = self._current
        assert showing is not None
        began_ns = time.monotonic_ns()
        try:
            image = showing.model.picture(frame.time_s)
        except NotFinite as error:
            return self._give_way(showing, str(error))
        now_ns = time.monotonic_ns()
        self._check_time(showing, (now_ns - began_ns) * 1e-6)
        age_ns = max(0, now_ns - (frame.arrived_ns or now_ns))
        state = PictureState.LIVE if source is SourceState.LIVE else PictureState.SOURCE_LOST
        header = {
            "seq": frame.seq,
            "pts_ns": frame.pts_ns,
            "arrived_ns": frame.arrived_ns,
            "shown_ns": now_ns,
            "age_ms": round(age_ns * 1e-6, 3),
            "state": state.value,
            "new": new,
            "model": showing.model.name,
            "model_version": showing.model.version,
            "steps": 0,
            **dict.fromkeys(SCORES),
        }
        shown = self._screen.publish("model", header, image)
        if shown and self._layers is not None:
            self._layers.offer(lambda: showing.model.scene(frame.time_s, {**header, "show": "model"}))
        return shown

    def _check_time(self, showing: Showing, took_ms: float) -> None:
        late = showing.most_ms is not None and took_ms > showing.most_ms
        self._late = self._late + 1 if late else 0
        if self._late >= LATE_IN_A_ROW:
            self._give_way(showing, f"{showing} took {took_ms:.1f} ms for a picture, {LATE_IN_A_ROW} times in a row")

    def _give_way(self, showing: Showing, why: str) -> bool:
        """Replace a failed model by the model displayed before it, or by the live reconstruction if there is none.

        The display stays unchanged if a command has already selected another model.

        Args:
            showing: the model that failed.
            why: reason of the failure, for the log and the status.

        Returns:
            True if a model is displayed next, False if the live reconstruction is.
        """
        log.error("%s; what was shown before is shown again", why)
        with self._lock:
            taken_back = {"name": showing.model.name, "version": showing.model.version, "reason": why}
            self._gave_way = [*self._gave_way[-7:], taken_back]
            if self._current is not showing:
                return True  # a command has selected another model since the failed picture
            before, self._previous = self._previous, None
            if before is not None:
                self._put(before)
                return True
            self._to_live()
            return False

    def _put(self, showing: Showing) -> None:
        """Display a model from the next picture on, and store its command for the next engine process. Requires the
        lock."""
        self._current, self._late = showing, 0
        write_json(self._file, showing.asked)

    def _to_live(self) -> None:
        # The model stays on screen until the first live picture. `Screen.publish` then refuses the model's pictures,
        # and the display thread ends.
        self._screen.want("live")
        self._previous = None
        self._file.unlink(missing_ok=True)
