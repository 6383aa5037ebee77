"""Observations of a stereo scope's right eye: camera pose, colour matching and tissue mask."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.choices import Eyes
from gsplat_core.endoscope.highlights import HighlightFinder
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.eye_colours import EyeColours
from gsplat_core.training.initialisation import believed_depth, unprojected
from gsplat_core.training.observations import Observation, RightEye, scene_colours
from gsplat_core.training.unseen import pixels_of
from gsplat_core.transfers import tensor_of

CELL_PX = 4
"""Side of the cells in which tools are mapped to the right picture, in pixels."""
TYPICAL_OF = 500
"""Number of cells (up to twice as many) whose median is the typical disparity."""
NEAREST, FARTHEST = 2.0, 0.75
"""Range of a tool's disparity without depth, as multiples of the typical one; tools are nearer than
tissue.
"""


class PreparedPicture(NamedTuple):
    """Right picture in the left one's colours, on the host."""

    image: NDArray[np.uint8]
    """RGB [H, W, 3]."""
    mask: NDArray[np.uint8]
    """Mask [H, W]; 1 = tissue."""
    steady: NDArray[np.uint8] | None
    """Mask [H, W] for rehearsal; 0 = ignored. None for no restriction."""


class BothEyes:
    """Observations of one stream: the left eye's picture and, if requested and calibrated, the
    right one's.
    """

    def __init__(self, eyes: Eyes, device: torch.device | str = "cpu") -> None:
        self._with_right, self._device = eyes == "both", device
        self._highlights = HighlightFinder()
        self._preparer: ThreadPoolExecutor | None = None
        """Thread that prepares right pictures in order, for GPU training only."""
        if self._with_right and torch.device(device).type == "cuda":
            self._preparer = ThreadPoolExecutor(1, thread_name_prefix="right eye")
        self.trained: Eyes = "left"
        """Eyes with trained pictures so far."""
        self.forget()

    def forget(self) -> None:
        """Reset for another stream."""
        self._colours = EyeColours()

    def observation(self, frame: Frame, camera: Camera, *, trains: bool = True) -> Observation:
        """Create the observation of a frame, including the right eye unless nothing is trained."""
        left = Observation.of(frame, camera, self._device)
        return self.beside(left, frame) if self._with_right and trains else left

    def beside(self, left: Observation, frame: Frame) -> Observation:
        """Add the right eye's observation to the left one of `frame`, if the frame has a calibrated
        right picture.

        Raises:
            InvalidInput: if the camera models of the eyes differ.
        """
        right = frame.right_camera
        if frame.right_image is None or right is None:
            return left
        if right.model != left.camera.model:
            raise InvalidInput(
                f"frame {frame.seq}: the right camera is {right.model}, the left one {left.camera.model}; both must be the same for training"
            )
        self.trained = "both"
        prepared = self._prepared(frame, left.camera, right)
        return replace(left, right_eye=RightEye(lambda: self._on_device(prepared(), left, right)))

    def _prepared(self, frame: Frame, camera: Camera, right: Camera) -> Callable[[], PreparedPicture]:
        """Return a function that yields the prepared right picture. For a GPU the preparation
        starts at once in another thread.
        """
        colours = self._colours  # of this stream, even if another one starts meanwhile
        if self._preparer is None:
            return lambda: self._prepare(frame, camera, right, colours)
        return self._preparer.submit(self._prepare, frame, camera, right, colours).result

    def _prepare(self, frame: Frame, camera: Camera, right: Camera, colours: EyeColours) -> PreparedPicture:
        image = scene_colours(colours.corrected(frame), frame.exposure)
        mask = right_tissue(frame, camera, right, (colours.shift or 0.0) * frame.width_px)
        if frame.loss_mask is not None:
            mask = mask & frame.loss_mask
        steady = None if frame.rehearsal_mask is None else self._highlights.without(image)
        return PreparedPicture(image, mask, steady)

    def _on_device(self, picture: PreparedPicture, left: Observation, right: Camera) -> Observation:
        image, mask, steady = picture
        return Observation(
            seq=left.seq,
            time_s=left.time_s,
            camera=right.with_pose(right.world_to_camera @ left.camera.world_to_camera),
            image=tensor_of(image, self._device),
            mask=tensor_of(mask, self._device),
            depth=None,
            of_right=True,
            rehearsal_mask=None if steady is None else tensor_of(steady, self._device),
        )


def for_eyes(gaussians: Gaussians, observation: Observation) -> Gaussians:
    """Add right-eye colours to Gaussians if the right eye is trained on."""
    return gaussians.with_right(observation.right_eye is not None)


def right_tissue(frame: Frame, camera: Camera, right: Camera, shift_px: float) -> NDArray[np.uint8]:
    """Return the tissue mask of the right picture, uint8 [H, W], from the left eye's tool mask.

    Tool pixels are mapped by their depth. Without depth they cover the range from `FARTHEST` to
    `NEAREST` times the typical disparity, which is that of the known depth or else `shift_px`.
    Tools visible only to the right eye are not masked.

    Args:
        frame: stereo frame.
        camera: left camera.
        right: right camera.
        shift_px: overall shift of the right picture to the left in pixels.
    """
    height, width = frame.image.shape[:2]
    if frame.mask is None or cv2.countNonZero(frame.mask) == frame.mask.size:
        return np.ones((height, width), np.uint8)
    rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
    size = columns, rows
    bare = cv2.threshold(frame.mask, 0, 255, cv2.THRESH_BINARY_INV)[1]
    tool = cv2.resize(bare, size, interpolation=cv2.INTER_AREA) > 0
    if frame.depth is None:
        depth = np.zeros((rows, columns), np.float32)
    else:
        depth = np.asarray(cv2.resize(believed_depth(frame), size, interpolation=cv2.INTER_NEAREST), np.float32)
    known = np.isfinite(depth) & (depth > 0)
    hidden = np.zeros((rows, columns), np.uint8)
    if known.any():
        centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1) + 0.5
        centres *= (width / columns, height / rows)
        own = replace(camera, world_to_camera=np.eye(4))
        some = np.flatnonzero(known)[:: max(1, int(np.count_nonzero(known)) // TYPICAL_OF)]
        places, typical, tools = centres.reshape(-1, 2), depth.ravel(), tool & known
        shift_px = float(np.median((places[some] - _seen_by_right(places[some], typical[some], own, right))[:, 0]))
        of_tools = _seen_by_right(centres[tools], depth[tools], own, right)
        of_tools = np.floor(of_tools * (columns / width, rows / height)).astype(np.int64)
        inside = ((of_tools >= 0) & (of_tools < (columns, rows))).all(1)
        hidden[of_tools[inside, 1], of_tools[inside, 0]] = 1
    hidden |= _smeared(
        tool & ~known, sorted((FARTHEST * shift_px * columns / width, NEAREST * shift_px * columns / width))
    )
    # Dilate by a cell, since narrow parts may fall between cells and masks end slightly early.
    hidden = np.asarray(cv2.dilate(hidden, np.ones((3, 3), np.uint8)), np.uint8)
    return np.asarray(cv2.resize(1 - hidden, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def _seen_by_right(pixels: NDArray[np.float64], z: NDArray, camera: Camera, right: Camera) -> NDArray[np.float64]:
    """Project points seen by the left eye at `pixels` [N, 2] and depth `z` [N] to the right eye."""
    points, _ = unprojected(pixels, z.astype(np.float64), camera)
    return np.asarray(pixels_of(torch.from_numpy(points), right)[0].numpy())


def _smeared(cells: NDArray[np.bool_], shifts: list[float]) -> NDArray[np.uint8]:
    """Return cells [rows, columns] shifted to the left by all values between two shifts."""
    found = np.zeros(cells.shape, np.uint8)
    if not cells.any():
        return found
    columns = cells.shape[1]
    for shift in range(int(np.floor(shifts[0])), int(np.ceil(shifts[1])) + 1):
        if abs(shift) >= columns:
            continue
        if shift >= 0:
            found[:, : columns - shift] |= cells[:, shift:]
        else:
            found[:, -shift:] |= cells[:, :shift]
    return found
