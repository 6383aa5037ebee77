"""Cameras of recordings: where K and the poses come from, and what is checked about them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.arrays import ArrayHeader, read_array
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.image_files import MAX_PIXELS
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain
from gsplat_core.scene.cameras import CAMERA_MODELS, Camera

DEFAULT_FOCAL_FACTOR = 0.9
"""Focal length in units of the longer image side where nothing is known: 58° across, as common endoscopes have."""
MAX_JSON_BYTES = 32 * 1024 * 1024
MAX_LENGTH = 1e9
"""Largest coordinate of a camera, in the recording's unit, and largest focal length in pixels: float32 keeps room to calculate."""
MIN_FOCAL_PX = 1e-3
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Calibration:
    """The camera of frame 0, and the pose of every frame where it is known."""

    camera: Camera
    poses: NDArray[np.float64] | None
    """World-to-camera [N, 4, 4]; None = not known (the camera of frame 0 stands for all)."""
    source: str
    assumed: bool = False
    """Whether nothing is known of the camera's intrinsics, and they are a guess."""


def default_calibration(
    root: Path, width_px: int, height_px: int, findings: Findings, *, poses_known: bool = False
) -> Calibration:
    """A stated guess: pinhole, f = 0.9 of the longer side, principal point in the middle. poses_known: from elsewhere; nothing is assumed of them."""
    camera = default_camera(width_px, height_px)
    still = "" if poses_known else " and no camera motion"
    findings.warn(
        root,
        f"there is no calibration; a pinhole with f = {camera.K[0, 0]:.1f} px{still} is assumed",
        "Add cameras.json, poses_bounds.npy or a recording.json with the camera; lengths have no scale until then",
    )
    return Calibration(camera, None, "default", assumed=True)


def default_camera(width_px: int, height_px: int) -> Camera:
    """The camera that is assumed where none is known: a pinhole, f = 0.9 of the longer side, principal point in the middle."""
    return Camera.from_focal(DEFAULT_FOCAL_FACTOR * max(width_px, height_px), width_px, height_px)


def read_poses_bounds(
    path: Path, frame_count: int, width_px: int, height_px: int, findings: Findings
) -> Calibration | None:
    """LLFF's `poses_bounds.npy`: N x 17 = 3x5 [R | t | (H, W, f)] and near, far.

    The poses are camera-to-world in OpenCV axes, as the endoscopic data sets store them; LLFF's permutation of axes is
    not applied (gsplat's and Deform3DGS's loaders apply one to EndoNeRF's identity poses).
    """
    advice = "Save N x 17 float64 numbers: 3x5 [R | t | (H, W, f)], near, far for each frame, in frame order"

    def wrong(header: ArrayHeader) -> str | None:
        if len(header.shape) != 2 or header.shape[1] != 17:
            return f"it holds {header.dtype} {list(header.shape)!s:.80} in place of [N, 17] numbers"
        if header.shape[0] != frame_count:
            return f"it has {header.shape[0]} poses for {frame_count} frames"
        return None

    try:
        table = read_array(path, wrong).astype(np.float64)
    except UnreadableFile as error:
        findings.problem(path, str(error), advice)
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
    if not MIN_FOCAL_PX <= focal_px <= MAX_LENGTH:
        findings.problem(
            path, f"the focal length is {focal_px:g} px", f"Give one from {MIN_FOCAL_PX:g} to {MAX_LENGTH:g} px"
        )
        return None
    world_to_camera = invert_poses(poses[:, :, :4], path, findings)
    if world_to_camera is None:
        return None
    camera = Camera.from_focal(focal_px, width_px, height_px, world_to_camera[0])
    return Calibration(camera, world_to_camera, path.name)


def read_json(path: Path, findings: Findings) -> dict[str, Any] | None:
    """A JSON object from a file of bounded size, each key once."""
    try:
        with open_plain(path) as stream:
            data = stream.read(MAX_JSON_BYTES + 1)
        if len(data) > MAX_JSON_BYTES:
            findings.problem(path, f"it has more bytes than the bound of {MAX_JSON_BYTES}", "Split it")
            return None
        content = json.loads(data.decode("utf-8"), object_pairs_hook=_each_key_once)
    except UnreadableFile as error:
        findings.problem(path, str(error), "Give a JSON file")
        return None
    except (OSError, ValueError, RecursionError) as error:
        findings.problem(
            path, f"it is not JSON: {error!s:.200}", "Write it again; docs/recordings.md describes the format"
        )
        return None
    if not isinstance(content, dict):
        findings.problem(path, f"it holds a {type(content).__name__} in place of an object", "Write {…} with keys")
        return None
    return content


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        seen: set[str] = set()
        for twice, _ in pairs:
            if twice in seen:
                break
            seen.add(twice)
        raise ValueError(f"the key {twice!r:.60} is there twice")
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
    whole = all(side >= 1 and not side % 1 and side <= MAX_PIXELS for side in (width, height))
    bounded = all(MIN_FOCAL_PX <= value <= MAX_LENGTH for value in (fx, fy)) and max(abs(cx), abs(cy)) <= MAX_LENGTH
    if not whole or not bounded or model not in CAMERA_MODELS:
        findings.problem(
            path,
            f"this cannot be a camera: {model!r:.40}, {width:g}x{height:g} px, fx = {fx:g}, fy = {fy:g}, cx = {cx:g}, cy = {cy:g}",
            f"Sizes are whole pixels, focal lengths {MIN_FOCAL_PX:g} to {MAX_LENGTH:g} px, the model is one of "
            f"{', '.join(CAMERA_MODELS)}",
        )
        return None
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), int(width), int(height), model=model)


def invert_poses(camera_to_world: NDArray[np.float64], path: Path, findings: Findings) -> NDArray[np.float64] | None:
    """World-to-camera [N, 4, 4] from camera-to-world [N, 3, 4]; each must be a rotation and a translation."""
    rotation, translation = camera_to_world[:, :, :3], camera_to_world[:, :, 3]
    if np.abs(translation).max() > MAX_LENGTH:
        index = int(np.argmax((np.abs(translation) > MAX_LENGTH).any(axis=1)))
        findings.problem(
            path, f"the camera of frame {index} is at {translation[index].tolist()}", f"Lengths go up to {MAX_LENGTH:g}"
        )
        return None
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
