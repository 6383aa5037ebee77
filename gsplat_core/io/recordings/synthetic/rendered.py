"""A synthetic recording that is rendered into memory, and never written."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np

from gsplat_core.io.recordings.synthetic.synthesize import (
    BASELINE_MM,
    SyntheticScene,
    check_arguments,
    threads_that_fit,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


class RenderedRecording:
    """Frames with masks, depth and poses as the generator knows them; a `Recording` that needs no disk."""

    notes: tuple[str, ...] = ()

    def __init__(self, frames: list[Frame], scene: SyntheticScene, fps: float, digest: str) -> None:
        self._frames, self._scene = frames, scene
        self.name = "synthetic"
        self.camera = scene.camera_at(0)
        self.width_px, self.height_px = self.camera.width_px, self.camera.height_px
        self.frame_count, self.fps, self.digest = len(frames), fps, digest
        stereo = frames[0].right_image is not None
        self.fields = frozenset({"mask", "depth", "pose", *(["right_image"] if stereo else [])})
        self.stereo_baseline_mm = BASELINE_MM if stereo else None

    def __iter__(self) -> Iterator[Frame]:
        """The frames, in order."""
        return iter(self._frames)

    def camera_at(self, index: int) -> Camera:
        """The camera of one frame."""
        return self._scene.camera_at(index / self.fps)


def render_recording(
    *,
    frames: int = 48,
    width_px: int = 320,
    height_px: int = 256,
    fps: float = 30,
    seed: int = 0,
    camera: Literal["fixed", "moving"] = "fixed",
    stereo: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RenderedRecording:
    """The recording that `synthesize` writes, in memory. Raises InvalidSetting for arguments out of range, as `synthesize`."""
    check_arguments(frames, width_px, height_px, fps, seed, camera)
    threads = threads_that_fit(width_px, height_px)
    scene = SyntheticScene.from_seed(seed, width_px, height_px, frames / fps, camera == "moving")

    def rendered(index: int) -> Frame:
        time_s = index / fps
        left = scene.render(time_s)
        return Frame(
            seq=index,
            pts_ns=round(time_s * 1e9),
            image=left.image,
            right_image=scene.render(time_s, "right").image if stereo else None,
            depth=left.depth.astype(np.float32),
            mask=np.where(left.tool, 0, 1).astype(np.uint8),
            pose=scene.camera_at(time_s).world_to_camera,
        )

    made = []
    with ThreadPoolExecutor(max_workers=threads) as pool:
        for done, frame in enumerate(pool.map(rendered, range(frames)), start=1):
            made.append(frame)
            if progress is not None:
                progress(done, frames)
    what = json.dumps([frames, width_px, height_px, fps, seed, camera, stereo])
    return RenderedRecording(made, scene, fps, hashlib.sha256(what.encode()).hexdigest())
