"""Geometric evaluation of a finished model: pictures from arbitrary cameras, and the model's own
poses.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gsplat_core.evaluation.geometry import Geometry, evaluate_geometry
from gsplat_core.evaluation.protocols import Picture, PictureMaker
from gsplat_core.io.recordings.calibration import read_poses
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.truth import GroundTruth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model


class SeenFromAnywhere:
    """Renders a model from arbitrary cameras, with one renderer per picture size and projection."""

    def __init__(self, device: str = "cpu", renderer: str = "alpha") -> None:
        self._device, self._renderer = device, renderer
        self._makers: dict[Camera, PictureMaker] = {}

    def __call__(self, model: Model, camera: Camera, frame: Frame) -> Picture:
        """Render the model from `camera` at the frame's timestamp and exposure, in the colours
        visible from there.
        """
        lens = camera.with_pose(np.eye(4))
        maker = self._makers.get(lens)
        if maker is None:
            maker = self._makers[lens] = PictureMaker(lens, self._device, self._renderer)
        return maker(model.seen_from(camera, frame.time_s), frame.with_fields(pose=camera.world_to_camera))


def measure_geometry(
    frames: Iterable[Frame],
    frame_count: int,
    camera: Camera,
    model: Model,
    pictures: SeenFromAnywhere,
    truth: GroundTruth,
    poses: Path | None = None,
) -> Geometry:
    """Run `evaluate_geometry` with the poses that the model was made with.

    Args:
        frames: frames of the recording.
        frame_count: number of frames.
        camera: camera of the frames.
        model: the finished model.
        pictures: renderer.
        truth: ground truth of the recording.
        poses: file with the poses; None for those of the frames.

    Raises:
        RecordingInvalid: the file does not contain `frame_count` poses.
    """
    read = None if poses is None else read_poses(poses, frame_count, Findings(strict=True))
    own = lambda frame: frame.pose if read is None else read[frame.seq]
    shown = lambda view, frame: pictures(model, view, frame)
    return evaluate_geometry(frames, frame_count, camera, model, shown, truth, own)
