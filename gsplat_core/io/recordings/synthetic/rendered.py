"""Synthetic recording rendered into memory and never written to disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from gsplat_core.io.recordings.calibration import DEFAULT_FOCAL_FACTOR
from gsplat_core.io.recordings.synthetic.extras import CLEAR, Extras
from gsplat_core.io.recordings.synthetic.scene import BASELINE_MM, SyntheticScene
from gsplat_core.io.recordings.synthetic.synthesize import check_arguments, threads_that_fit
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


@dataclass(frozen=True)
class RenderSettings:
    """Parameters of a synthetic recording; the fields match the arguments of `synthesize`."""

    frames: int = 48
    width_px: int = 320
    height_px: int = 256
    fps: float = 30.0
    seed: int = 0
    camera: Literal["fixed", "moving"] = "fixed"
    stereo: bool = False
    extras: Extras = CLEAR
    """Generator options; only breathing and scope path are used."""


class RenderedRecording:
    """In-memory recording: frames with the generator's masks, depth and poses."""

    notes: tuple[str, ...] = ()

    def __init__(self, frames: list[Frame], settings: RenderSettings) -> None:
        self.name = "synthetic"
        self.width_px, self.height_px = settings.width_px, settings.height_px
        self.camera = Camera.from_focal(
            DEFAULT_FOCAL_FACTOR * max(settings.width_px, settings.height_px), settings.width_px, settings.height_px
        )
        right = self.camera.right_eye(BASELINE_MM) if settings.stereo else None
        self._frames = [frame.with_fields(right_camera=right) for frame in frames]
        self.frame_count, self.fps = len(frames), settings.fps
        extras = [] if settings.extras == CLEAR else [settings.extras.described()]
        stated = [*(getattr(settings, each.name) for each in fields(settings) if each.name != "extras"), *extras]
        self.digest = hashlib.sha256(json.dumps(stated).encode()).hexdigest()
        self.fields = frozenset({"mask", "depth", "pose", *(["right_image"] if settings.stereo else [])})
        self.stereo_baseline_mm = BASELINE_MM if settings.stereo else None

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order."""
        return iter(self._frames)

    def camera_at(self, index: int) -> Camera:
        """Return the camera of one frame."""
        pose = self._frames[index].pose
        assert pose is not None
        return self.camera.with_pose(pose)


def render_recording(settings: RenderSettings, progress: Callable[[int, int], None] | None = None) -> RenderedRecording:
    """Render the recording that `synthesize` would write.

    Raises:
        InvalidSetting: if an argument is out of range.
    """
    frames, fps = settings.frames, settings.fps
    check_arguments(frames, settings.width_px, settings.height_px, fps, settings.seed, settings.camera)
    threads = threads_that_fit(settings.width_px, settings.height_px)
    scene = SyntheticScene.from_seed(
        settings.seed, settings.width_px, settings.height_px, frames / fps, settings.camera == "moving", settings.extras
    )

    def rendered(index: int) -> Frame:
        time_s = index / fps
        left = scene.render(time_s)
        return Frame(
            seq=index,
            pts_ns=round(time_s * 1e9),
            image=left.image,
            right_image=scene.render(time_s, "right").image if settings.stereo else None,
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
    return RenderedRecording(made, settings)
