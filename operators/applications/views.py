"""From where a model is shown: its own camera, one that goes round it, two eyes, or a path from a file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.camera_path import read_camera_path
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.model import Model
from gsplat_core.scene.orbit import Orbit
from gsplat_core.transfers import HostCopy

VIEWS = ("recorded", "orbit", "stereo")
ROUND_S = 4.0
"""How long an orbit takes to come round."""
AZIMUTH_DEG, ELEVATION_DEG = 25.0, 15.0
"""How far an orbit leads aside; a scope has seen tissue from one side, and behind it nothing."""
EYES_APART = 0.06
"""Distance between two eyes over the distance of what they look at, unless it is given; that of a 4.4 mm scope 74 mm before the tissue."""
COVERED = 0.5
"""Opacity from which on a depth is one of the scene's."""


@dataclass(frozen=True)
class ViewWish:
    """From where a model is to be shown. Raises InvalidSetting."""

    name: str = "recorded"
    """`recorded` (the model's own camera), `orbit`, `stereo` (two eyes side by side), or the file of a camera path (`gsplat_core.io.camera_path`)."""
    baseline: float | None = None
    """Distance between the eyes of `stereo`, in the model's unit; None: a share of the scene's distance."""

    def __post_init__(self) -> None:
        if self.baseline is not None and (self.name != "stereo" or not 0 < self.baseline < math.inf):
            raise InvalidSetting(
                f"baseline is {self.baseline:g} and the view {self.name!r:.80}; a positive one goes with --view stereo"
            )

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files that the view is read from."""
        return () if self.name in VIEWS else (Path(self.name),)


RECORDED = ViewWish()


@dataclass(frozen=True)
class View:
    """Cameras of a video. `cameras(time_s)` are those whose pictures stand side by side at a time, of one size."""

    name: str
    window_s: tuple[float, float]
    """The model's times that are shown."""
    cameras: Callable[[float], tuple[Camera, ...]]
    is_virtual: bool
    """No camera was there: what was never seen is marked."""
    across: int = 1
    """Pictures side by side."""


def view_of(model: Model, camera: Camera, wish: ViewWish) -> View:
    """The cameras that are wished for. `camera` is the model's own, of the pictures' size. Raises InvalidSetting."""
    name, baseline = wish.name, wish.baseline
    if name == "recorded":
        return View(name, model.time_window_s, lambda time_s: (camera,), is_virtual=False)
    if name == "orbit":
        distance, start_s = typical_depth(model, camera), model.time_window_s[0]
        return View(
            name, model.time_window_s, lambda t: (on_orbit(camera, distance, (t - start_s) / ROUND_S),), is_virtual=True
        )
    if name == "stereo":
        apart = EYES_APART * typical_depth(model, camera) if baseline is None else baseline
        right = camera.with_pose(camera.right_eye(apart).world_to_camera @ camera.world_to_camera)
        return View(name, model.time_window_s, lambda time_s: (camera, right), is_virtual=True, across=2)
    return _along_path(model, camera, Path(name))


def on_orbit(camera: Camera, distance: float, turns: float) -> Camera:
    """The camera after so many turns on a closed curve round what lies `distance` in front of `camera`, which it starts from."""
    phase = 2 * math.pi * turns
    return Orbit(AZIMUTH_DEG * math.sin(phase), ELEVATION_DEG * math.sin(2 * phase)).camera(camera, distance)


def typical_depth(model: Model, camera: Camera) -> float:
    """Median depth of the scene at the model's start. Raises InvalidSetting where `camera` sees nothing of it."""
    output = model.render(model.time_window_s[0], camera)
    depth, alpha = HostCopy(output.depth).numpy(), HostCopy(output.alpha).numpy()
    known = depth[(alpha >= COVERED) & (depth > 0)]
    if not known.size:
        raise InvalidSetting("the model shows nothing at its start; there is nothing to look at from another side")
    return float(np.median(known))


def _along_path(model: Model, camera: Camera, file: Path) -> View:
    if file.suffix.lower() != ".json":
        raise InvalidSetting(
            f"the view is {str(file)!r:.80}; choose {', '.join(VIEWS)}, or a camera path (a .json file)"
        )
    path = read_camera_path(file)
    (start_s, end_s), (first_s, last_s) = model.time_window_s, path.window_s
    if first_s < start_s - 1e-6 or last_s > end_s + 1e-6:
        raise InvalidSetting(
            f"{file.name} goes from {first_s:g} to {last_s:g} s; the model has seen {start_s:g} to {end_s:g} s"
        )
    scale = camera.width_px / model.camera.width_px, camera.height_px / model.camera.height_px

    def cameras(time_s: float) -> tuple[Camera, ...]:
        along = path.camera(model.camera, time_s)
        return (along.resized(camera.width_px, camera.height_px) if scale != (1.0, 1.0) else along,)

    return View(file.name, path.window_s, cameras, is_virtual=True)
