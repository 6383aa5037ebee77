"""Synthetic recordings rendered into memory, and their cache on disk.

    CACHE/                       mode 0700
      DIGEST.safetensors         image [N, H, W, 3], depth, mask, pose, right_image of stereo pairs

The digest covers the arguments and the renderer's source, so a changed renderer invalidates the
cache. The least recently used files are evicted when the cache exceeds its size limit.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import stat
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from gsplat_core.io.files import PartialFile
from gsplat_core.io.recordings.calibration import DEFAULT_FOCAL_FACTOR
from gsplat_core.io.recordings.synthetic.scene import BASELINE_MM, CLEAR, Extras, SyntheticScene
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
    """Generator options. Those that write further files or add depth noise have no effect."""


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


log = logging.getLogger(__name__)
MOST_BYTES = 2**30
SUFFIX = ".safetensors"
PLANES = ("image", "right_image", "depth", "mask", "pose")


def default_folder() -> Path:
    """Return this user's cache folder (`XDG_CACHE_HOME`, default `~/.cache`)."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path("~/.cache").expanduser()) / "intrasplat" / "synthetic"


def kept_recording(
    settings: RenderSettings,
    folder: Path | None = None,
    *,
    most_bytes: int = MOST_BYTES,
    progress: Callable[[int, int], None] | None = None,
) -> RenderedRecording:
    """Return `render_recording(settings)`, read from the cache if an earlier call has stored it.

    An unusable cache folder is not an error; the recording is rendered instead.

    Args:
        settings: parameters of the recording.
        folder: cache folder; None selects `default_folder()`.
        most_bytes: size limit of the cache in bytes.
        progress: callback that receives the numbers of rendered and of all frames.

    Raises:
        InvalidSetting: as raised by `render_recording`.
    """
    folder = folder or default_folder()
    path = folder / f"{_digest(settings)}{SUFFIX}"
    if _is_own(folder) and (found := _read(path, settings)) is not None:
        with contextlib.suppress(OSError):
            os.utime(path)  # mark the file as recently used
        return found
    recording = render_recording(settings, progress)
    try:
        _keep(recording, path, most_bytes)
    except OSError as error:
        log.info("the rendered frames are not kept: %s", error)
    return recording


def _is_own(folder: Path) -> bool:
    """Return True if `folder` belongs to this user and no other user can write to it."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022


def _read(path: Path, settings: RenderSettings) -> RenderedRecording | None:
    """Read a cached recording; None if it is missing or damaged. Damaged files are removed."""
    try:
        planes = load_file(path)
        frames = [_frame(planes, index, settings.fps) for index in range(settings.frames)]
        wanted = (settings.height_px, settings.width_px, 3)
        if frames[0].image.shape != wanted or (frames[0].right_image is None) == settings.stereo:
            raise ValueError(f"its pictures are {frames[0].image.shape}")
    except FileNotFoundError:
        return None
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as error:
        log.warning("%s cannot be read (%s); it is rendered again", path, error)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    return RenderedRecording(frames, settings)


def _frame(planes: dict[str, NDArray], index: int, fps: float) -> Frame:
    arrays = {name: planes[name][index] for name in PLANES if name in planes}
    return Frame(seq=index, pts_ns=round(index / fps * 1e9), **arrays)


def _keep(recording: RenderedRecording, path: Path, most_bytes: int) -> None:
    """Write a recording to the cache unless it exceeds the limit by itself, evicting old files.

    Raises:
        OSError: if the folder is not writable, or other users can write to it.
    """
    frames = list(recording)
    named = {name: [getattr(frame, name) for frame in frames] for name in PLANES}
    planes = {name: np.stack(arrays) for name, arrays in named.items() if arrays[0] is not None}
    size = sum(plane.nbytes for plane in planes.values())
    if size > most_bytes:
        return
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_own(path.parent):
        raise OSError(f"{path.parent} may be written to by others")
    _make_room(path.parent, most_bytes - size)
    with PartialFile(path) as partial:
        partial.file.write(save(planes))


def _make_room(folder: Path, most_bytes: int) -> None:
    """Delete the least recently used files until the rest fits into `most_bytes`; other processes may do so concurrently."""
    files = []
    for path in folder.glob(f"*{SUFFIX}"):
        with contextlib.suppress(FileNotFoundError):
            found = path.stat()
            files.append((found.st_mtime_ns, found.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= most_bytes:
            return
        path.unlink(missing_ok=True)
        total -= size


def _digest(settings: RenderSettings) -> str:
    said = repr([(field.name, getattr(settings, field.name)) for field in fields(settings)])
    return hashlib.sha256(f"{_renderer()} {said}".encode()).hexdigest()[:40]


@cache
def _renderer() -> str:
    """Return a digest of the renderer's source code."""
    whole = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        whole.update(path.read_bytes())
    return whole.hexdigest()
