"""Measurement of a renderer on a model along a camera path: frame times, memory and, on request, the video."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.model_sources import load_model
from gsplat_core.machine import peak_bytes
from gsplat_core.rendering.renderer import RendererOptions, check_renderer, new_renderer
from operators.applications.limits import check_picture, render_bytes, require_memory
from operators.applications.render import VIDEO_SUFFIX, ViewWish, check_video_path, view_of, write_video
from operators.applications.session import Progress, ProgressCallback, check_device
from operators.errors import OutputError
from operators.rasterize import displayed

WARM_UP = 3
"""Number of frames before the measurement, which allocate memory and capture graphs."""
MOST_FRAMES = 100_000
VIDEO_FPS = 30.0


@dataclass(frozen=True)
class BenchSettings:
    """Settings of a measurement of rendering speed.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    renderer: str = "alpha"
    options: RendererOptions = field(default_factory=RendererOptions)
    device: str = "cpu"
    path: Path | None = None
    """Camera path (`gsplat_core.io.camera_path`); None for an orbit."""
    width_px: int | None = None
    """Width of the pictures; None for the model's."""
    height_px: int | None = None
    frames: int = 300
    """Number of frames, evenly spaced over the path."""

    def __post_init__(self) -> None:
        if (self.width_px is None) != (self.height_px is None):
            raise InvalidSetting("only one of width and height is given; give both, or none for the model's size")
        if not 1 <= self.frames <= MOST_FRAMES:
            raise InvalidSetting(f"frames is {self.frames}; it must be from 1 to {MOST_FRAMES}")
        for name, value in (("width", self.width_px), ("height", self.height_px)):
            if value is not None and value < 1:
                raise InvalidSetting(f"{name} is {value}; it must be at least 1 px")


@dataclass(frozen=True)
class BenchResult:
    """Figures of a measurement; times are from the request of a frame until it is complete."""

    gaussians: int
    sh_degree: int
    width_px: int
    height_px: int
    renderer: str
    device: str
    """Name of the GPU, or `cpu`."""
    frames: int
    """Number of measured frames; less than requested after an interruption."""
    load_s: float
    """Time to read the file and to copy it to the device, in seconds."""
    prepare_s: float
    """Time of the renderer's own preparation of the model, in seconds."""
    frame_ms_p50: float
    frame_ms_p99: float
    fps_p50: float
    """Frames per second at the median frame time."""
    fps_p99: float
    """Frames per second at the frame time that 99 % of the frames do not exceed."""
    parameter_bytes: int
    """Total size of the model's tensors, in bytes."""
    device_peak_bytes: int | None
    """Peak memory on the GPU with model and renderer, in bytes; None on the CPU."""
    host_peak_bytes: int
    """Peak resident memory of the process, including loading, in bytes."""


def bench_model(
    source: Path,
    settings: BenchSettings,
    out: Path | None = None,
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> BenchResult:
    """Render a model along a path and measure every frame.

    Args:
        source: bundle or splat file.
        settings: renderer, path and size.
        out: video of the frames; None to discard them. Encoding is not measured.
        overwrite: replace an existing video of this program.
        progress: called after each frame.
        stop_requested: polled; True ends the measurement.

    Raises:
        BundleError: the model cannot be read.
        DeviceMissing: the device is not available.
        InvalidSetting: an option is out of range, or no frame was measured.
        OutputError: `out` cannot be written or must not be replaced.
    """
    if out is not None:
        if out.suffix.lower() != VIDEO_SUFFIX:
            raise OutputError(f"{out} does not end in {VIDEO_SUFFIX}; give the name of a video")
        check_video_path([source, *([] if settings.path is None else [settings.path])], out, overwrite)
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device, options=settings.options)
    start_s = time.perf_counter()
    model = load_model(source).to(settings.device)
    _wait(settings.device)
    load_s = time.perf_counter() - start_s
    size_px = model.camera.width_px, model.camera.height_px
    if settings.width_px is not None and settings.height_px is not None:
        size_px = settings.width_px, settings.height_px
    camera = model.camera.fitted(*size_px)
    check_picture(camera, 1.0)
    model = replace(model, camera=camera)
    if settings.device == "cpu":
        needed = render_bytes(*size_px, model.parameter_count)
        require_memory(needed, f"a picture of {size_px[0]}x{size_px[1]} px", "give a smaller --width and --height")
    view = view_of(model, camera, ViewWish("orbit" if settings.path is None else str(settings.path)))
    if settings.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    renderer = new_renderer(settings.renderer, camera, settings.device, options=settings.options)
    start_s = time.perf_counter()
    renderer.prepare(model)
    _wait(settings.device)
    prepare_s = time.perf_counter() - start_s
    times_s = np.linspace(*view.window_s, settings.frames).tolist()
    taken_ms: list[float] = []

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for k, time_s in enumerate([times_s[0]] * WARM_UP + times_s):
            if stop_requested():
                return
            frame_camera = view.cameras(time_s)[0]
            with torch.inference_mode():
                begun = time.perf_counter()
                image = renderer.render(frame_camera, time_s, ("image",)).result().image
                _wait(settings.device)
                ended = time.perf_counter()
                picture = None if out is None or k < WARM_UP else displayed(image)
            if k < WARM_UP:
                continue
            taken_ms.append(1e3 * (ended - begun))
            if picture is not None:
                yield picture
            if progress is not None:
                progress(Progress("bench", len(taken_ms), settings.frames))

    if out is None:
        for _ in pictures():
            pass
    else:
        write_video(pictures(), out, size_px, VIDEO_FPS, overwrite)
    if not taken_ms:
        raise InvalidSetting("the measurement was interrupted before its first frame; there is nothing to report")
    p50, p99 = (float(value) for value in np.percentile(taken_ms, [50, 99], method="inverted_cdf"))
    cuda = settings.device == "cuda"
    return BenchResult(
        gaussians=model.gaussians.count,
        sh_degree=model.gaussians.sh_degree,
        width_px=size_px[0],
        height_px=size_px[1],
        renderer=settings.renderer,
        device=torch.cuda.get_device_name() if cuda else settings.device,
        frames=len(taken_ms),
        load_s=load_s,
        prepare_s=prepare_s,
        frame_ms_p50=p50,
        frame_ms_p99=p99,
        fps_p50=1e3 / p50,
        fps_p99=1e3 / p99,
        parameter_bytes=sum(tensor.nbytes for tensor in model.tensors().values()),
        device_peak_bytes=torch.cuda.max_memory_allocated() if cuda else None,
        host_peak_bytes=peak_bytes(),
    )


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()
