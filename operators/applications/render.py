"""Rendering of a finished model to a video or images over its time window, from selectable camera paths.

Paths are the model's own camera, an orbit, a stereo pair, or a path from a file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.choices import check_outputs
from gsplat_core.errors import InvalidSetting, RecordingError, UserError
from gsplat_core.io.camera_path import read_camera_path
from gsplat_core.io.files import PartialFile
from gsplat_core.io.model_sources import is_scene_file, load_model
from gsplat_core.io.recordings import open_recording
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import Renderer, RendererOptions, check_renderer, new_renderer
from gsplat_core.scene.cameras import Camera, Orbit
from gsplat_core.transfers import HostCopy
from operators.applications.limits import (
    check_picture,
    check_shown_size,
    check_width,
    frames_to_render,
    render_bytes,
    require_memory,
)
from operators.applications.session import Progress, ProgressCallback, check_device
from operators.errors import OutputError
from operators.layer_pictures import OutputPictures, mark_unobserved
from operators.output_folder import OutputFolder, check_file_path
from operators.rasterize import displayed
from operators.settings import check_option
from operators.sinks.video import VideoFile, write_png
from operators.storage import StorageReserve, storage_errors

VIEWS = ("recorded", "orbit", "stereo")
ROUND_S = 4.0
"""Duration of one orbit, in seconds."""
AZIMUTH_DEG, ELEVATION_DEG = 25.0, 15.0
"""Largest angles of an orbit. They are small because a scope observes tissue from one side only."""
EYES_APART = 0.06
"""Default stereo baseline divided by the scene's distance: 4.4 mm at 74 mm."""
MOST_PICTURED = 1_000_000
"""Number of Gaussians of a static scene above which `typical_depth` takes the depth from a sample of their centres instead of a
rendered picture."""
COVERED = 0.5
"""Minimum opacity of a rendered pixel whose depth counts for the median depth of a scene (`typical_depth`)."""


@dataclass(frozen=True)
class ViewWish:
    """Choice of the cameras of a video: a view by name, and the baseline of the view `stereo`.

    Raises InvalidSetting for a baseline that is not positive and finite, or for one with another view.
    """

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
        """Return the camera path file of the view; empty for the built-in views."""
        return () if self.name in VIEWS else (Path(self.name),)


RECORDED = ViewWish()


@dataclass(frozen=True)
class View:
    """Cameras of a video. `cameras(time_s)` returns the cameras of the pictures side by side, all of one size."""

    name: str
    window_s: tuple[float, float]
    """Displayed part of the model's time, in seconds."""
    cameras: Callable[[float], tuple[Camera, ...]]
    is_virtual: bool
    """True if no camera recorded this view, so that unobserved areas are marked."""
    across: int = 1
    """Number of pictures side by side in a video frame: 2 for `stereo`, otherwise 1."""


def view_of(model: Model, camera: Camera, wish: ViewWish) -> View:
    """Return the cameras of a requested view.

    Args:
        model: the model.
        camera: the model's own camera at the size of the pictures.
        wish: the requested view.

    Raises:
        InvalidSetting: unknown view, unreadable path, a path outside of the model's time window, or a camera that sees
            no part of the scene.
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
    """Return the median depth at the model's start. Raises InvalidSetting if `camera` sees no part of the scene.

    For a very large static scene it is the median over a sample of the Gaussians in front of the camera, without a
    picture.
    """
    if model.field is None and model.gaussians.count > MOST_PICTURED:
        every = slice(None, None, -(-model.gaussians.count // MOST_PICTURED))
        means = model.gaussians.means[every].cpu().double().numpy()
        depths = means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
        if not (depths > 0).any():
            raise InvalidSetting("the camera sees no part of the scene; there is nothing to look at from another side")
        return float(np.median(depths[depths > 0]))
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
    if model.field is not None and (first_s < start_s - 1e-6 or last_s > end_s + 1e-6):
        raise InvalidSetting(
            f"{file.name} goes from {first_s:g} to {last_s:g} s; the model has seen {start_s:g} to {end_s:g} s"
        )
    scale = camera.width_px / model.camera.width_px, camera.height_px / model.camera.height_px

    def cameras(time_s: float) -> tuple[Camera, ...]:
        along = path.camera(model.camera, time_s)
        return (along.resized(camera.width_px, camera.height_px) if scale != (1.0, 1.0) else along,)

    return View(file.name, path.window_s, cameras, is_virtual=True)


RESERVE_BYTES = 2**20
VIDEO_SUFFIX = ".mp4"
OTHER_SUFFIXES = (".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".gif", ".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Suffixes of files that rendering does not write. A folder with such a name is likely a mistake."""


def render_model(
    bundle: Path,
    out: Path,
    *,
    fps: float = 30.0,
    scale: float = 1.0,
    device: str = "cpu",
    renderer: str = "alpha",
    options: RendererOptions | None = None,
    outputs: Sequence[str] = ("image",),
    view: ViewWish = RECORDED,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> int:
    """Render the model to a video file or a folder of PNG images.

    Several outputs are side by side. All views except `recorded` hatch unobserved areas. An existing video is replaced only with `overwrite`, an
    existing folder only if an earlier run made it. Either stays unchanged until the new one is complete.

    Args:
        bundle: the saved model.
        out: a file ending in .mp4, or a folder.
        fps: frames per second of the model's time.
        scale: factor on the size of the model's camera.
        device: `cpu` or `cuda`.
        renderer: name of the renderer.
        options: options of the renderer.
        outputs: names of the renderer's outputs, as in `OUTPUTS`, or `image`, `alpha` and `depth`.
        view: the requested view; by default that of the recorded camera.
        overwrite: replace an existing video of this program.
        progress: called after each frame.
        stop_requested: polled; True ends the rendering.

    Returns:
        Number of frames written, also after a stop.

    Raises:
        BundleError: the model cannot be read.
        DeviceMissing: the device is not available.
        InvalidSetting: an option is out of range.
        OutputError: `out` cannot be written or must not be replaced.
    """
    check_option("scale", scale)
    check_shown_outputs(renderer, outputs)
    frames_to_render((0, 0), fps)
    inputs = [bundle, *view.inputs]
    to_video = out.suffix.lower() == VIDEO_SUFFIX
    if to_video:
        check_video_path(inputs, out, overwrite)
    elif out.suffix.lower() in OTHER_SUFFIXES:
        raise OutputError(
            f"{out}: files of this kind are not written; give a video that ends in {VIDEO_SUFFIX}, or a folder of images"
        )
    check_device(device)
    check_renderer(renderer, device, options=options)
    model = load_model(bundle).to(device)
    if is_scene_file(bundle) and view.name == RECORDED.name:  # a scene file contains no camera for the recorded view
        view = ViewWish("orbit")
    camera = camera_at_scale(model, scale, device)
    shown = view_of(model, camera, view)
    across = shown.across * len(outputs)
    check_width(across * camera.width_px)
    frames = frames_to_render(shown.window_s, fps)
    pictures = ViewPictures(model, shown, lambda: new_renderer(renderer, camera, device, options=options), outputs)
    images = _images(pictures, frames, fps, progress, stop_requested)
    if not to_video:
        return _write_images(images, inputs, out)
    if overwrite:
        _check_not_trained_on(model, out)
    return write_video(images, out, (across * camera.width_px, camera.height_px), fps, overwrite)


def render_picture(
    bundle: Path,
    time_s: float | None = None,
    *,
    scale: float = 1.0,
    device: str = "cpu",
    renderer: str = "alpha",
    options: RendererOptions | None = None,
    outputs: Sequence[str] = ("image",),
    view: ViewWish = RECORDED,
) -> NDArray[np.uint8]:
    """Render the model at one time.

    Args:
        bundle: the saved model.
        time_s: time in seconds, inside of the model's window; None for its end.
        scale, device, renderer, options, outputs, view: as for `render_model`.

    Returns:
        The outputs side by side, uint8 RGB [H, W, 3].

    Raises:
        BundleError, DeviceMissing, InvalidSetting: as for `render_model`, or if the time is outside of the window.
    """
    check_shown_outputs(renderer, outputs)
    check_device(device)
    check_renderer(renderer, device, options=options)
    model = load_model(bundle).to(device)
    time_s = model.time_window_s[1] if time_s is None else time_s
    model.check_time(time_s)
    camera = camera_at_scale(model, scale, device)
    shown = view_of(model, camera, view)
    check_width(shown.across * len(outputs) * camera.width_px)
    return ViewPictures(model, shown, lambda: new_renderer(renderer, camera, device, options=options), outputs).at(
        time_s
    )


def check_shown_outputs(renderer: str, outputs: Sequence[str]) -> None:
    """Check the outputs to show.

    Raises:
        InvalidSetting: if there is none, one is repeated, or the renderer does not have one.
    """
    if not outputs or len({*outputs}) < len(outputs):
        raise InvalidSetting(
            f"outputs is {', '.join(outputs) or 'none'}; name one or more, each once, such as image,depth"
        )
    check_outputs(renderer, outputs)


def camera_at_scale(model: Model, scale: float, device: str) -> Camera:
    """Return the model's own camera with its picture resized.

    Raises:
        InvalidSetting: if the picture is too large.
        MemoryTooSmall: if rendering it on the CPU does not fit into memory.
    """
    check_shown_size(model.camera.width_px, model.camera.height_px, scale)
    camera = model.camera.scaled(scale)
    check_picture(camera, scale)
    if device == "cpu":
        needed = render_bytes(camera.width_px, camera.height_px, model.parameter_count)
        require_memory(needed, f"a picture of {camera.width_px}x{camera.height_px} px", "give a smaller --scale")
    return camera


class ViewPictures:
    """Renders a model from a view. Not thread-safe."""

    def __init__(
        self, model: Model, view: View, make_renderer: Callable[[], Renderer], outputs: Sequence[str] = ("image",)
    ) -> None:
        self.view, self._outputs, self._drawn = view, tuple(outputs), OutputPictures()
        # The second of two pictures side by side is the right eye's.
        models = [model, model.seen_by_right()][: view.across]
        self._eyes = [make_renderer() for _ in models]
        for seen, renderer in zip(models, self._eyes, strict=True):
            renderer.prepare(seen)

    def at(self, time_s: float) -> NDArray[np.uint8]:
        """Render the view's pictures side by side, uint8 RGB [H, W, 3]."""
        with torch.inference_mode():
            drawn = zip(self._eyes, self.view.cameras(time_s), strict=True)
            return np.hstack([self._picture(renderer, camera, time_s) for renderer, camera in drawn])

    def _picture(self, renderer: Renderer, camera: Camera, time_s: float) -> NDArray[np.uint8]:
        if not self.view.is_virtual and self._outputs == ("image",):
            return displayed(renderer.render(camera, time_s, ("image",)).result().image)
        found = renderer.render(camera, time_s, {"image", "alpha", *self._outputs}).outputs()
        alpha = HostCopy(found["alpha"]).numpy()
        pictures = []
        for name in self._outputs:
            if name == "image":
                pictures.append(np.array(displayed(found["image"])))
                if self.view.is_virtual:
                    mark_unobserved(pictures[-1], alpha)
            else:
                pictures.append(self._drawn.picture(name, HostCopy(found[name].float()).numpy(), alpha))
        return np.hstack(pictures)


def _images(
    pictures: ViewPictures,
    count: int,
    fps: float,
    progress: ProgressCallback | None,
    stop_requested: Callable[[], bool],
) -> Iterator[NDArray]:
    """Yield uint8 RGB pictures [H, W, 3] over the view's time window until a stop is requested."""
    for k in range(count):
        if stop_requested():
            return
        yield pictures.at(pictures.view.window_s[0] + k / fps)
        if progress is not None:
            progress(Progress("render", k + 1, count))


def write_video(images: Iterator[NDArray], out: Path, size_px: tuple[int, int], fps: float, overwrite: bool) -> int:
    """Write the video atomically and return its number of frames.

    After a UserError, such as a full disk, the frames so far are kept only if no earlier video exists at `out`; after
    any other exception they are removed.
    """
    replaces = os.path.lexists(out)
    reserve = StorageReserve(out.parent, lambda: RESERVE_BYTES)
    with storage_errors(out.parent), PartialFile(out, overwrite=overwrite) as partial:
        video = VideoFile(partial.path, *size_px, fps, reserve)
        try:
            with video:
                for image in images:
                    video.write(image)
        except UserError:
            if partial.path.stat().st_size and not replaces:
                partial.finish()
            raise
        if not video.frames:
            partial.discard()
    return video.frames


def _write_images(images: Iterator[NDArray], inputs: Sequence[Path], out: Path) -> int:
    """Write numbered PNG files and return their number.

    After a UserError, such as a full disk, the images written so far are kept only if the folder was empty before.
    """
    written = 0
    with OutputFolder(out, "render", inputs) as output:
        reserve = StorageReserve(output.path, lambda: RESERVE_BYTES)
        try:
            for image in images:
                write_png(output.path / f"{written:06d}.png", image, reserve)
                written += 1
        except UserError:
            if not output.earlier:
                output.publish()
            raise
        output.publish()
    return written


def check_video_path(inputs: Sequence[Path], out: Path, overwrite: bool) -> None:
    """Raise OutputError if a video cannot be written to `out`."""
    with storage_errors(out.parent):
        if out.is_dir():
            raise OutputError(f"{out} is a folder; give the name of a video file that ends in {VIDEO_SUFFIX}")
        check_file_path(out, inputs, overwrite=overwrite)


def _check_not_trained_on(model: Model, out: Path) -> None:
    """Raise OutputError if `out` is the recording that the model was trained on."""
    if model.training_digest is None or not out.is_file():
        return
    try:
        digest = open_recording(out).digest
    except RecordingError:
        return
    if digest == model.training_digest:
        raise OutputError(f"{out} is the recording that the model was trained on; choose another --out")
