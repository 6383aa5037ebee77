"""How what each pixel shows moves to the next frame, where a recording knows it; for evaluation alone.

    flow/000000.npy        float [H, W, 2]: what is at pixel p is at p + flow in the next frame
    scene_flow/000000.npy  float [H, W, 3]: how far that tissue moves in the world, in the recording's unit

Not finite where nothing is known, as on a tool. In the order of their names one for each frame; the last one's may be missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.arrays import ArrayHeader, read_array
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import resize_nearest
from gsplat_core.io.recordings.image_files import MAX_PIXELS, list_images
from gsplat_core.io.recordings.plain_files import UnreadableFile, all_stay_inside
from gsplat_core.scene.frames import Frame


@dataclass(frozen=True)
class TrueMotion:
    """From one frame to the next, at the size at which the frame was read; NaN where it is not known."""

    flow: NDArray[np.float32]
    """[H, W, 2], pixels."""
    scene_flow: NDArray[np.float32] | None
    """[H, W, 3], in the recording's unit and world; None where the recording has none."""


@dataclass(frozen=True)
class MotionFiles:
    """One file for each frame, in order."""

    flow: tuple[Path, ...]
    scene_flow: tuple[Path, ...]
    """As many, or none."""

    def of(self, frame: Frame) -> TrueMotion | None:
        """How the pixels of a frame move; None where no file says so. Raises RecordingInvalid for a file that cannot be read."""
        if frame.seq >= len(self.flow):
            return None
        flow = _read(self.flow[frame.seq], 2, frame)
        scale = np.array([frame.width_px / flow.shape[1], frame.height_px / flow.shape[0]], np.float32)
        scene_flow = _read(self.scene_flow[frame.seq], 3, frame) if self.scene_flow else None
        size = frame.width_px, frame.height_px
        return TrueMotion(
            resize_nearest(flow, *size) * scale, None if scene_flow is None else resize_nearest(scene_flow, *size)
        )


def open_motion(folder: Path, frame_count: int) -> MotionFiles | None:
    """The motion that the folder of a recording knows; None where it knows none. Raises RecordingInvalid for too few files."""
    flow = _files(folder, "flow", frame_count)
    return None if flow is None else MotionFiles(flow, _files(folder, "scene_flow", frame_count) or ())


def _files(folder: Path, name: str, frame_count: int) -> tuple[Path, ...] | None:
    inside = folder / name
    if not inside.is_dir():
        return None
    files = list_images(inside, frozenset({".npy"}))
    if len(files) < frame_count - 1 or not all_stay_inside(folder, files, Findings(strict=True)):
        raise RecordingInvalid(f"{inside}: {len(files)} files for {frame_count} frames. Give one .npy for each frame")
    return tuple(files[:frame_count])


def _read(path: Path, channels: int, frame: Frame) -> NDArray[np.float32]:
    def wrong(header: ArrayHeader) -> str | None:
        shape = header.shape
        if len(shape) != 3 or shape[2] != channels or not 0 < shape[0] * shape[1] <= MAX_PIXELS:
            return f"it is {list(shape)!s:.80} in place of [rows, columns, {channels}]"
        # Pictures that were read at another size are as wide for their height, up to rounding.
        unlike = abs(shape[0] * frame.width_px - shape[1] * frame.height_px) > max(shape[:2])
        return f"it is {list(shape)}, and the frame {frame.width_px}x{frame.height_px}" if unlike else None

    try:
        return read_array(path, wrong).astype(np.float32)
    except UnreadableFile as error:
        raise RecordingInvalid(f"{path}: {error}. Write it again in the size of the pictures, or remove it") from error
