"""Cameras of recordings: where K and the poses come from, and what is checked about them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.findings import Findings
from gsplat_core.scene.cameras import CAMERA_MODELS, Camera

DEFAULT_FOCAL_FACTOR = 0.9
"""Focal length in units of the longer image side where nothing is known: 58° across, as common endoscopes have."""
MAX_JSON_BYTES = 64 * 1024 * 1024
MAX_POSES = 10_000_000
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Calibration:
    """The camera of frame 0, and the pose of every frame where it is known."""

    camera: Camera
    poses: NDArray[np.float64] | None
    """World-to-camera [N, 4, 4]; None = not known (the camera of frame 0 stands for all)."""
    source: str


def default_calibration(root: Path, width_px: int, height_px: int, findings: Findings) -> Calibration:
    """A stated guess: pinhole, f = 0.9 of the longer side, principal point in the middle, poses unknown."""
    focal_px = DEFAULT_FOCAL_FACTOR * max(width_px, height_px)
    findings.warn(
        root,
        f"there is no calibration; a pinhole with f = {focal_px:.1f} px and no camera motion is assumed",
        "Add poses_bounds.npy or cameras.json; lengths have no scale until then",
    )
    return Calibration(Camera.from_focal(focal_px, width_px, height_px), None, "default")


def read_poses_bounds(
    path: Path, frame_count: int, width_px: int, height_px: int, findings: Findings
) -> Calibration | None:
    """LLFF's `poses_bounds.npy`: N x 17 = 3x5 [R | t | (H, W, f)] and near, far.

    The poses are camera-to-world in OpenCV axes, as the endoscopic data sets store them; LLFF's permutation of axes is
    not applied (gsplat's and Deform3DGS's loaders apply one to EndoNeRF's identity poses).
    """
    advice = "Save N x 17 float64 numbers: 3x5 [R | t | (H, W, f)], near, far for each frame"
    try:
        # A map, so that the shape is known before anything is read.
        table = np.load(path, mmap_mode="r", allow_pickle=False)
        shape = table.shape
        if len(shape) != 2 or shape[1] != 17 or table.dtype.kind not in "fiu" or shape[0] > MAX_POSES:
            findings.problem(path, f"it holds {table.dtype} {list(shape)} in place of [N, 17] numbers", advice)
            return None
        table = np.array(table, dtype=np.float64)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        findings.problem(path, f"it is not a plain NumPy array: {str(error).splitlines()[0]}", advice)
        return None
    if len(table) != frame_count:
        findings.problem(
            path, f"it has {len(table)} poses for {frame_count} frames", "Give one row for each frame, in frame order"
        )
        return None
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if bad.size:
        findings.problem(path, f"row {bad[0]} holds NaN or infinity ({bad.size} such rows)", advice)
        return None
    poses = table[:, :15].reshape(-1, 3, 5)
    announced_height, announced_width, focal_px = (float(value) for value in poses[0, :, 4])
    if (announced_width, announced_height) != (width_px, height_px):
        findings.problem(
            path,
            f"it is made for {announced_width:g}x{announced_height:g} images, these are {width_px}x{height_px}",
            "Scale H, W and f in it to the size of the images",
        )
        return None
    if np.any(poses[:, :, 4] != poses[0, :, 4]):
        findings.problem(path, "H, W or f differ between rows", "Give one size and focal length for all frames")
        return None
    if focal_px <= 0:
        findings.problem(path, f"the focal length is {focal_px:g} px", advice)
        return None
    world_to_camera = invert_poses(poses[:, :, :4], path, findings)
    if world_to_camera is None:
        return None
    camera = Camera.from_focal(focal_px, width_px, height_px, world_to_camera[0])
    return Calibration(camera, world_to_camera, path.name)


def read_json(path: Path, findings: Findings) -> dict[str, Any] | None:
    """A JSON object from a file of bounded size."""
    if not path.is_file():
        findings.problem(path, "it is not a plain file", "Give a JSON file")
        return None
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            findings.problem(path, f"{path.stat().st_size} bytes, more than the bound of {MAX_JSON_BYTES}", "Split it")
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        findings.problem(path, f"it is not JSON: {error}", "Write it again; the README of the recording format helps")
        return None
    if not isinstance(content, dict):
        findings.problem(path, f"it holds a {type(content).__name__} in place of an object", "Write {…} with keys")
        return None
    return content


def read_pinhole(path: Path, content: dict[str, Any], findings: Findings) -> Camera | None:
    """width, height, fx, fy, cx, cy and an optional model ("pinhole") from a JSON object."""
    values = {key: number(content.get(key)) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    wrong = [key for key, value in values.items() if value is None]
    if wrong:
        seen = ", ".join(f"{key} = {content.get(key)!r:.40}" if key in content else f"no {key}" for key in wrong)
        findings.problem(path, f"the camera is incomplete: {seen}", "Give width, height, fx, fy, cx and cy in pixels")
        return None
    width, height, fx, fy, cx, cy = (float(value) for value in values.values() if value is not None)
    model = content.get("model", "pinhole")
    if fx <= 0 or fy <= 0 or width < 1 or height < 1 or width % 1 or height % 1 or model not in CAMERA_MODELS:
        findings.problem(
            path,
            f"this cannot be a camera: {model!r:.40}, {width:g}x{height:g} px, fx = {fx:g}, fy = {fy:g}",
            f"Sizes are whole pixels, focal lengths are positive, the model is one of {', '.join(CAMERA_MODELS)}",
        )
        return None
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), int(width), int(height), model=model)


def invert_poses(camera_to_world: NDArray[np.float64], path: Path, findings: Findings) -> NDArray[np.float64] | None:
    """World-to-camera [N, 4, 4] from camera-to-world [N, 3, 4]; each must be a rotation and a translation."""
    rotation, translation = camera_to_world[:, :, :3], camera_to_world[:, :, 3]
    bounded = np.clip(rotation, -2, 2)  # keeps the products finite, and what it changes is no rotation either way
    skew = np.abs(bounded @ bounded.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    skew = np.maximum(skew, np.abs(np.linalg.det(bounded) - 1))
    if skew.max() > _ROTATION_TOLERANCE:
        index = int(np.argmax(skew > _ROTATION_TOLERANCE))
        findings.problem(
            path,
            f"the pose of frame {index} is not a rotation (off by {skew[index]:.3g})",
            "Give camera-to-world poses in OpenCV axes: orthonormal, determinant +1",
        )
        return None
    inverse = np.zeros((len(rotation), 4, 4))
    inverse[:, :3, :3] = rotation.transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("nji,nj->ni", rotation, translation)
    inverse[:, 3, 3] = 1
    inverse += 0.0  # no negative zeros
    inverse.setflags(write=False)
    return inverse


def number(value: object) -> float | None:
    """A finite number from JSON, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None
