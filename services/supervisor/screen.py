"""Picture outputs of an engine: the main picture with its metadata, and layers such as depth, confidence and a virtual camera.

All layers are drawn in one thread of low priority, each only while it has viewers.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.machine import step_back
from gsplat_core.models import Model, Snapshot
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.surface import certainty
from gsplat_core.scene.cameras import Camera, Orbit
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.transfers import HostCopy
from operators.display import RememberedTissue, draw_label, picture_state, share_of
from operators.layer_pictures import DepthColours, confidence_picture, mark_unobserved, mark_virtual
from operators.messages import PictureState, ShownPicture
from operators.metrics import ScoredFrame
from operators.rasterize import displayed
from operators.sources.source import SourceState
from services.bus.messages import Durations, PicturePublisher, WatchedPublisher, wait_for_readers
from services.bus.runtime import LAYERS, Layer, StreamFolder
from services.errors import BadMessage

Shows = Literal["live", "model"]
SCORES = ("psnr_db", "previous_frame_db", "next_frame_db")
"""Names of the scores in picture headers, tissue PSNR in dB: of the displayed picture (training error), of the
previous raw frame (trivial baseline), and of the newest prediction before training on its frame."""


class Screen:
    """Publisher of an engine's main picture, shared by the live reconstruction and the display of finished models.

    After a switch between these two kinds, pictures of the old kind are published until the first picture of the new
    kind.
    """

    def __init__(self, publisher: PicturePublisher) -> None:
        self._publisher = publisher
        self._lock = threading.Lock()
        self._wanted: Shows = "live"
        self._shown: Shows = "live"
        self.pictures = 0
        """Number of published new pictures, without repetitions."""
        self.published = 0
        """Number of publications, including repeats of a picture with another state or age."""
        self.ages = Durations()
        """Histogram of the age of new pictures at publication."""
        self._last: dict[str, Any] = {}
        self._scores: dict[str, float | None] = dict.fromkeys(SCORES)

    @property
    def wanted(self) -> Shows:
        """Return the requested kind of picture: live reconstruction or finished model."""
        return self._wanted

    def want(self, shows: Shows) -> None:
        """Request a kind of picture. The switch happens at the first picture of this kind."""
        with self._lock:
            self._wanted = shows

    def show(self, shown: ShownPicture) -> bool:
        """Publish a picture of the live reconstruction.

        Returns:
            False if the screen shows a finished model, so that the picture was not published.
        """
        return self.publish("live", {**header_of(shown), **self._scores}, shown.image)

    def scored(self, scored: ScoredFrame) -> None:
        """Store the scores of the newest scored frame for the following picture headers."""
        found = {
            "psnr_db": scored.quality.psnr_tissue_db,
            "previous_frame_db": scored.previous_frame_db,
            "next_frame_db": scored.next_frame_db,
        }
        known = {name: round(value, 3) if math.isfinite(value) else None for name, value in found.items()}
        # Only some frames are predicted, so the last prediction score is kept until the next one.
        if known["next_frame_db"] is None:
            known["next_frame_db"] = self._scores["next_frame_db"]
        self._scores = known

    def publish(self, shows: Shows, header: Mapping[str, Any], image: NDArray[np.uint8]) -> bool:
        """Publish a picture.

        Args:
            shows: kind of the picture.
            header: metadata of the picture.
            image: RGB uint8 [H, W, 3].

        Returns:
            False, without publishing, if the other kind was requested and this kind is not on screen.
        """
        with self._lock:
            if shows != self._wanted and self._shown != shows:
                return False
            self._shown = shows
            self._publisher.publish({"show": shows, **header}, image)
            self.published += 1
            if header["new"]:
                self.pictures += 1
                self.ages.add(header["age_ms"] * 1e-3)
            self._last = {name: header.get(name) for name in ("state", "age_ms", "model_version", *SCORES)}
            self._last |= {"show": shows, "shown_ns": time.monotonic_ns()}
            return True

    def figures(self) -> dict[str, Any]:
        """Return picture counts and the last header for the heartbeats."""
        with self._lock:
            return {"pictures": self.pictures, "published": self.published, "picture": dict(self._last)}


def header_of(shown: ShownPicture) -> dict[str, Any]:
    """Return the header of a live picture (docs/design/processes.md)."""
    rendered = shown.rendered
    content = rendered.content or rendered.frame
    pose = rendered.frame.pose
    return {
        **({} if pose is None else {"world_to_camera": pose.tolist()}),
        "seq": rendered.frame.seq,
        "pts_ns": rendered.frame.pts_ns,
        "arrived_ns": content.arrived_ns,
        "shown_ns": shown.shown_ns,
        "age_ms": round(shown.age_ns * 1e-6, 3),
        "state": shown.state.value,
        "new": shown.new,
        "model_version": rendered.model_version,
        "steps": rendered.steps,
    }


Picture = tuple[NDArray[np.uint8], dict[str, Any]]
"""Picture of a layer: RGB uint8 [H, W, 3], and header entries in addition to the scene's header."""


@dataclass(frozen=True)
class LayerScene:
    """Displayed scene, with the data needed to render layers: its depth, its confidence and the view of a virtual camera."""

    model: Model | Snapshot
    """Model of the scene; referenced only while the scene exists."""
    camera: Camera
    """Camera of the endoscope or of the finished model."""
    time_s: float
    header: Mapping[str, Any]
    """Header of the displayed picture: `seq`, `pts_ns`, `arrived_ns`, `state`, `show`, `new`."""
    metric: bool = False
    """True if the scene's unit is known to be the millimetre."""
    planes: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    """Depth and opacity [H, W] from the camera, rendered with the picture; None to render them when needed."""


class LayerDrawing:
    """Layer renderer for use in the thread that creates it. On a GPU it uses its own CUDA stream.

    Renders without CUDA graphs, because capturing a graph blocks other threads, and always by alpha blending.
    """

    def __init__(self, device: str) -> None:
        self.orbit = Orbit()
        """Position of the virtual camera; may be replaced from any thread."""
        self._depth = DepthColours()
        self._tissue = RememberedTissue()
        self._stream = torch.cuda.Stream() if device == "cuda" else None

    def draw(self, layer: Layer, scene: LayerScene) -> Picture:
        """Render one layer of a scene: its depth, its confidence or the view of an orbiting camera."""
        kinds: Mapping[Layer, Callable[[LayerScene], Picture]] = {
            "depth": self._draw_depth,
            "confidence": self._draw_confidence,
            "orbit": self._draw_orbit,
        }
        with torch.inference_mode(), self._own_stream():
            return kinds[layer](scene)

    def _draw_depth(self, scene: LayerScene) -> Picture:
        depth, alpha = self._planes(scene)
        image, legend = self._depth.picture(depth, alpha, scene.metric)
        return image, {"legend": legend.said()}

    def _draw_confidence(self, scene: LayerScene) -> Picture:
        gaussians, unseen_s = _at(scene)
        seen = render(_weighted(gaussians, unseen_s), scene.camera, depth=False)
        confidence, alpha = HostCopy(seen.image[..., 0].contiguous()).numpy(), HostCopy(seen.alpha).numpy()
        image, legend = confidence_picture(confidence, alpha)
        return image, {"legend": {**legend.said(), "counts": _counted(unseen_s)}}

    def _draw_orbit(self, scene: LayerScene) -> Picture:
        orbit = self.orbit
        if self._depth.median is None or scene.planes is not None:
            self._depth.adapt_range(*self._planes(scene))
        distance = self._depth.median or 1.0
        gaussians, unseen_s = _at(scene)
        camera = orbit.camera(scene.camera, distance)
        output = render(gaussians, camera, depth=False)
        image = np.array(displayed(output.image))
        if unseen_s is not None and bool((unseen_s > 0).any()):
            remembered = HostCopy((share_of(gaussians, unseen_s > 0, camera) > 0.5).to(torch.uint8) * 255).numpy()
            self._tissue.mark(image, remembered)
        unobserved = mark_unobserved(image, HostCopy(output.alpha).numpy())
        where = f"az {orbit.azimuth_deg:+.0f}  el {orbit.elevation_deg:+.0f}  x{orbit.zoom:.1f}"
        mark_virtual(image, f"VIRTUAL VIEW  {where}")
        said = {"azimuth_deg": orbit.azimuth_deg, "elevation_deg": orbit.elevation_deg, "zoom": orbit.zoom}
        return image, {"virtual": said, "unobserved_share": round(unobserved, 4)}

    def _planes(self, scene: LayerScene) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if scene.planes is not None:
            return scene.planes
        output = _rendered(scene)
        return HostCopy(output.depth).numpy(), HostCopy(output.alpha).numpy()

    def _own_stream(self) -> AbstractContextManager[Any]:
        return nullcontext() if self._stream is None else torch.cuda.stream(self._stream)


def label(image: NDArray[np.uint8], layer: Layer, state: PictureState, age_ns: int) -> None:
    """Draw state and age into a picture, in place. A virtual view is never labelled LIVE, because
    no camera observed it."""
    if layer != "orbit" or state is not PictureState.LIVE:
        draw_label(image, state, age_ns)


def _at(scene: LayerScene) -> tuple[Gaussians, torch.Tensor | None]:
    """Return the Gaussians at the scene's time, and the times [N] in seconds since a frame showed each of them.

    The times are None if the model does not have them.
    """
    model = scene.model
    unseen_s = model.unseen_s() if isinstance(model, Snapshot) else model.unseen_s
    return model.at(scene.time_s), unseen_s


def _rendered(scene: LayerScene) -> RenderOutput:
    return render(_at(scene)[0], scene.camera)


def _weighted(gaussians: Gaussians, unseen_s: torch.Tensor | None) -> Gaussians:
    """Return the Gaussians with their confidence as grey value: 1 if visible or unknown, decreasing with the unseen
    time."""
    weight = gaussians.means.new_ones(gaussians.count)
    if unseen_s is not None:
        weight = certainty(unseen_s).to(gaussians.dtype)
    colours = ((weight - 0.5) / SH_C0)[:, None, None].expand(-1, 1, 3).contiguous()
    return replace(gaussians, sh=colours)


def _counted(unseen_s: torch.Tensor | None) -> str:
    return "opacity" if unseen_s is None else "opacity, time since it was seen"


log = logging.getLogger(__name__)
PERIOD_S = {"cpu": 0.1, "cuda": 1 / 30}
"""Minimum time between two pictures of a layer such as depth, in seconds, by device of the engine."""
MOST_SHARE = {"cpu": 1 / 6, "cuda": 1 / 4}
"""Largest share of time spent on drawing layers, by device. A slow picture is followed by a longer pause."""
POLL_S = 0.2
Scene = Callable[[], LayerScene | None]
"""Factory of a scene, called by the drawing thread. It returns None if the scene cannot be drawn."""


class Layers:
    """Low-priority thread that draws the layers (depth, confidence and orbit pictures), each while it has viewers. `offer` and
    `camera` are thread-safe.

    The publisher sockets detect subscribers. Without a subscriber no layer is drawn, and no scene is kept in memory.
    """

    def __init__(
        self, folder: StreamFolder, device: str, drawing: Callable[[str], LayerDrawing] = LayerDrawing
    ) -> None:
        self._folder, self._device, self._new_drawing = folder, device, drawing
        self._changed = threading.Condition()
        self._scene: Scene | None = None
        self._number = 0
        """Number of scenes offered for drawing so far."""
        self._drawn_of: dict[Layer, tuple[int, float]] = dict.fromkeys(LAYERS, (0, 0.0))
        """Number of the scene that each layer drew last, and the start time of that drawing."""
        self._watched: frozenset[Layer] = frozenset()
        self._drawn: Counter[Layer] = Counter()
        self._failed = ""
        self._orbit = Orbit()
        self._over = False
        self._thread = threading.Thread(target=self._run, name="layers", daemon=True)

    def open(self) -> None:
        """Start the thread that draws the layers: the stream's depth, confidence and orbit pictures."""
        self._thread.start()

    def close(self) -> None:
        """Stop drawing and remove the sockets."""
        with self._changed:
            self._over = True
            self._changed.notify()
        if self._thread.ident is not None:
            self._thread.join()

    def offer(self, scene: Scene) -> None:
        """Offer the displayed scene. Returns at once; the drawing thread calls `scene` only if it draws it."""
        if self._watched:
            with self._changed:
                self._scene = scene
                self._number += 1
                self._changed.notify()

    def camera(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `camera {azimuth_deg?, elevation_deg?, zoom?}`: set the virtual camera's position. Defaults are 0, 0
        and 1.

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
        """Return for the heartbeats whether each layer is watched, its picture count, and the last failure."""
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
                    wait_for_readers(publishers.values(), POLL_S)
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
        """Return the watched layer whose last drawing is oldest, and the newest scene. If every watched layer has drawn
        this scene, wait up to `POLL_S` for a new one and return None."""
        with self._changed:
            waiting = [each for each in LAYERS if each in self._watched and self._drawn_of[each][0] < self._number]
            if not waiting or self._scene is None:
                self._changed.wait(POLL_S)
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
        # A failed layer must not end the main picture. The heartbeats report the failure.
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
        """Return the display state for a layer picture of this age; never better than the state of the main picture."""
        own = picture_state(age_ns, PERIOD_S[self._device] * 1e9, SourceState.LIVE)
        order = list(PictureState)
        return max(screen, own, key=order.index)

    def _rest(self, took_s: float) -> None:
        """Pause after a drawing of `took_s` seconds, so that drawing takes at most `MOST_SHARE` of the time."""
        period_s = PERIOD_S[self._device] / max(1, len(self._watched))
        rest_s = max(period_s - took_s, took_s * (1 / MOST_SHARE[self._device] - 1))
        with self._changed:
            self._changed.wait_for(lambda: self._over, rest_s)
