"""Thread for an engine's additional pictures (layers). A layer is drawn only while it has viewers,
at limited cost to the main picture."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from gsplat_core.scene.orbit import Orbit
from operators.display import DisplaySettings
from operators.messages import PictureState
from operators.side_thread import step_back
from operators.sources.source import SourceState
from services.bus.pictures import WatchedPublisher, wait_for_readers
from services.bus.runtime import LAYERS, Layer, StreamFolder
from services.errors import BadMessage
from services.supervisor.layer_drawing import LayerDrawing, LayerScene, label

log = logging.getLogger(__name__)
PERIOD_S = {"cpu": 0.1, "cuda": 1 / 30}
"""Minimum time between two pictures of a layer, in seconds, by device."""
MOST_SHARE = {"cpu": 1 / 6, "cuda": 1 / 4}
"""Largest share of time spent on drawing, by device. A slow picture is followed by a longer pause.
"""
LOOK_S = 0.2

Scene = Callable[[], LayerScene | None]
"""Callable that creates the scene when it is drawn; None if it cannot be drawn."""


class Layers:
    """Drawing thread for the watched layers. `offer` and `camera` are thread-safe.

    The publishers' sockets report subscribers. Without subscribers nothing is drawn and no scene is
    held.
    """

    def __init__(
        self, folder: StreamFolder, device: str, drawing: Callable[[str], LayerDrawing] = LayerDrawing
    ) -> None:
        self._folder, self._device, self._new_drawing = folder, device, drawing
        self._changed = threading.Condition()
        self._scene: Scene | None = None
        self._number = 0
        """Number of offered scenes."""
        self._drawn_of: dict[Layer, tuple[int, float]] = dict.fromkeys(LAYERS, (0, 0.0))
        """Last drawn scene number and its time, per layer."""
        self._watched: frozenset[Layer] = frozenset()
        self._drawn: Counter[Layer] = Counter()
        self._failed = ""
        self._orbit = Orbit()
        self._over = False
        self._thread = threading.Thread(target=self._run, name="layers", daemon=True)

    def open(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop drawing and remove the sockets."""
        with self._changed:
            self._over = True
            self._changed.notify()
        if self._thread.ident is not None:
            self._thread.join()

    def offer(self, scene: Scene) -> None:
        """Offer the displayed scene. Returns at once; the drawing thread calls `scene` only if it
        draws it."""
        if self._watched:
            with self._changed:
                self._scene = scene
                self._number += 1
                self._changed.notify()

    def camera(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `camera {azimuth_deg?, elevation_deg?, zoom?}`: move the virtual camera. Defaults
        are 0, 0 and 1.

        Args:
            arguments: arguments of the command.

        Returns:
            The new position.

        Raises:
            BadMessage: if a value is not a number.
            InvalidSetting: if a value is out of range.
        """
        given = {name: arguments.get(name, default) for name, default in vars(Orbit()).items()}
        for name, value in given.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise BadMessage(f"{name} is {value!r:.40}; give a number")
        self._orbit = Orbit(**{name: float(value) for name, value in given.items()})
        return dict(vars(self._orbit))

    def figures(self) -> dict[str, Any]:
        """Return viewer and picture counts for the heartbeats."""
        watched = self._watched
        layers = {layer: {"watched": layer in watched, "drawn": self._drawn[layer]} for layer in LAYERS}
        return {"layers": {**layers, **({"failed": self._failed} if self._failed else {})}}

    def _run(self) -> None:
        step_back()
        publishers = {layer: WatchedPublisher(self._folder.endpoint(layer)) for layer in LAYERS}
        try:
            drawing: LayerDrawing | None = None
            while not self._over:
                self._watched = frozenset(layer for layer, each in publishers.items() if each.watched)
                if not self._watched:
                    self._scene = None
                    wait_for_readers(publishers.values(), LOOK_S)
                    continue
                waiting = self._next()
                if waiting is not None:
                    drawing = drawing or self._new_drawing(self._device)
                    began_s = time.monotonic()
                    self._draw(drawing, *waiting, publishers[waiting[0]])
                    self._rest(time.monotonic() - began_s)
        finally:
            self._watched = frozenset()
            for publisher in publishers.values():
                publisher.close()

    def _next(self) -> tuple[Layer, Scene] | None:
        """Return the watched layer that waited longest for an undrawn scene, and that scene. None
        if no layer waits."""
        with self._changed:
            waiting = [each for each in LAYERS if each in self._watched and self._drawn_of[each][0] < self._number]
            if not waiting or self._scene is None:
                self._changed.wait(LOOK_S)
                return None
            layer = min(waiting, key=lambda each: self._drawn_of[each][1])
            self._drawn_of[layer] = self._number, time.monotonic()
            return layer, self._scene

    def _draw(self, drawing: LayerDrawing, layer: Layer, newest: Scene, publisher: WatchedPublisher) -> None:
        drawing.orbit = self._orbit
        try:
            scene = newest()
            if scene is None:
                return
            image, said = drawing.draw(layer, scene)
        # the main picture continues without the layer; the heartbeat figures report the failure
        except Exception as error:
            self._failed = f"{layer}: {type(error).__name__}: {error}"[:500]
            log.exception("the picture of %s was not drawn", layer)
            return
        shown_ns = time.monotonic_ns()
        age_ns = max(0, shown_ns - (scene.header.get("arrived_ns") or shown_ns))
        state = self._state(PictureState(scene.header["state"]), age_ns)
        label(image, layer, state, age_ns)
        stated = {"shown_ns": shown_ns, "age_ms": round(age_ns * 1e-6, 3), "state": state.value, "layer": layer}
        publisher.publish({**scene.header, **stated, **said}, image)
        self._drawn[layer] += 1

    def _state(self, screen: PictureState, age_ns: int) -> PictureState:
        """Return the state for a picture of this age; never better than the state of the main
        picture."""
        own = DisplaySettings().state(age_ns, PERIOD_S[self._device] * 1e9, SourceState.LIVE)
        order = list(PictureState)
        return max(screen, own, key=order.index)

    def _rest(self, took_s: float) -> None:
        """Wait until the next picture, leaving most of the time to the reconstruction."""
        period_s = PERIOD_S[self._device] / max(1, len(self._watched))
        rest_s = max(period_s - took_s, took_s * (1 / MOST_SHARE[self._device] - 1))
        with self._changed:
            self._changed.wait_for(lambda: self._over, rest_s)
