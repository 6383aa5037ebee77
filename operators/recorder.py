"""Records what passes, in a layout that `open_recording` reads back."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.sinks.display import write_png
from operators.storage import StorageReserve, storage_errors, write_whole


class RecorderOp(Operator):
    """Writes frames losslessly as they come, and the cameras and times when the stream ends.

        images/NNNNNN.png  images_right/NNNNNN.png
        masks/NNNNNN.png (255 = tool)
        depth/NNNNNN.npy (float32, mm)
        cameras.json (K, camera-to-world and presentation time of each frame, fps)

    Each file is whole or not there. Without `cameras.json`, after a crash, the folder still opens as an image sequence.

    Inputs:
        frame: `Frame`.

    Params:
        folder: created at start; must be new or empty, or made by us.
        camera: intrinsics of the frames.
        fps: nominal rate.
        reserve: room that must stay free on the disk.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        folder: Path,
        camera: Camera,
        fps: float,
        reserve: StorageReserve | None = None,
        **kwargs: Any,
    ) -> None:
        self.folder = folder
        self.camera = camera
        self.fps = fps
        self.reserve = reserve
        self._entries: list[dict[str, Any]] = []
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)

    def start(self) -> None:
        self._entries = []
        with storage_errors(self.folder):
            (self.folder / "images").mkdir(parents=True, exist_ok=True)

    def stop(self) -> None:
        if self._entries:
            write_whole(self.folder / "cameras.json", (json.dumps(self._cameras(), indent=1) + "\n").encode())

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        number = f"{len(self._entries):06d}"
        self._write_png("images", number, frame.image)
        if frame.right_image is not None:
            self._write_png("images_right", number, frame.right_image)
        if frame.mask is not None:
            self._write_png("masks", number, np.where(frame.mask == 0, np.uint8(255), np.uint8(0)))
        if frame.depth is not None:
            data = io.BytesIO()
            np.save(data, frame.depth.astype(np.float32), allow_pickle=False)
            write_whole(self._inside("depth") / f"{number}.npy", data.getvalue(), self.reserve)
        pose = self.camera.world_to_camera if frame.pose is None else frame.pose
        self._entries.append(
            {
                "file": f"images/{number}.png",
                "camera_to_world": np.linalg.inv(pose).tolist(),
                "seq": frame.seq,
                "pts_ns": frame.pts_ns,
            }
        )

    def _write_png(self, folder: str, number: str, image: Any) -> None:
        write_png(self._inside(folder) / f"{number}.png", image, self.reserve)

    def _inside(self, name: str) -> Path:
        folder = self.folder / name
        with storage_errors(folder):
            folder.mkdir(exist_ok=True)
        return folder

    def _cameras(self) -> dict[str, Any]:
        K = self.camera.K
        return {
            "width": self.camera.width_px,
            "height": self.camera.height_px,
            "fx": K[0, 0],
            "fy": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "model": self.camera.model,
            "fps": self.fps,
            "frames": self._entries,
        }
