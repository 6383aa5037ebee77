"""`poses.npy` beside a recording's images: where the camera was at each frame, apart from what the camera is like."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.files import PartialFile
from gsplat_core.io.recordings.arrays import ArrayHeader, read_array
from gsplat_core.io.recordings.calibration import invert_poses
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.plain_files import UnreadableFile

POSES_FILE = "poses.npy"
TRAILER = b"\nposes estimated by IntraSplat\n"
"""Bytes behind the array, by which a file of this program is recognised. NumPy ignores them."""
_ADVICE = "Save [N, 4, 4] numbers: for each frame the pose from camera to world, OpenCV axes"


def read_poses(path: Path, frame_count: int, findings: Findings) -> NDArray[np.float64] | None:
    """World-to-camera [N, 4, 4]; None where there is a problem."""

    def wrong(header: ArrayHeader) -> str | None:
        if len(header.shape) != 3 or header.shape[1:] != (4, 4):
            return f"it holds {header.dtype} {list(header.shape)!s:.80} in place of [N, 4, 4] numbers"
        if header.shape[0] != frame_count:
            return f"it has {header.shape[0]} poses for {frame_count} frames"
        return None

    try:
        poses = read_array(path, wrong).astype(np.float64)
    except UnreadableFile as error:
        findings.problem(path, str(error), _ADVICE)
        return None
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)) | (poses[:, 3] != [0, 0, 0, 1]).any(axis=1))
    if bad.size:
        findings.problem(path, f"pose {bad[0]} is not one: {poses[bad[0]].tolist()!s:.200}", _ADVICE)
        return None
    return invert_poses(poses[:, :3], path, findings)


def write_poses(path: Path, world_to_camera: NDArray[np.float64], *, overwrite: bool = True) -> None:
    """The file for poses [N, 4, 4]. Raises OSError where it cannot be written."""
    camera_to_world = np.linalg.inv(world_to_camera)
    camera_to_world[:, 3] = [0, 0, 0, 1]
    with PartialFile(path, overwrite=overwrite) as partial:
        np.save(partial.file, camera_to_world)
        partial.file.write(TRAILER)
