"""Per-frame files of a synthetic recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.extras import Extras
from gsplat_core.io.recordings.synthetic.renderer import Eye
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.io.recordings.synthetic.tissue import TISSUE_DISTANCE_MM
from gsplat_core.io.recordings.synthetic.truth import motion_to, seen_points

DEPTH_UNIT_MM = 0.01


@dataclass(frozen=True)
class FrameRow:
    """Values of one frame that are collected into files of the whole recording."""

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
        """Create the folders of the files."""
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
        pose_bounds = np.concatenate([row.ravel(), [left.depth.min(), left.depth.max()]])
        return FrameRow(pose_bounds, scene.track(time_s), seen_points(scene, left, time_s) if extras.tracks else None)

    def finish(self, rows: list[FrameRow]) -> None:
        """Write the files shared by all frames."""
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
        """Add noise to the depth as from a stereo matcher: it grows with the squared distance."""
        random = np.random.default_rng((self.seed, index, 3))
        spread = self.extras.depth_noise_mm * np.square(depth / np.float32(TISSUE_DISTANCE_MM))
        return np.maximum(depth + spread * random.standard_normal(depth.shape, np.float32), np.float32(DEPTH_UNIT_MM))


def save_image(path: Path, image: NDArray[np.uint8]) -> None:
    """An RGB image as PNG."""
    _save(path, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def save_depth(path: Path, depth: NDArray[Any]) -> None:
    """Depth in mm as 16 bit PNG in units of DEPTH_UNIT_MM."""
    _save(path, np.round(depth / np.float32(DEPTH_UNIT_MM)).astype(np.uint16))


def _name(index: int, what: str) -> str:
    return f"frame-{index:06d}.{what}.png"


def _save(path: Path, pixels: NDArray[Any]) -> None:
    encoded, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    assert encoded
    path.write_bytes(data.tobytes())
