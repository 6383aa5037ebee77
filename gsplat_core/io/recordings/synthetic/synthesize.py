"""Writer of synthetic recordings in the EndoNeRF layout, with `recording.json` and ground truth.

images/frame-000000.color.png        left eye
images_right/frame-000000.color.png  right eye of the rectified pair, rendered, not warped
masks/frame-000000.mask.png          255 = tool
depth/frame-000000.depth.png         16 bit, units of 0.01 mm: first surface hit, tool or tissue
poses_bounds.npy                     camera-to-world, size, focal length, near and far depth
tracks.npy                           float32 [frames, points, 3]: tissue points in the world, mm
recording.json                       frame rate, camera, units, seed, description of the files

Additional files, by field of `Extras`:

views.json, views/third/             held-out camera: images, masks and depth
flow/000000.npy, scene_flow/         float32 [H, W, 2] in px and [H, W, 3] in mm, to the next frame
tracks_seen.npy                      uint8 [frames, points]: visibility in the left eye
behind/images, behind/depth          left picture and depth with transparent tools
true_depth/                          noise-free depth if depth/ has noise
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import PartialFolder
from gsplat_core.io.recordings.synthetic.description import describe
from gsplat_core.io.recordings.synthetic.extras import CLEAR, Extras
from gsplat_core.io.recordings.synthetic.files import FrameFiles
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.io.recordings.synthetic.target import check_target
from gsplat_core.memory import available_bytes, in_gib

MAX_SEED = 2**63 - 1
SCENE_BYTES = 1120
"""Measured memory during texture generation, in bytes per pixel of a square of the longer side.

The number of texels follows the resolution.
"""
FRAME_BYTES = 300
"""Measured memory during the rendering of one frame, in bytes per pixel."""


def synthesize(
    out: str | os.PathLike[str],
    *,
    frames: int = 60,
    width_px: int = 320,
    height_px: int = 256,
    fps: float = 30,
    seed: int = 0,
    camera: Literal["fixed", "moving"] = "fixed",
    stereo: bool = True,
    extras: Extras = CLEAR,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a synthetic recording with exact ground truth into the folder `out` and return the folder.

    Equal arguments give equal bytes. The folder appears once complete. A folder written by an earlier call is replaced;
    any other non-empty folder is refused. `progress(done, frames)` is called after each frame.

    Raises:
        InvalidSetting: if an argument is out of range, or `out` has foreign content, is a link or is the root of a
            disk.
    """
    check_arguments(frames, width_px, height_px, fps, seed, camera)
    target = Path(out)
    check_target(target)
    threads = threads_that_fit(width_px, height_px)
    target.parent.mkdir(parents=True, exist_ok=True)
    with PartialFolder(target) as partial:
        # The flow of the last frame points to a frame that is not written.
        scene = SyntheticScene.from_seed(seed, width_px, height_px, frames / fps, camera == "moving", extras)
        _write(FrameFiles(scene, partial.path, fps, seed, stereo, extras), frames, progress, threads)
        check_target(target)  # another process may have created files meanwhile
        earlier = partial.finish()
        if earlier is not None:
            shutil.rmtree(earlier)
    return target


def check_arguments(frames: int, width_px: int, height_px: int, fps: float, seed: int, camera: str) -> None:
    if not 1 <= frames <= 100_000:
        raise InvalidSetting(f"frames must be 1 to 100000, got {frames}")
    if not (32 <= width_px <= 4096 and 32 <= height_px <= 4096):
        raise InvalidSetting(f"the size must be from 32x32 to 4096x4096 px, got {width_px}x{height_px}")
    if not 1 <= fps <= 240:
        raise InvalidSetting(f"fps must be from 1 to 240, got {fps}")
    if not 0 <= seed <= MAX_SEED:
        raise InvalidSetting(f"seed must be 0 to {MAX_SEED}, got {seed}")
    if camera not in ("fixed", "moving"):
        raise InvalidSetting(f"camera must be 'fixed' or 'moving', got {camera!r}")


def threads_that_fit(width_px: int, height_px: int) -> int:
    """Return the number of frames to render concurrently within the available memory.

    Raises:
        InvalidSetting: if the memory does not suffice for the scene and one frame.
    """
    texture, frame = SCENE_BYTES * max(width_px, height_px) ** 2, FRAME_BYTES * width_px * height_px
    threads = min(8, os.cpu_count() or 1)
    available = available_bytes()
    if available is None:
        return threads
    if texture + frame > available:
        raise InvalidSetting(
            f"frames of {width_px}x{height_px} px take about {in_gib(texture + frame)} of memory, and {in_gib(available)} are free; give a"
            " smaller size"
        )
    return max(1, min(threads, (available - texture) // frame))


def _write(files: FrameFiles, frames: int, progress: Callable[[int, int], None] | None, threads: int) -> None:
    files.make_folders()
    rows = []
    # A frame depends on its index alone, so the order in which threads finish does not matter.
    pool = ThreadPoolExecutor(max_workers=threads)
    try:
        for done, row in enumerate(pool.map(files.write, range(frames)), start=1):
            rows.append(row)
            if progress is not None:
                progress(done, frames)
    finally:
        pool.shutdown(cancel_futures=True)  # after Ctrl-C or a full disk the frames not begun are not rendered
    files.finish(rows)
    describe(files, frames)
