"""A finished model as a video or as images, over its time window."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from gsplat_core.errors import InvalidInput
from gsplat_core.io.bundle import load_bundle
from operators.applications.device import check_device
from operators.applications.progress import Progress, ProgressCallback
from operators.errors import OutputError
from operators.output_folder import check_output_folder, claim_output_folder
from operators.rasterize import displayed
from operators.sinks.display import write_png
from operators.sinks.video_file import VideoFile
from operators.storage import StorageReserve

RESERVE_BYTES = 2**20
VIDEO_SUFFIX = ".mp4"


def render_model(
    bundle: Path,
    out: Path,
    *,
    fps: float = 30.0,
    scale: float = 1.0,
    device: str = "cpu",
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> int:
    """Render the model at `fps` frames per second of its own time, to `out`: a file ending in .mp4, or a folder of PNG images.

    Returns the number of frames written; what was written before a stop is complete.

    Raises BundleError, DeviceMissing, InvalidInput, OutputFolderInUse, OutputError, StorageFull.
    """
    if not (math.isfinite(fps) and 0 < fps <= 1000):
        raise InvalidInput(f"fps is {fps}; it must be above 0 and at most 1000")
    check_device(device)
    model = load_bundle(bundle).to(device)
    camera = model.camera.scaled(scale)
    start_s, end_s = model.time_window_s
    count = math.floor((end_s - start_s) * fps + 1e-6) + 1
    video = None
    try:
        if out.suffix.lower() == VIDEO_SUFFIX:
            if out.is_dir():
                raise OutputError(f"{out} is a folder; give the name of a video file that ends in {VIDEO_SUFFIX}")
            if not out.parent.is_dir():
                raise OutputError(f"there is no folder {out.parent} to write {out.name} into; make it first")
            video = VideoFile(
                out, camera.width_px, camera.height_px, fps, StorageReserve(out.parent, lambda: RESERVE_BYTES)
            )
        else:
            check_output_folder(out)
            claim_output_folder(out, "render")
        reserve = StorageReserve(out if video is None else out.parent, lambda: RESERVE_BYTES)
        for k in range(count):
            if stop_requested():
                return k
            image = displayed(model.render(start_s + k / fps, camera, depth=False).image)
            if video is None:
                write_png(out / f"{k:06d}.png", image, reserve)
            else:
                video.write(image)
            if progress is not None:
                progress(Progress("render", k + 1, count))
    finally:
        if video is not None:
            video.close()
    return count
