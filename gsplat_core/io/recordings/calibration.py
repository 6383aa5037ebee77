"""Cameras of recordings: intrinsics, poses and stereo calibrations from data-set files, and correction of pictures by them.

`cameras.json` contains a pinhole K, and file and camera-to-world pose of each frame. `poses.npy` contains poses without
intrinsics. Stereo calibrations are read from the text, JSON, YAML, INI and MATLAB layouts listed in docs/recordings.md.

`Undistortion` removes the distortion of a lens. `Rectification` makes the axes of a calibrated stereo pair parallel and aligns
the rows of its pictures.
"""

from __future__ import annotations

import configparser
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.files import PartialFile
from gsplat_core.io.recordings.plain_files import (
    MAX_PIXELS,
    ArrayHeader,
    Findings,
    UnreadableFile,
    open_plain,
    read_array,
    stays_inside,
)
from gsplat_core.scene.cameras import CAMERA_MODELS, MAX_INTRINSICS_PX, MIN_FOCAL_PX, Camera

PIXEL_CENTRE = 0.5
"""Offset in pixels from OpenCV's coordinates, whose origin is the first pixel's centre, to those of `Camera`, whose origin is its
corner.
"""


@dataclass(frozen=True)
class StereoCalibration:
    """Stereo calibration in OpenCV's model and axes, with pixel centres at integers."""

    left_K: NDArray[np.float64]
    """Left camera matrix [3, 3]."""
    left_distortion: NDArray[np.float64]
    """Left distortion coefficients k1, k2, p1, p2, k3, ...; [4], [5] or [8]."""
    right_K: NDArray[np.float64]
    right_distortion: NDArray[np.float64]
    rotation: NDArray[np.float64]
    """Rotation from left to right camera coordinates [3, 3]."""
    translation_mm: NDArray[np.float64]
    """Translation from left to right camera coordinates in millimetres [3]: the left camera's
    origin seen from the right.
    """
    source: str
    """Name of the calibration file."""
    size: tuple[int, int] | None = None
    """(width, height) of the calibrated pictures, or None if not stated."""

    def wrong(self) -> str | None:
        """Return the reason why the calibration is impossible, as a sentence; None if it is possible."""
        sides = (("left", self.left_K, self.left_distortion), ("right", self.right_K, self.right_distortion))
        for eye, K, distortion in sides:
            if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 1 or np.abs(K).max() > 1e6:
                return f"the {eye} eye's intrinsics {K.tolist()} are impossible for a camera"
            if not np.isfinite(distortion).all() or np.abs(distortion).max(initial=0) > 1e3:
                return f"the {eye} eye's distortion {distortion.tolist()} is impossible for a lens"
        if np.abs(self.rotation @ self.rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(self.rotation) < 0:
            return f"the rotation between the eyes {self.rotation.tolist()} is not a rotation matrix"
        away = self.translation_mm
        if not np.isfinite(away).all() or not 1e-3 < np.linalg.norm(away) < 1e4:
            return f"the eyes are {np.linalg.norm(away):g} mm apart"
        if away[0] >= 0 or abs(away[0]) < np.abs(away[1:]).max():
            return f"the right eye is not to the right of the left one: the translation is {away.tolist()} mm; swap the eyes, or invert it"
        return None


class Rectification:
    """Rectification maps of both eyes for one picture size.

    Raises:
        InvalidInput: for an impossible calibration, or pictures of another size.
    """

    def __init__(self, calibration: StereoCalibration, width_px: int, height_px: int) -> None:
        why = calibration.wrong()
        if why is None and calibration.size not in (None, (width_px, height_px)):
            why = f"the calibration is for pictures of {calibration.size}, these are {(width_px, height_px)}"
        for eye, K in (("left", calibration.left_K), ("right", calibration.right_K)):
            if why is None and not (0 < K[0, 2] < width_px and 0 < K[1, 2] < height_px):
                why = f"the {eye} eye's principal point ({K[0, 2]:g}, {K[1, 2]:g}) is outside its picture of {width_px}x{height_px} px"
        if why is not None:
            raise InvalidInput(f"{calibration.source}: {why}")
        size = width_px, height_px
        left_turn, right_turn, left_P, right_P, *_ = cv2.stereoRectify(
            calibration.left_K, calibration.left_distortion, calibration.right_K, calibration.right_distortion, size,
            calibration.rotation, calibration.translation_mm.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1,
        )  # fmt: skip
        K = np.array(left_P[:3, :3], np.float64)
        self._left = cv2.initUndistortRectifyMap(
            calibration.left_K, calibration.left_distortion, left_turn, K, size, cv2.CV_32FC1
        )
        self._right = cv2.initUndistortRectifyMap(
            calibration.right_K, calibration.right_distortion, right_turn, K, size, cv2.CV_32FC1
        )
        K[:2, 2] += PIXEL_CENTRE
        self.turn = np.eye(4)
        """Transform from the original to the rectified left camera coordinates [4, 4]."""
        self.turn[:3, :3] = left_turn
        self.left_camera = Camera(K, width_px, height_px)
        """Rectified left camera, at the origin."""
        self.right_camera = self.left_camera.right_eye(float(-right_P[0, 3] / right_P[0, 0]))
        """Rectified right camera; its pose maps left to right camera coordinates."""
        self.inside = self.plane(np.ones((height_px, width_px), np.uint8))
        """Validity uint8 [H, W]: 1 where the rectified left picture has content."""

    def left(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify a left picture [H, W, 3]."""
        return np.asarray(cv2.remap(image, *self._left, cv2.INTER_CUBIC), np.uint8)

    def right(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify a right picture [H, W, 3]."""
        return np.asarray(cv2.remap(image, *self._right, cv2.INTER_CUBIC), np.uint8)

    def plane(self, plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify a mask [H, W] of the left picture with nearest-neighbour sampling; 0 outside."""
        return np.asarray(cv2.remap(plane, *self._left, cv2.INTER_NEAREST), np.uint8)


class Undistortion:
    """Maps from pictures of a distorted lens to those of the same camera without distortion.

    A pinhole lens becomes a pinhole, a fisheye lens an equidistant fisheye. The focal lengths and the principal point are
    chosen so that the picture's sides touch those of the distorted picture; parts of its corners are lost.

    Args:
        camera: distorted camera.
        coefficients: OpenCV's distortion coefficients: 4, 5, 8 or 12 of a pinhole, 4 of a fisheye lens.

    Raises:
        InvalidInput: for another number of coefficients, or a lens that does not see the middle of the picture's sides.
    """

    def __init__(self, camera: Camera, coefficients: Sequence[float]) -> None:
        # Imported only where it is needed, because importing torch takes long.
        import torch

        from gsplat_core.scene.distortion import Lens

        if camera.model == "ortho":
            raise InvalidInput("a camera with model ortho has no distortion")
        lens = Lens.from_opencv(coefficients, camera.model, dtype=torch.float64)
        ideal = Lens(camera.model)
        width, height = camera.width_px, camera.height_px
        K = torch.tensor(camera.K)[None]
        flat = torch.eye(3, dtype=torch.float64)[None]

        def undistorted(
            x: NDArray[np.float64], y: NDArray[np.float64]
        ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
            rays = lens.rays(torch.tensor(np.stack(np.broadcast_arrays(x, y), -1))[None], K)
            seen = ideal.project(rays.directions, flat)
            return seen.points[0].numpy(), (rays.valid & seen.valid)[0].numpy()

        along_x, along_y = np.linspace(0, width, 65), np.linspace(0, height, 65)
        limits = []
        for x, y, axis, inner in (
            (np.zeros(65), along_y, 0, np.max),
            (np.full(65, float(width)), along_y, 0, np.min),
            (along_x, np.zeros(65), 1, np.max),
            (along_x, np.full(65, float(height)), 1, np.min),
        ):
            points, known = undistorted(x, y)
            if not known[32]:
                raise InvalidInput(
                    f"the distortion {[float(each) for each in coefficients]} folds the picture of {width}x{height} px over"
                    " before its border"
                )
            limits.append(float(inner(points[known, axis])))
        left, right, top, bottom = limits
        if not (right - left > 1e-6 and bottom - top > 1e-6):
            raise InvalidInput(f"the distortion {[float(each) for each in coefficients]} leaves nothing of the picture")
        fx, fy = width / (right - left), height / (bottom - top)
        self.camera = replace(camera, K=np.array([[fx, 0, -left * fx], [0, fy, -top * fy], [0, 0, 1]]))
        """Camera of the undistorted pictures, at the pose of the distorted camera."""
        rows, columns = torch.meshgrid(
            torch.arange(height, dtype=torch.float64) + PIXEL_CENTRE,
            torch.arange(width, dtype=torch.float64) + PIXEL_CENTRE,
            indexing="ij",
        )
        rays = ideal.rays(torch.stack([columns, rows], -1).reshape(1, -1, 2), torch.tensor(self.camera.K)[None])
        source = lens.project(rays.directions, K)
        visible = (rays.valid & source.valid)[0, :, None]
        places = torch.where(visible, source.points[0] - PIXEL_CENTRE, -2.0)  # -2: outside, where `remap` gives 0
        across, down = places.reshape(height, width, 2).float().unbind(-1)
        self._maps = across.contiguous().numpy(), down.contiguous().numpy()
        inside = self.plane(np.ones((height, width), np.uint8))
        self.inside: NDArray[np.uint8] | None = None if inside.all() else inside
        """Mask uint8 [H, W]: 1 where the undistorted picture has content; None if everywhere."""

    def picture(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistort a picture [H, W, 3]."""
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_CUBIC), np.uint8)

    def plane(self, plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistort a mask [H, W] with nearest-neighbour sampling; 0 outside."""
        return np.asarray(cv2.remap(plane, *self._maps, cv2.INTER_NEAREST), np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Undistort z [H, W] with nearest-neighbour sampling; 0 (unknown) outside."""
        return np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), np.float32)


DEFAULT_FOCAL_FACTOR = 0.9
"""Default focal length in units of the longer image side: 58° field of view, usual in endoscopes."""
MAX_JSON_BYTES = 32 * 1024 * 1024
MAX_LENGTH = 1e9
"""Largest camera coordinate in the recording's unit. Keeps products within the range of float32."""
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Calibration:
    """Camera of frame 0, and the pose of every frame if known."""

    camera: Camera
    poses: NDArray[np.float64] | None
    """World-to-camera poses [N, 4, 4]. None if unknown; the camera of frame 0 is then used for all frames."""
    source: str
    assumed: bool = False
    """True if the intrinsics are a guess because the recording does not contain any."""
    distortion: tuple[float, ...] = ()
    """OpenCV's distortion coefficients of the pictures in the files; empty if they are not distorted."""


def default_calibration(
    root: Path, width_px: int, height_px: int, findings: Findings, *, poses_known: bool = False
) -> Calibration:
    """Return a default calibration with a warning: pinhole, f = 0.9 of the longer side, centred.

    Args:
        poses_known: True if the poses are read from another file, so that the warning does not mention them.
    """
    camera = default_camera(width_px, height_px)
    still = "" if poses_known else " and no camera motion"
    findings.warn(
        root,
        f"there is no calibration; a pinhole with f = {camera.K[0, 0]:.1f} px{still} is assumed",
        "Add cameras.json, poses_bounds.npy or a recording.json with the camera; lengths have no scale until then",
    )
    return Calibration(camera, None, "default", assumed=True)


def default_camera(width_px: int, height_px: int) -> Camera:
    """Return the default camera: pinhole, f = 0.9 of the longer side, centred principal point."""
    return Camera.from_focal(DEFAULT_FOCAL_FACTOR * max(width_px, height_px), width_px, height_px)


def read_poses_bounds(
    path: Path, frame_count: int, width_px: int, height_px: int, findings: Findings
) -> Calibration | None:
    """Read LLFF's `poses_bounds.npy`: N x 17 = 3x5 [R | t | (H, W, f)] and near, far; None after a problem.

    Poses are camera-to-world in OpenCV axes, as stored by the endoscopic data sets. LLFF's axis permutation is not
    applied (gsplat's and Deform3DGS's loaders apply one to EndoNeRF's identity poses).
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
    if not MIN_FOCAL_PX <= focal_px <= MAX_INTRINSICS_PX:
        findings.problem(
            path, f"the focal length is {focal_px:g} px", f"Give one from {MIN_FOCAL_PX:g} to {MAX_INTRINSICS_PX:g} px"
        )
        return None
    world_to_camera = invert_poses(poses[:, :, :4], path, findings)
    if world_to_camera is None:
        return None
    camera = Camera.from_focal(focal_px, width_px, height_px, world_to_camera[0])
    note_unusual_camera(path, camera, findings)
    return Calibration(camera, world_to_camera, path.name)


def read_json(path: Path, findings: Findings) -> dict[str, Any] | None:
    """Read a JSON object from a file of bounded size with unique keys; None after a problem."""
    try:
        with open_plain(path) as stream:
            data = stream.read(MAX_JSON_BYTES + 1)
        if len(data) > MAX_JSON_BYTES:
            findings.problem(path, f"it has more bytes than the bound of {MAX_JSON_BYTES}", "Split it")
            return None
        content = json.loads(data.decode("utf-8-sig"), object_pairs_hook=_each_key_once)
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
        raise ValueError(f"the key {twice!r:.60} occurs twice")
    return content


def read_pinhole(path: Path, content: dict[str, Any], findings: Findings) -> Camera | None:
    """Read width, height, fx, fy, cx, cy and an optional model ("pinhole") from a JSON object; None after a problem."""
    values = {key: number(content.get(key)) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    wrong = [key for key, value in values.items() if value is None]
    if wrong:
        seen = ", ".join(f"{key} = {content.get(key)!r:.40}" if key in content else f"no {key}" for key in wrong)
        findings.problem(path, f"the camera is incomplete: {seen}", "Give width, height, fx, fy, cx and cy in pixels")
        return None
    width, height, fx, fy, cx, cy = (float(value) for value in values.values() if value is not None)
    model = content.get("model", "pinhole")
    whole = all(side >= 1 and not side % 1 and side <= MAX_PIXELS for side in (width, height))
    bounded = all(MIN_FOCAL_PX <= value <= MAX_INTRINSICS_PX for value in (fx, fy))
    bounded = bounded and max(abs(cx), abs(cy)) <= MAX_INTRINSICS_PX
    if not whole or not bounded or model not in CAMERA_MODELS:
        findings.problem(
            path,
            f"this cannot be a camera: {model!r:.40}, {width:g}x{height:g} px, fx = {fx:g}, fy = {fy:g}, cx = {cx:g}, cy = {cy:g}",
            f"Sizes are whole pixels, focal lengths {MIN_FOCAL_PX:g} to {MAX_INTRINSICS_PX:g} px, cx and cy at most"
            f" {MAX_INTRINSICS_PX:g} px from 0, the model is one of {', '.join(CAMERA_MODELS)}",
        )
        return None
    camera = Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), int(width), int(height), model=model)
    note_unusual_camera(path, camera, findings)
    return camera


USUAL_VIEW_DEG = (5, 165)
"""Angles of view of a pinhole camera, across one side of the picture, outside which a note asks whether the camera is right."""


def note_unusual_camera(path: Path, camera: Camera, findings: Findings) -> None:
    """Warn of a principal point outside the picture, and of a pinhole camera's unusual angle of view."""
    (cx, cy), (fx, fy) = camera.K[:2, 2], (camera.K[0, 0], camera.K[1, 1])
    width, height = camera.width_px, camera.height_px
    if not (0 <= cx <= width and 0 <= cy <= height):
        findings.warn(
            path,
            f"the principal point ({cx:g}, {cy:g}) is outside the picture of {width}x{height} px",
            "If the picture is no cut-out of a larger one, give cx and cy in pixels of this picture",
        )
    if camera.model != "pinhole":
        return
    for side, size, focal, middle in (("width", width, fx, cx), ("height", height, fy, cy)):
        degrees = math.degrees(math.atan2(middle, focal) + math.atan2(size - middle, focal))
        if not USUAL_VIEW_DEG[0] <= degrees <= USUAL_VIEW_DEG[1]:
            findings.warn(
                path,
                f"the camera sees {degrees:.1f}° across the {side}: a focal length of {focal:g} px for {size} px",
                "Give focal lengths in pixels of these pictures",
            )


MAX_DISTORTION = 1e3
"""Largest absolute value of a distortion coefficient."""


def read_distortion(path: Path, content: dict[str, Any], findings: Findings) -> tuple[float, ...] | None:
    """Read the optional `distortion` of a camera's JSON object; () if there is none, None after a problem."""
    stated = content.get("distortion", [])
    values = [number(each) for each in stated] if isinstance(stated, list) and len(stated) <= 12 else [None]
    lengths = {"pinhole": (0, 4, 5, 8, 12), "fisheye": (0, 4)}.get(str(content.get("model", "pinhole")), (0,))
    known = tuple(each for each in values if each is not None and abs(each) <= MAX_DISTORTION)
    if len(known) != len(values) or len(known) not in lengths:
        findings.problem(
            path,
            f"the distortion is {stated!r:.120}",
            "Give OpenCV's coefficients: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]] of a pinhole, k1 to k4 of a"
            " fisheye, none of an ortho camera",
        )
        return None
    return known if any(known) else ()


def invert_poses(camera_to_world: NDArray[np.float64], path: Path, findings: Findings) -> NDArray[np.float64] | None:
    """Convert camera-to-world [N, 3, 4] to world-to-camera [N, 4, 4]. A pose that is not rigid or too far away is a
    problem, and the result is then None.
    """
    rotation, translation = camera_to_world[:, :, :3], camera_to_world[:, :, 3]
    if np.abs(translation).max() > MAX_LENGTH:
        index = int(np.argmax((np.abs(translation) > MAX_LENGTH).any(axis=1)))
        findings.problem(
            path, f"the camera of frame {index} is at {translation[index].tolist()}", f"Lengths go up to {MAX_LENGTH:g}"
        )
        return None
    # Clipping keeps the products finite. Clipped values are never part of a rotation.
    bounded = np.clip(rotation, -2, 2)
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
    """Return a number from JSON as a float; None if it is not finite or no number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


POSES_FILE = "poses.npy"
TRAILER = b"\nposes estimated by IntraSplat\n"
"""Bytes after the array that identify a file written by this program. NumPy ignores them."""
_POSES_ADVICE = "Save [N, 4, 4] numbers: for each frame the pose from camera to world, OpenCV axes"


def read_poses(path: Path, frame_count: int, findings: Findings) -> NDArray[np.float64] | None:
    """Read camera-to-world poses [N, 4, 4] and return their inverses, world to camera; None after a problem."""

    def wrong(header: ArrayHeader) -> str | None:
        if len(header.shape) != 3 or header.shape[1:] != (4, 4):
            return f"it holds {header.dtype} {list(header.shape)!s:.80} in place of [N, 4, 4] numbers"
        if header.shape[0] != frame_count:
            return f"it has {header.shape[0]} poses for {frame_count} frames"
        return None

    try:
        poses = read_array(path, wrong).astype(np.float64)
    except UnreadableFile as error:
        findings.problem(path, str(error), _POSES_ADVICE)
        return None
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)) | (poses[:, 3] != [0, 0, 0, 1]).any(axis=1))
    if bad.size:
        findings.problem(path, f"pose {bad[0]} is not one: {poses[bad[0]].tolist()!s:.200}", _POSES_ADVICE)
        return None
    return invert_poses(poses[:, :3], path, findings)


def write_poses(path: Path, world_to_camera: NDArray[np.float64], *, overwrite: bool = True) -> None:
    """Write the inverses of world-to-camera poses [N, 4, 4] to a file.

    Raises:
        OSError: if it cannot be written.
    """
    camera_to_world = np.linalg.inv(world_to_camera)
    camera_to_world[:, 3] = [0, 0, 0, 1]
    with PartialFile(path, overwrite=overwrite) as partial:
        np.save(partial.file, camera_to_world)
        partial.file.write(TRAILER)


MAX_BYTES = 1 << 20
Numbers = NDArray[np.float64]
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_STEREO_ADVICE = "docs/recordings.md has the layouts; correct the file, or remove it"


class _Unusable(Exception):
    """Exception with the reason why calibration values cannot be determined."""


def read_stereo_calibration(folder: Path, findings: Findings) -> tuple[StereoCalibration, tuple[Path, ...]] | None:
    """Read the stereo calibration in a recording's folder.

    Returns:
        The calibration and the files it was read from, or None if it is missing or has a problem.
    """
    for names, read in _LAYOUTS.items():
        paths = tuple(folder / name for name in names)
        if not paths[0].is_file():
            continue
        if not all(stays_inside(folder, path, findings) for path in paths):
            return None
        try:
            calibration = read(paths, findings)
        except (_Unusable, UnreadableFile, ValueError) as error:
            findings.problem(paths[0], f"it gives no calibration of two eyes: {error!s:.200}", _STEREO_ADVICE)
            return None
        if calibration is None:
            return None
        why = calibration.wrong()
        if why is not None:
            findings.problem(paths[0], why, _STEREO_ADVICE)
            return None
        return calibration, paths
    return None


@dataclass(frozen=True)
class RectifiedBy:
    """Rectification of a recording's stereo pair and the resulting left camera."""

    by: Rectification
    calibration: Calibration
    files: tuple[Path, ...]
    baseline_mm: float


def rectified_by_file(
    folder: Path, size: tuple[int, int], calibration: Calibration | None, findings: Findings
) -> RectifiedBy | None:
    """Build the rectification of a recording from the calibration file in its folder.

    Args:
        folder: folder of the recording.
        size: width and height in pixels.
        calibration: known calibration of the left camera; its poses are rotated to the rectified camera.
        findings: collector of problems and warnings.

    Returns:
        Rectification, or None if the folder has no usable stereo calibration.
    """
    read = read_stereo_calibration(folder, findings)
    if read is None:
        return None
    try:
        by = Rectification(read[0], *size)
    except InvalidInput as error:
        findings.problem(folder, str(error), _STEREO_ADVICE)
        return None
    poses = None if calibration is None or calibration.poses is None else by.turn @ calibration.poses
    camera = by.left_camera if poses is None else by.left_camera.with_pose(poses[0])
    left = Calibration(camera, poses, read[0].source)
    return RectifiedBy(by, left, read[1], -float(by.right_camera.world_to_camera[0, 3]))


def _text(path: Path) -> str:
    with open_plain(path) as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise _Unusable(f"it has more than {MAX_BYTES} bytes")
    return data.decode("utf-8", "replace")


def _shaped(numbers: Sequence[float] | Any, shape: tuple[int, ...], name: str) -> Numbers:
    found = np.array(numbers, dtype=np.float64).ravel()
    if found.size != int(np.prod(shape)):
        raise _Unusable(f"{name} has {found.size} numbers in place of {int(np.prod(shape))}")
    return found.reshape(shape)


def _distortion(numbers: Sequence[float] | Any, name: str) -> Numbers:
    found = np.array(numbers, dtype=np.float64).ravel()
    if found.size > 8:
        if np.any(found[8:]):
            raise _Unusable(f"{name} has {found.size} numbers; up to 8 are understood")
        found = found[:8]
    # Pad with zeros to the next number of distortion coefficients that OpenCV supports.
    return np.pad(found, (0, next(length for length in (4, 5, 8) if length >= found.size) - found.size))


def _numbers(text: str) -> list[float]:
    return [float(each) for each in _NUMBER.findall(text)]


def _matlab(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    text = "\n".join(line.partition("%")[0] for line in _text(paths[0]).splitlines())

    def value(name: str, *, optional: bool = False) -> list[float]:
        found = re.search(rf"\b{name}\s*=[^\[\];]*\[([^\]]*)\]", text)
        if found is None and not optional:
            raise _Unusable(f"there is no {name} = [...]")
        return _numbers(found[1]) if found else []

    def eye(side: str) -> tuple[Numbers, Numbers]:
        radial, tangential = value(f"radialDistortion{side}"), value(f"tangentialDistortion{side}", optional=True)
        first, rest = radial[:2], radial[2:3]
        return _shaped(value(f"IntrinsicMatrix{side}"), (3, 3), "IntrinsicMatrix"), _distortion(
            [*first, *(tangential or [0.0, 0.0]), *rest], "radialDistortion"
        )

    left, right = eye("Left"), eye("Right")
    # All matrices are OpenCV's. The MATLAB function transposes the intrinsics but not the rotation. The pictures agree
    # with the rotation as stored: rows of a SCARED recording are off by 0.40 px with it, and by 0.69 px with its
    # transpose.
    rotation = _shaped(value("rotationOfCameraMatrix"), (3, 3), "rotationOfCameraMatrix")
    translation = _shaped(value("translationOfCameraMatrix"), (3,), "translationOfCameraMatrix")
    return StereoCalibration(*left, *right, rotation, translation, paths[0].name)


def _scared_json(paths: Sequence[Path], findings: Findings) -> StereoCalibration | None:
    content = read_json(paths[0], findings)
    if content is None:
        return None
    inside = content.get("camera-calibration", content)
    if not isinstance(inside, dict):
        raise _Unusable("camera-calibration is no object")
    return _from_matrices({str(name): value for name, value in inside.items()}, paths[0].name)


_MATRIX = re.compile(r"(\w+)\s*:\s*!!opencv-matrix\s+rows:\s*\d+\s+cols:\s*\d+\s+dt:\s*\S+\s+data:\s*\[([^\]]*)\]")
_NAMES = {
    "left_K": ("M1", "K1", "KL", "cameraMatrix1"), "left_distortion": ("D1", "DL", "distCoeffs1"),
    "right_K": ("M2", "K2", "KR", "cameraMatrix2"), "right_distortion": ("D2", "DR", "distCoeffs2"),
    "rotation": ("R",), "translation_mm": ("T",),
}  # fmt: skip


def _opencv_yaml(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    found = {name: _numbers(data) for name, data in _MATRIX.findall(_text(paths[0]))}
    return _from_matrices(found, paths[0].name)


def _from_matrices(found: dict[str, Any], source: str) -> StereoCalibration:
    values: dict[str, Any] = {}
    for wanted, names in _NAMES.items():
        there = [name for name in names if name in found]
        if not there:
            raise _Unusable(f"there is no {' or '.join(names)}")
        numbers = found[there[0]]
        if wanted.endswith("distortion"):
            values[wanted] = _distortion(numbers, there[0])
        else:
            values[wanted] = _shaped(numbers, (3,) if wanted == "translation_mm" else (3, 3), there[0])
    return StereoCalibration(**values, source=source)


def _ini(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(_text(paths[0]))
        left, right = parser["StereoLeft"], parser["StereoRight"]

        def value(section: configparser.SectionProxy, name: str) -> float:
            return float(section[name])

        def eye(section: configparser.SectionProxy) -> tuple[Numbers, Numbers]:
            fx, fy, cx, cy = (value(section, name) for name in ("fc_x", "fc_y", "cc_x", "cc_y"))
            lens = [value(section, f"kc_{i}") for i in range(8) if f"kc_{i}" in section]
            return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), _distortion(lens, "kc")

        size = int(value(left, "res_x")), int(value(left, "res_y"))
        rotation = _shaped([value(right, f"R_{i}") for i in range(9)], (3, 3), "R")
        translation = _shaped([value(right, f"T_{i}") for i in range(3)], (3,), "T")
        return StereoCalibration(*eye(left), *eye(right), rotation, translation, paths[0].name, size)
    except (configparser.Error, KeyError) as error:
        raise _Unusable(f"there is no {error}") from error


def _hamlyn(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    between, left, right = (_numbers(_text(path)) for path in paths)
    pose = _shaped(between, (4, 4), "the transform from left to right")

    def eye(numbers: list[float], name: str) -> tuple[Numbers, Numbers]:
        return _shaped(numbers[:9], (3, 3), name), _distortion(numbers[9:], name)

    return StereoCalibration(
        *eye(left, "the left intrinsics"), *eye(right, "the right intrinsics"), pose[:3, :3], pose[:3, 3], paths[0].name
    )


_Reader = Callable[[Sequence[Path], Findings], StereoCalibration | None]
_LAYOUTS: dict[tuple[str, ...], _Reader] = {
    ("calibration.m",): _matlab,
    ("calibration.json",): _scared_json,
    ("StereoCalibration.ini",): _ini,
    ("calib.l2r.4x4", "calib.left.intrinsic.txt", "calib.right.intrinsic.txt"): _hamlyn,
    **{
        (f"{name}{suffix}",): _opencv_yaml
        for name in ("stereo_calibration", "endoscope_calibration")
        for suffix in (".yaml", ".yml")
    },
}
