"""Undistortion of pictures, and rectification of calibrated stereo pairs: parallel axes and aligned rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera

PIXEL_CENTRE = 0.5
"""Offset between OpenCV calibrations, which count from the first pixel's centre, and `Camera`,
which counts from its corner.
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
        # Imported lazily, as in `Camera`.
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
        """Camera without distortion, at the pose of the distorted one."""
        rows, columns = torch.meshgrid(
            torch.arange(height, dtype=torch.float64) + PIXEL_CENTRE,
            torch.arange(width, dtype=torch.float64) + PIXEL_CENTRE,
            indexing="ij",
        )
        rays = ideal.rays(torch.stack([columns, rows], -1).reshape(1, -1, 2), torch.tensor(self.camera.K)[None])
        source = lens.project(rays.directions, K)
        visible = (rays.valid & source.valid)[0, :, None]
        places = torch.where(visible, source.points[0] - PIXEL_CENTRE, -2.0)  # outside of the picture
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
