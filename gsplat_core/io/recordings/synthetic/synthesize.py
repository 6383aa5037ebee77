"""Writing a synthetic recording: the EndoNeRF layout, `recording.json`, and exact ground truth.

images/frame-000000.color.png        left eye
images_right/frame-000000.color.png  right eye of the rectified pair, rendered, not warped
masks/frame-000000.mask.png          255 = tool
depth/frame-000000.depth.png         16 bit, units of 0.01 mm: the first surface on the ray, tool or tissue
poses_bounds.npy                     camera-to-world, size, focal length, nearest and farthest depth
tracks.npy                           float32 [frames, points, 3]: material points of the tissue in the world, in mm
recording.json                       frame rate, camera, units, seed, and what the files mean
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.atomic_files import PartialFolder
from gsplat_core.io.recordings.calibration import DEFAULT_FOCAL_FACTOR
from gsplat_core.io.recordings.sidecars import RECORDING_FORMAT, RECORDING_VERSION
from gsplat_core.io.recordings.synthetic.renderer import Eye, render_eye
from gsplat_core.io.recordings.synthetic.target import GENERATOR, check_target
from gsplat_core.io.recordings.synthetic.tissue import TISSUE_DISTANCE_MM, Tissue
from gsplat_core.io.recordings.synthetic.tool import CYCLE_S, ToolMotion
from gsplat_core.memory import available_bytes, in_gib
from gsplat_core.scene.cameras import Camera

BASELINE_MM = 4.4
DEPTH_UNIT_MM = 0.01
MAX_SEED = 2**63 - 1
SCENE_BYTES = 1120
"""Memory while the tissue's texture is made, for each pixel of a square with the longer side: its texels follow the resolution (measured)."""
FRAME_BYTES = 300
"""Memory while one frame is rendered, for each of its pixels (measured)."""


@dataclass(frozen=True)
class SyntheticScene:
    """Tissue, tool and camera as functions of time; each frame can be rendered on its own."""

    tissue: Tissue
    motion: ToolMotion
    camera: Camera
    moving: bool

    @classmethod
    def from_seed(cls, seed: int, width_px: int, height_px: int, duration_s: float, moving: bool) -> SyntheticScene:
        """The scene of a seed; another size shows the same scene."""
        camera = Camera.from_focal(DEFAULT_FOCAL_FACTOR * max(width_px, height_px), width_px, height_px)
        shape, tool = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(2))
        tissue = Tissue(shape, texel_mm=min(0.6 * TISSUE_DISTANCE_MM / float(camera.K[0, 0]), 0.3))
        return cls(tissue, ToolMotion(tool, cycles=int(duration_s // CYCLE_S) + 1), camera, moving)

    def camera_at(self, time_s: float) -> Camera:
        """The left camera: at rest, or swaying around a point on the tissue. At time 0 it is at the world's origin."""
        if not self.moving:
            return self.camera
        sway = 2 * np.pi * time_s
        centre = np.array([7 * np.sin(sway / 4.1), 4.5 * np.sin(sway / 5.3), 6 * np.sin(sway / 6.7)])
        forward = np.array([0, 0, TISSUE_DISTANCE_MM]) - centre
        forward /= np.linalg.norm(forward)
        roll = 0.05 * np.sin(sway / 4.7)
        right = np.cross([-np.sin(roll), np.cos(roll), 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        return self.camera.with_pose(pose)

    def render(self, time_s: float, eye: Literal["left", "right"] = "left") -> Eye:
        """What an eye sees at a time."""
        camera, scope_x_mm = self.camera_at(time_s), BASELINE_MM / 2
        if eye == "right":
            pose = camera.world_to_camera.copy()
            pose[0, 3] -= BASELINE_MM
            camera, scope_x_mm = camera.with_pose(pose), -BASELINE_MM / 2
        parts = self.motion.parts(self.tissue, time_s)
        return render_eye(self.tissue, self.motion.tug(time_s), parts, camera, time_s, scope_x_mm)

    def track(self, time_s: float) -> NDArray[np.float32]:
        """A grid of material points in the world [63, 3], mm."""
        u, v = np.meshgrid(np.linspace(-32, 32, 9, dtype=np.float32), np.linspace(-24, 24, 7, dtype=np.float32))
        points = self.tissue.points(u.ravel(), v.ravel(), time_s, self.motion.tug(time_s))
        return np.stack(points.position, axis=1)


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
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a synthetic recording with exact ground truth into the folder `out`, and return it.

    The same arguments give the same bytes. The folder appears when it is complete; one that an earlier call wrote is
    replaced, any other that is not empty is refused. `progress(done, frames)` is called after each frame.

    Raises InvalidSetting for arguments out of range, and for an `out` that holds anything else, is a link or the root of a disk.
    """
    check_arguments(frames, width_px, height_px, fps, seed, camera)
    target = Path(out)
    check_target(target)
    threads = threads_that_fit(width_px, height_px)
    target.parent.mkdir(parents=True, exist_ok=True)
    with PartialFolder(target) as partial:
        scene = SyntheticScene.from_seed(seed, width_px, height_px, frames / fps, camera == "moving")
        _write(scene, partial.path, frames, fps, stereo, progress, threads)
        _describe(partial.path, scene, frames, fps, seed, stereo)
        check_target(target)  # something may have been put there meanwhile
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
    """How many frames are rendered at once. Raises InvalidSetting where the memory is too small for the scene and one frame."""
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


def _write(
    scene: SyntheticScene,
    folder: Path,
    frames: int,
    fps: float,
    stereo: bool,
    progress: Callable[[int, int], None] | None,
    threads: int,
) -> None:
    for name in ("images", "masks", "depth", *(["images_right"] if stereo else [])):
        (folder / name).mkdir()

    def write_frame(index: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        time_s = index / fps
        left = scene.render(time_s)
        stem = f"frame-{index:06d}"
        _save(folder / "images" / f"{stem}.color.png", cv2.cvtColor(left.image, cv2.COLOR_RGB2BGR))
        _save(folder / "masks" / f"{stem}.mask.png", np.where(left.tool, 255, 0).astype(np.uint8))
        stored = np.round(left.depth / np.float32(DEPTH_UNIT_MM)).astype(np.uint16)
        _save(folder / "depth" / f"{stem}.depth.png", stored)
        if stereo:
            right = scene.render(time_s, "right")
            _save(folder / "images_right" / f"{stem}.color.png", cv2.cvtColor(right.image, cv2.COLOR_RGB2BGR))
        view = scene.camera_at(time_s)
        row = np.zeros((3, 5))
        row[:, :3], row[:, 3] = view.world_to_camera[:3, :3].T, view.position
        row[:, 4] = view.height_px, view.width_px, view.K[0, 0]
        return np.concatenate([row.ravel(), [left.depth.min(), left.depth.max()]]), scene.track(time_s)

    rows, tracks = [], []
    # A frame depends on its index alone, so the order in which threads finish does not matter.
    pool = ThreadPoolExecutor(max_workers=threads)
    try:
        for done, (row, track) in enumerate(pool.map(write_frame, range(frames)), start=1):
            rows.append(row)
            tracks.append(track)
            if progress is not None:
                progress(done, frames)
    finally:
        pool.shutdown(cancel_futures=True)  # after Ctrl-C or a full disk the frames not begun are not rendered
    np.save(folder / "poses_bounds.npy", np.stack(rows))
    np.save(folder / "tracks.npy", np.stack(tracks).astype(np.float32))


def _save(path: Path, pixels: np.ndarray) -> None:
    encoded, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    assert encoded
    path.write_bytes(data.tobytes())


def _describe(folder: Path, scene: SyntheticScene, frames: int, fps: float, seed: int, stereo: bool) -> None:
    camera = scene.camera
    description = {
        "format": RECORDING_FORMAT,
        "version": RECORDING_VERSION,
        "generator": GENERATOR,
        "seed": seed,
        "frames": frames,
        "fps": fps,
        "units": "mm",
        "camera": {
            "model": "pinhole",
            "width": camera.width_px,
            "height": camera.height_px,
            "fx": float(camera.K[0, 0]),
            "fy": float(camera.K[1, 1]),
            "cx": float(camera.K[0, 2]),
            "cy": float(camera.K[1, 2]),
        },
        "camera_moves": scene.moving,
        "depth_unit_mm": DEPTH_UNIT_MM,
        "stereo_baseline_mm": BASELINE_MM if stereo else None,
        "ground_truth": {
            "images": "sRGB, one ray for each pixel centre (column + 0.5, row + 0.5)",
            "images_right": "rendered from the right eye, rectified: disparity = fx * stereo_baseline_mm / depth",
            "masks": "255 = every pixel that the tool covers in part, 0 = tissue alone",
            "depth": "z of the first surface on the ray, tool or tissue, in units of depth_unit_mm",
            "poses_bounds.npy": "camera-to-world, OpenCV axes; (height, width, f); nearest and farthest depth in mm",
            "tracks.npy": "float32 [frames, points, 3]: material points of the tissue in the world, mm",
        },
    }
    (folder / "recording.json").write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
