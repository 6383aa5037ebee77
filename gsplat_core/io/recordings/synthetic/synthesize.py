"""Writer of synthetic recordings in the EndoNeRF layout, with `recording.json` and ground truth.

images/frame-000000.color.png        left eye
images_right/frame-000000.color.png  right eye of the rectified pair, rendered, not warped
masks/frame-000000.mask.png          255 = tool
depth/frame-000000.depth.png         16 bit, units of 0.01 mm: first surface hit, tool or tissue
poses_bounds.npy                     camera-to-world, size, focal length, near and far depth
tracks.npy                           float32 [frames, points, 3]: tissue points in the world, mm
valid_mask.png                       255 = inside of a circular or octagonal field of view, if there is one
recording.json                       frame rate, camera, units, seed, description of the files

Additional files, by field of `Extras`:

views.json, views/third/             held-out camera: images, masks and depth
flow/000000.npy, scene_flow/         float32 [H, W, 2] in px and [H, W, 3] in mm, to the next frame
tracks_seen.npy                      uint8 [frames, points]: visibility in the left eye
behind/images, behind/depth          left picture and depth with transparent tools
true_depth/                          noise-free depth if depth/ has noise

Exact optical flow, scene flow and point visibility of a synthetic scene.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import PartialFolder, read_regular
from gsplat_core.io.recordings.contents import RECORDING_FORMAT, RECORDING_VERSION
from gsplat_core.io.recordings.synthetic.optics import RadialLens
from gsplat_core.io.recordings.synthetic.random_scene import RandomScene
from gsplat_core.io.recordings.synthetic.renderer import Eye
from gsplat_core.io.recordings.synthetic.scene import CLEAR, Extras, SyntheticScene
from gsplat_core.io.recordings.synthetic.tissue import TISSUE_DISTANCE_MM
from gsplat_core.io.recordings.truth import VIEWS_FILE, VIEWS_FORMAT, VIEWS_VERSION
from gsplat_core.machine import available_bytes, in_gib
from gsplat_core.scene.cameras import Camera

HIDDEN_MM = 0.5
"""Depth in mm behind the visible surface from which a tracked point counts as hidden by a fold."""


@dataclass(frozen=True)
class Motion:
    """Motion from one frame to the next; NaN at tool pixels."""

    flow: NDArray[np.float32]
    """Optical flow of the left picture [H, W, 2] in pixels: the tissue at pixel p moves to p + flow."""
    scene_flow: NDArray[np.float32]
    """Displacement of the tissue in the world [H, W, 3] in mm."""


def motion_to(scene: SyntheticScene, eye: Eye, time_s: float, next_s: float) -> Motion:
    """Compute the motion of each pixel's tissue point from one time to another.

    Args:
        scene: synthetic scene.
        eye: left camera's view at `time_s`.
        time_s: start time in seconds.
        next_s: end time in seconds.
    """
    now, then = (
        np.stack(scene.tissue.points(eye.u, eye.v, at, scene.tug(at)).position, axis=-1) for at in (time_s, next_s)
    )
    pixels, _ = projected(scene.camera_at(next_s), then.reshape(-1, 3), scene.lens)
    height, width = eye.u.shape
    here = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    flow = (pixels.reshape(height, width, 2) - here).astype(np.float32)
    moved = (then - now).astype(np.float32)
    flow[eye.tool], moved[eye.tool] = np.nan, np.nan
    return Motion(flow, moved)


def seen_points(scene: SyntheticScene, eye: Eye, time_s: float) -> NDArray[np.bool_]:
    """Return the visibility, bool [points], of the tracked points in the left camera.

    A point is visible if it is inside the picture, on the front surface and not behind the tool.
    """
    pixels, z = projected(scene.camera_at(time_s), scene.track(time_s), scene.lens)
    height, width = eye.u.shape
    column, row = (np.floor(pixels[:, k]).astype(int) for k in (0, 1))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 0)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    # Half a pixel away the surface may be slightly nearer. Allow for its slope.
    slope = np.hypot(*np.gradient(eye.tissue_depth))[row, column]
    in_front = z <= eye.tissue_depth[row, column] + HIDDEN_MM + slope
    in_field = True if scene.inside is None else scene.inside[row, column]
    return np.asarray(inside & in_front & ~eye.tool[row, column] & in_field)


def projected(
    camera: Camera, points: NDArray, lens: RadialLens | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project world points [N, 3] in mm; return pixel coordinates [N, 2] and depth z [N] in mm."""
    local = points.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    if lens is not None:
        x, y = lens.bent(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
        return np.stack([x, y, np.ones_like(x)], axis=1) @ camera.K.T[:, :2], local[:, 2]
    return (local @ camera.K.T)[:, :2] / local[:, 2:], local[:, 2]


GENERATOR = "intrasplat synthesize"
_FRAME = r"frame-\d{6}\."
_WRITTEN = re.compile(
    rf"(views/third/|behind/)?(images/{_FRAME}color|depth/{_FRAME}depth)\.png|(views/third/)?masks/{_FRAME}mask\.png"
    rf"|images_right/{_FRAME}color\.png|true_depth/{_FRAME}depth\.png|(scene_)?flow/\d{{6}}\.npy"
    r"|poses_bounds\.npy|tracks\.npy|tracks_seen\.npy|recording\.json|views\.json|valid_mask\.png"
)
"""Pattern of the relative paths of files that `synthesize` writes; other files in a target folder are foreign."""
_FOLDERS = frozenset(f"{inside}{name}" for inside in ("", "views/third/") for name in ("images", "masks", "depth")) | {
    "behind",
    "behind/images",
    "behind/depth",
    "images_right",
    "true_depth",
    "flow",
    "scene_flow",
    "views",
    "views/third",
}


def check_target(target: Path) -> None:
    """Check that `target` can be replaced without losing foreign files.

    Raises:
        InvalidSetting: if it contains anything that `synthesize` did not write.
        OSError: if the name is impossible.
    """
    try:
        os.lstat(target)
    except FileNotFoundError:
        return
    if target.is_symlink():
        raise InvalidSetting(f"{target} is a link; give the folder itself, or one that does not exist yet")
    if not target.is_dir():
        raise InvalidSetting(f"{target} is a file; give a folder that does not exist yet")
    if os.path.ismount(target):
        raise InvalidSetting(f"{target} is the root of a disk, which cannot be replaced; give a folder on it")
    foreign = sorted(_foreign(target))
    if foreign:
        raise InvalidSetting(
            f"{target} holds what synthesize did not write ({', '.join(foreign[:5])}); give a new or an empty folder"
        )


def _foreign(target: Path) -> Iterator[str]:
    """Yield the names of entries that no earlier `synthesize` call wrote.

    Every entry is foreign unless the folder contains a synthetic recording's description.
    """
    description = target / "recording.json"
    ours = description.is_file() and _made_here(description)
    folders = [target]
    for folder in folders:
        for entry in folder.iterdir():
            name = entry.relative_to(target).as_posix()
            if not ours or entry.is_symlink():
                yield name
            elif name in _FOLDERS and entry.is_dir() and not os.path.ismount(entry):
                folders.append(entry)
            elif not (_WRITTEN.fullmatch(name) and entry.is_file()):
                yield name


def _made_here(description: Path) -> bool:
    try:
        content = json.loads(read_regular(description, 1 << 20))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("generator") == GENERATOR


DEPTH_UNIT_MM = 0.01
VALID_MASK_FILE = "valid_mask.png"


@dataclass(frozen=True)
class FrameRow:
    """Pose, and positions and visibility of the tracked points, of one frame, for the files that hold all frames."""

    pose_bounds: NDArray[np.float64]
    track: NDArray[np.float32]
    seen: NDArray[np.bool_] | None


@dataclass(frozen=True)
class FrameFiles:
    """Writer of the files of one frame at a time, in any order."""

    scene: SyntheticScene
    folder: Path
    fps: float
    seed: int
    stereo: bool
    extras: Extras

    def make_folders(self) -> None:
        """Create the folders that `write` writes to."""
        names = ["images", "masks", "depth"]
        names += ["images_right"] if self.stereo else []
        names += [f"views/third/{name}" for name in ("images", "masks", "depth")] if self.extras.third else []
        names += ["behind/images", "behind/depth"] if self.extras.behind else []
        names += ["flow", "scene_flow"] if self.extras.flow else []
        names += ["true_depth"] if self.extras.depth_noise_mm else []
        for name in names:
            (self.folder / name).mkdir(parents=True)

    def write(self, index: int) -> FrameRow:
        """Write one frame; the result depends only on its index."""
        scene, extras, time_s = self.scene, self.extras, index / self.fps
        left = scene.render(time_s)
        self._view(self.folder, index, left)
        if extras.depth_noise_mm:
            save_depth(self.folder / "true_depth" / _name(index, "depth"), left.depth)
            save_depth(self.folder / "depth" / _name(index, "depth"), self._noisy(left.depth, index))
        if extras.behind:
            bare = scene.render(time_s, transparent=True)
            save_image(self.folder / "behind/images" / _name(index, "color"), bare.image)
            save_depth(self.folder / "behind/depth" / _name(index, "depth"), bare.depth)
        if self.stereo:
            save_image(self.folder / "images_right" / _name(index, "color"), scene.render(time_s, "right").image)
        if extras.third:
            self._view(self.folder / "views/third", index, scene.render(time_s, "third"))
        if extras.flow:
            motion = motion_to(scene, left, time_s, (index + 1) / self.fps)
            np.save(self.folder / "flow" / f"{index:06d}.npy", motion.flow)
            np.save(self.folder / "scene_flow" / f"{index:06d}.npy", motion.scene_flow)
        view = scene.camera_at(time_s)
        row = np.zeros((3, 5))
        row[:, :3], row[:, 3] = view.world_to_camera[:3, :3].T, view.position
        row[:, 4] = view.height_px, view.width_px, view.K[0, 0]
        known = left.depth if scene.inside is None else left.depth[scene.inside]
        pose_bounds = np.concatenate([row.ravel(), [known.min(), known.max()]])
        return FrameRow(pose_bounds, scene.track(time_s), seen_points(scene, left, time_s) if extras.tracks else None)

    def finish(self, rows: list[FrameRow]) -> None:
        """Write the files shared by all frames."""
        if self.scene.inside is not None:
            _save(self.folder / VALID_MASK_FILE, np.where(self.scene.inside, 255, 0).astype(np.uint8))
        np.save(self.folder / "poses_bounds.npy", np.stack([row.pose_bounds for row in rows]))
        np.save(self.folder / "tracks.npy", np.stack([row.track for row in rows]).astype(np.float32))
        if self.extras.tracks:
            np.save(
                self.folder / "tracks_seen.npy",
                np.stack([row.seen for row in rows if row.seen is not None]).astype(np.uint8),
            )

    def _view(self, folder: Path, index: int, eye: Eye) -> None:
        save_image(folder / "images" / _name(index, "color"), eye.image)
        encoded = np.where(eye.tool, 255, 0).astype(np.uint8)
        _save(folder / "masks" / _name(index, "mask"), encoded)
        save_depth(folder / "depth" / _name(index, "depth"), eye.depth)

    def _noisy(self, depth: NDArray[Any], index: int) -> NDArray[Any]:
        """Add noise to the depth that grows with the squared distance, like that of a stereo matcher."""
        random = np.random.default_rng((self.seed, index, 3))
        spread = self.extras.depth_noise_mm * np.square(depth / np.float32(TISSUE_DISTANCE_MM))
        return np.maximum(depth + spread * random.standard_normal(depth.shape, np.float32), np.float32(DEPTH_UNIT_MM))


def save_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image as PNG."""
    _save(path, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def save_depth(path: Path, depth: NDArray[Any]) -> None:
    """Write depth in mm as 16-bit PNG in units of DEPTH_UNIT_MM."""
    _save(path, np.round(depth / np.float32(DEPTH_UNIT_MM)).astype(np.uint16))


def _name(index: int, what: str) -> str:
    return f"frame-{index:06d}.{what}.png"


def _save(path: Path, pixels: NDArray[Any]) -> None:
    encoded, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    assert encoded
    path.write_bytes(data.tobytes())


_ALWAYS = {
    "images": "sRGB, one ray for each pixel centre (column + 0.5, row + 0.5)",
    "images_right": "rendered from the right eye, rectified: disparity = fx * stereo_baseline_mm / depth",
    "masks": "255 = every pixel that the tool covers in part, 0 = tissue alone",
    "depth": "z of the first surface on the ray, tool or tissue, in units of depth_unit_mm",
    "poses_bounds.npy": "camera-to-world, OpenCV axes; (height, width, f); nearest and farthest depth in mm",
    "tracks.npy": "float32 [frames, points, 3]: material points of the tissue in the world, mm",
}
_THIRD = {"views": "cameras that are never given to training (views.json): images, masks and depth as of the left eye"}
_FLOW = {
    "flow": "float32 [H, W, 2], pixels: what is at pixel p of a frame is at p + flow in the next one; NaN where the tool is",
    "scene_flow": "float32 [H, W, 3], mm: how far that tissue moves in the world; NaN where the tool is",
}
_SEEN = {"tracks_seen.npy": "uint8 [frames, points]: 1 where the left eye sees the point"}
_NOISY = {
    "depth": "true_depth with noise that grows with the square of the distance",
    "true_depth": _ALWAYS["depth"],
}


_BEHIND = {
    "behind/images": "the left eye's picture through the tool: tissue that it hides, in its shadow",
    "behind/depth": "z of that tissue",
}


def describe(files: FrameFiles, frames: int) -> None:
    """Write `recording.json`, and `views.json` if the recording has a third camera."""
    extras, scene = files.extras, files.scene
    meaning = dict(_ALWAYS)
    for wanted, more in (
        (extras.third, _THIRD),
        (extras.flow, _FLOW),
        (extras.tracks, _SEEN),
        (extras.behind, _BEHIND),
    ):
        meaning |= more if wanted else {}
    meaning |= _NOISY if extras.depth_noise_mm else {}
    description: dict[str, Any] = {
        "format": RECORDING_FORMAT,
        "version": RECORDING_VERSION,
        "generator": GENERATOR,
        "seed": files.seed,
        "frames": frames,
        "fps": files.fps,
        "units": "mm",
        "camera": _intrinsics(scene.camera) | _distortion(scene.lens),
        "camera_moves": scene.moving,
        "depth_unit_mm": DEPTH_UNIT_MM,
        "stereo_baseline_mm": scene.baseline_mm if files.stereo else None,
        "ground_truth": meaning,
    }
    if extras != CLEAR:
        description["made_with"] = extras.described()
    if extras.exposure_changes or scene.drawn is not None:
        description["exposure"] = [scene.exposure_at(index / files.fps) for index in range(frames)]
    if scene.drawn is not None:
        description["random"] = scene.drawn.described()
    _write_json(files.folder / "recording.json", description)
    if extras.third:
        third = {
            "name": "third",
            "folder": "views/third",
            "camera": _intrinsics(scene.camera),
            "left_to_view": scene.left_to("third").tolist(),
        }
        _write_json(
            files.folder / VIEWS_FILE,
            {"format": VIEWS_FORMAT, "version": VIEWS_VERSION, "depth_unit_mm": DEPTH_UNIT_MM, "views": [third]},
        )


def _intrinsics(camera: Camera) -> dict[str, Any]:
    return {
        "model": "pinhole",
        "width": camera.width_px,
        "height": camera.height_px,
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
    }


def _distortion(lens: RadialLens | None) -> dict[str, Any]:
    return {} if lens is None else {"distortion": lens.coefficients}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


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
    drawn: RandomScene | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a synthetic recording with exact ground truth into the folder `out` and return the folder.

    Equal arguments give equal bytes. The folder appears once complete. A folder written by an earlier call is replaced;
    any other non-empty folder is refused. `progress(done, frames)` is called after each frame. `drawn` (`draw_scene`)
    gives the scene random properties; its seed, `moving` and `stereo` replace `seed`, `camera` and `stereo`.

    Raises:
        InvalidSetting: if an argument is out of range, if flow is requested of a distorted lens, or `out` has foreign content, is a link or is the root of a
            disk.
    """
    if drawn is not None:
        seed, camera, stereo = drawn.seed, "moving" if drawn.moving else "fixed", drawn.stereo
        extras = replace(extras, scene=drawn.scene)
        if any(drawn.lens) and (extras.flow or stereo):
            raise InvalidSetting("a distorted lens has neither flow nor a second eye; draw a scene without distortion")
    check_arguments(frames, width_px, height_px, fps, seed, camera)
    target = Path(out)
    check_target(target)
    threads = threads_that_fit(width_px, height_px)
    target.parent.mkdir(parents=True, exist_ok=True)
    with PartialFolder(target) as partial:
        # The scene extends to the time of one more frame, because the flow of the last frame needs it.
        scene = SyntheticScene.from_seed(seed, width_px, height_px, frames / fps, camera == "moving", extras, drawn)
        _write_frames(FrameFiles(scene, partial.path, fps, seed, stereo, extras), frames, progress, threads)
        check_target(target)  # check again, because another process may have created files
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
    """Return the number of frames to render concurrently within the available memory, at most 8 or the number of CPUs.

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


def _write_frames(files: FrameFiles, frames: int, progress: Callable[[int, int], None] | None, threads: int) -> None:
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
        pool.shutdown(cancel_futures=True)  # after Ctrl-C or a write error, cancel frames that have not started
    files.finish(rows)
    describe(files, frames)
