"""Observations of a stereo scope's right eye: camera pose, colour matching and tissue mask.

Sensors and light paths differ slightly between the eyes, and the difference changes slowly. Without correction the
two pictures would pull every colour back and forth. A gain and an offset per channel are therefore applied to the
right picture.
"""

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
from gsplat_core.depth.maps import believed_depth
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.growth.initialisation import unprojected
from gsplat_core.training.growth.unseen import pixels_of
from gsplat_core.training.observations import Observation, RightEye
from gsplat_core.transfers import tensor_of

LOOKED_AT_PX = 80
"""Width in pixels of the reduced pictures that are compared."""
LOOK_EVERY = 10
"""Number of frames between two comparisons of the eyes' colours."""
FOLLOWS = 0.2
"""Weight of a new comparison of the eyes' colours in the moving average."""
SHIFT_STAYS = 4
"""Search range around the last shift, in pixels of the compared pictures."""
LEAST_OVERLAP = 0.4
"""Smallest overlap of the two eyes' views at which a shift is considered, as a share of the width."""
QUANTILES = (10, 50, 90)
"""Compared quantiles in per cent. Highlights and shadows, which differ between the eyes, are outside their range."""
FLAT_LEVELS = 8.0
"""Difference of the outer quantiles in levels below which no gain is estimated for a channel."""
MOST_GAIN = 2.0
NOISE_LEVELS = 1.5
"""Largest change of a quantile in levels that counts as estimation noise; such a correction is not applied."""


class EyeColours:
    """Conversion of one stream's right pictures to the colours of its left ones."""

    def __init__(self) -> None:
        self._gain, self._offset = np.ones(3), np.zeros(3)
        self._line: NDArray[np.float32] | None = None
        """Gains and offsets as a matrix [3, 4], or None for no correction."""
        self._frames = 0
        self.shift: float | None = None
        """Shift of the right picture to the left, as a share of its width, at the last comparison; None before the
        first one.
        """

    def corrected(self, frame: Frame) -> NDArray[np.uint8]:
        """Return the right picture of a stereo frame in the colours of the left one."""
        assert frame.right_image is not None
        if self._frames % LOOK_EVERY == 0:
            self._look(frame.image, frame.right_image, frame.mask)
        self._frames += 1
        if self._line is None:
            return frame.right_image
        return np.asarray(cv2.transform(frame.right_image, self._line), np.uint8)

    def _look(self, left: NDArray[np.uint8], right: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
        first, second = _small(left), _small(right)
        size = first.shape[1], first.shape[0]
        tissue = (
            np.ones(size[::-1], bool) if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0
        )
        before = None if self.shift is None else round(self.shift * size[0])
        shift = best_shift(first.mean(-1), second.mean(-1), before)
        self.shift = shift / size[0]
        ours, theirs = overlap(first, second, shift)
        kept = overlap(tissue, tissue, shift)[0]
        if np.count_nonzero(kept) < 16:
            return
        gain, offset, off = line_between(ours[kept], theirs[kept])
        share = 1.0 if self._frames == 0 else FOLLOWS
        self._gain += share * (gain - self._gain)
        self._offset += share * (offset - self._offset)
        off = np.abs(self._gain * off + self._offset - off).max()
        line = np.column_stack([np.diag(self._gain), self._offset]).astype(np.float32)
        self._line = line if off > NOISE_LEVELS else None


def typical_shift(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> float:
    """Return the overall shift of the right picture to the left, as a share of its width, accurate to a few pixels."""
    first, second = _small(left), _small(right)
    return best_shift(first.mean(-1), second.mean(-1)) / first.shape[1]


def _small(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    height, width = picture.shape[:2]
    size = min(LOOKED_AT_PX, width), max(1, round(height * min(1.0, LOOKED_AT_PX / width)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def best_shift(left: NDArray[np.float32], right: NDArray[np.float32], before: int | None = None) -> int:
    """Return the shift of the right picture [h, w] to the left in pixels that maximises the correlation.

    With `before`, a recent shift, only its neighbourhood is searched unless the maximum is at its end.
    """
    most = int((1 - LEAST_OVERLAP) * left.shape[1])
    matches = _correlations(left, right, most)
    if before is not None:
        first, last = max(-most, before - SHIFT_STAYS), min(most, before + SHIFT_STAYS)
        best = first + int(np.argmax(matches[first + most : last + most + 1]))
        if first < best < last:
            return best
    return int(np.argmax(matches)) - most


def _correlations(left: NDArray[np.float32], right: NDArray[np.float32], most: int) -> NDArray[np.float64]:
    """Return the correlation coefficient of the overlap for each shift of the right picture to the left, from -`most`
    to `most` pixels, [2 most + 1].
    """
    a, b = left.astype(np.float64), right.astype(np.float64)
    height, width = a.shape
    shifts = np.arange(-most, most + 1)
    # The matrix contains the products of all column pairs. The overlapping columns of one shift are on one diagonal.
    products = a.T @ b
    together = np.array([np.trace(products, offset=-shift) for shift in shifts])
    begins = np.maximum(shifts, 0), np.maximum(-shifts, 0)
    count = height * (width - np.abs(shifts))
    (sum_a, squares_a), (sum_b, squares_b) = (
        (_sums(picture, begin, width - np.abs(shifts)), _sums(picture * picture, begin, width - np.abs(shifts)))
        for picture, begin in zip((a, b), begins, strict=True)
    )
    spread = (squares_a - sum_a**2 / count) * (squares_b - sum_b**2 / count)
    return np.asarray((together - sum_a * sum_b / count) / np.sqrt(np.maximum(spread, 0) + 1e-6))


def _sums(picture: NDArray[np.float64], begins: NDArray, widths: NDArray) -> NDArray[np.float64]:
    """Return sums over `widths` columns of a picture, starting at `begins`."""
    upto = np.concatenate([[0.0], picture.sum(0).cumsum()])
    return np.asarray(upto[begins + widths] - upto[begins])


def overlap(left: NDArray, right: NDArray, shift: int) -> tuple[NDArray, NDArray]:
    """Return the parts of both pictures that overlap if the right one is shifted `shift` pixels to the left."""
    width = left.shape[1]
    if shift >= 0:
        return left[:, shift:], right[:, : width - shift]
    return left[:, :shift], right[:, -shift:]


def line_between(left: NDArray[np.float32], right: NDArray[np.float32]) -> tuple[NDArray, NDArray, NDArray]:
    """Return gain and offset [3] that map the quantiles of the right colours [N, 3] to those of the left ones, and the
    right quantiles [3, 3].

    Quantiles need no pixel correspondence. Unlike a least-squares slope, their ratio is not biased by noise.
    """
    ours, theirs = (np.percentile(colours, QUANTILES, axis=0) for colours in (left, right))
    spread_left, spread_right = ours[2] - ours[0], theirs[2] - theirs[0]
    says_something = (spread_left >= FLAT_LEVELS) & (spread_right >= FLAT_LEVELS)
    gain = np.where(says_something, spread_left / np.maximum(spread_right, 1e-6), 1.0).clip(1 / MOST_GAIN, MOST_GAIN)
    return gain, ours[1] - gain * theirs[1], theirs


CELL_PX = 4
"""Side of the cells in which tools are mapped to the right picture, in pixels."""
TYPICAL_OF = 500
"""Number of disparities (up to twice as many) whose median is the typical disparity."""
NEAREST, FARTHEST = 2.0, 0.75
"""Range of a tool's disparity without depth, as multiples of the typical one; tools are nearer than tissue."""


class PreparedPicture(NamedTuple):
    """Right picture in the left one's colours, on the host."""

    image: NDArray[np.uint8]
    """Right picture in the left picture's colours, RGB [H, W, 3]."""
    mask: NDArray[np.uint8]
    """Mask [H, W]; 1 = tissue."""


class BothEyes:
    """Converter of a stream's frames to training observations: one of the left eye and, if requested and
    calibrated, one of the right eye.
    """

    def __init__(self, eyes: Eyes, device: torch.device | str = "cpu") -> None:
        self._with_right, self._device = eyes == "both", device
        self._preparer: ThreadPoolExecutor | None = None
        """Thread that prepares right pictures in order, for GPU training only."""
        if self._with_right and torch.device(device).type == "cuda":
            self._preparer = ThreadPoolExecutor(1, thread_name_prefix="right eye")
        self.trained: Eyes = "left"
        """Eyes with trained pictures so far."""
        self.forget()

    def forget(self) -> None:
        """Discard the colour matching of the right eye, at the start of a stream."""
        self._colours = EyeColours()

    def observation(self, frame: Frame, camera: Camera, *, trains: bool = True) -> Observation:
        """Create the observation of a frame, including the right eye unless nothing is trained."""
        left = Observation.of(frame, camera, self._device)
        return self.beside(left, frame) if self._with_right and trains else left

    def beside(self, left: Observation, frame: Frame) -> Observation:
        """Add the right eye's observation to the left one of `frame`, if the frame has a calibrated right picture.

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
        colours = self._colours  # kept for this frame, because `forget` may replace it before the thread runs
        if self._preparer is None:
            return lambda: self._prepare(frame, camera, right, colours)
        return self._preparer.submit(self._prepare, frame, camera, right, colours).result

    def _prepare(self, frame: Frame, camera: Camera, right: Camera, colours: EyeColours) -> PreparedPicture:
        image = colours.corrected(frame)
        mask = right_tissue(frame, camera, right, (colours.shift or 0.0) * frame.width_px)
        if frame.loss_mask is not None:
            mask = mask & frame.loss_mask
        return PreparedPicture(image, mask)

    def _on_device(self, picture: PreparedPicture, left: Observation, right: Camera) -> Observation:
        return Observation(
            seq=left.seq,
            time_s=left.time_s,
            camera=right.with_pose(right.world_to_camera @ left.camera.world_to_camera),
            image=tensor_of(picture.image, self._device),
            mask=tensor_of(picture.mask, self._device),
            depth=None,
            of_right=True,
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
    # Dilate by a cell, because narrow parts of a tool may fall between cells and masks end slightly early.
    hidden = np.asarray(cv2.dilate(hidden, np.ones((3, 3), np.uint8)), np.uint8)
    return np.asarray(cv2.resize(1 - hidden, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def _seen_by_right(pixels: NDArray[np.float64], z: NDArray, camera: Camera, right: Camera) -> NDArray[np.float64]:
    """Project points seen by the left eye at `pixels` [N, 2] and depth `z` [N] to the right eye."""
    points, _ = unprojected(pixels, z.astype(np.float64), camera)
    return np.asarray(pixels_of(torch.from_numpy(points), right)[0].numpy())


def _smeared(cells: NDArray[np.bool_], shifts: list[float]) -> NDArray[np.uint8]:
    """Return the cells marked in `cells` [rows, columns], moved to the left by each of the shifts between two limits."""
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
