"""Camera paths for rendering a model: its own camera, an orbit, a stereo pair, or a path from a
file.
"""

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
"""Duration of one orbit, in seconds."""
AZIMUTH_DEG, ELEVATION_DEG = 25.0, 15.0
"""Largest angles of an orbit. They are small because a scope observes tissue from one side only."""
EYES_APART = 0.06
"""Default stereo baseline divided by the scene's distance: 4.4 mm at 74 mm."""
COVERED = 0.5
"""Minimum opacity of a pixel whose depth is used."""


@dataclass(frozen=True)
class ViewWish:
    """Requested view. Raises InvalidSetting for an invalid baseline."""

    name: str = "recorded"
    """`recorded` (the model's own camera), `orbit`, `stereo` (side by side), or a camera path file
    (`gsplat_core.io.camera_path`).
    """
    baseline: float | None = None
    """Baseline of `stereo` in the model's unit; None: a share of the scene's distance."""

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
    """Cameras of a video. `cameras(time_s)` returns the cameras of the pictures side by side, all
    of one size.
    """

    name: str
    window_s: tuple[float, float]
    """Displayed part of the model's time, in seconds."""
    cameras: Callable[[float], tuple[Camera, ...]]
    is_virtual: bool
    """True if no camera recorded this view, so that unobserved areas are marked."""
    across: int = 1
    """Number of pictures side by side."""


def view_of(model: Model, camera: Camera, wish: ViewWish) -> View:
    """Return the cameras of a requested view.

    Args:
        model: the model.
        camera: the model's own camera at the size of the pictures.
        wish: the requested view.

    Raises:
        InvalidSetting: unknown view, unreadable path, or a path outside of the model's time window.
    """
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
    """Return a camera on a closed curve that begins at `camera` and faces a fixed point.

    Args:
        camera: start of the orbit.
        distance: distance from the start to the fixed point in front of it, in the scene's unit.
        turns: position on the orbit; 1 is a complete round.
    """
    phase = 2 * math.pi * turns
    return Orbit(AZIMUTH_DEG * math.sin(phase), ELEVATION_DEG * math.sin(2 * phase)).camera(camera, distance)


def typical_depth(model: Model, camera: Camera) -> float:
    """Return the median depth at the model's start. Raises InvalidSetting if `camera` sees no part
    of the scene.
    """
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
