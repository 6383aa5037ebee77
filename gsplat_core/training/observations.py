"""Observations of frames for training: pictures and masks of one or both eyes on the training device, their selection
for each step, and the mapping between points and pixels.

Sensors and light paths of a stereo scope's eyes differ slightly, and the difference changes slowly. Without correction
the two pictures would pull every colour back and forth. A gain and an offset per channel are therefore applied to the
right picture.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.choices import Eyes
from gsplat_core.depth.maps import believed_depth
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.range_sensors import RangeScan
from gsplat_core.transfers import HostCopy, tensor_of


@dataclass(frozen=True)
class Observation:
    """Frame as tensors on the training device."""

    seq: int
    time_s: float
    camera: Camera
    image: Tensor
    """RGB uint8 [H, W, 3]."""
    mask: Tensor
    """Mask uint8 [H, W]; 1 = tissue."""
    depth: Tensor | None
    """Depth float32 [H, W] in millimetres; 0 = unknown."""
    depth_error: float = 0.0
    """Typical relative standard error of the depth."""
    right_eye: RightEye | None = None
    """Right eye's picture taken at the same time, if the right eye is trained on (`BothEyes`)."""
    labels: Tensor | None = None
    """Class of each pixel uint8 [H, W], 255 = unknown; None for a frame without labels."""
    of_right: bool = False
    """True if the picture is the right eye's."""
    ranges: RangeScan | None = None
    """Scan of a range sensor at the camera's place; None without one."""

    @property
    def right(self) -> Observation | None:
        """Observation of the right eye, None without one. It is created on first use, which costs host time equal to
        several GPU steps.
        """
        return None if self.right_eye is None else self.right_eye.observation

    def by_turns(self, turn: int) -> Observation:
        """Return the right eye's observation, if there is one, at odd turns, else this observation."""
        return self if self.right_eye is None or turn % 2 == 0 else self.right_eye.observation

    def as_frame(self) -> Frame:
        """Return picture, mask and pose as a frame on the host, without depth and labels. Synchronises with the device."""
        image, mask = HostCopy(self.image).numpy(), HostCopy(self.mask).numpy()
        return Frame(self.seq, round(self.time_s * 1e9), image, mask=mask, pose=self.camera.world_to_camera)

    @staticmethod
    def of(frame: Frame, camera: Camera, device: torch.device | str = "cpu") -> Observation:
        """Create an observation of a frame.

        Args:
            frame: frame; its own pose overrides the camera's.
            camera: camera of the frame's size.
            device: target device; the copy is queued on its current stream.

        Raises:
            InvalidInput: for a camera of another size.
        """
        if (frame.width_px, frame.height_px) != (camera.width_px, camera.height_px):
            raise InvalidInput(
                f"frame {frame.seq} is {frame.width_px}x{frame.height_px}, its camera {camera.width_px}x{camera.height_px};"
                " scale the camera with Camera.scaled"
            )
        mask = np.ones(frame.image.shape[:2], np.uint8) if frame.mask is None else frame.mask
        if frame.loss_mask is not None:
            mask = mask & frame.loss_mask
        return Observation(
            seq=frame.seq,
            time_s=frame.time_s,
            camera=camera if frame.pose is None else camera.with_pose(frame.pose),
            image=tensor_of(frame.image, device),
            mask=tensor_of(mask.astype(np.uint8, copy=False), device),
            depth=learned_depth(frame, device),
            depth_error=error_of_depth(frame),
            ranges=frame.ranges,
            labels=None if frame.labels is None else tensor_of(frame.labels, device),
        )


class RightEye:
    """Observation of the right eye, created on first use."""

    def __init__(self, make: Callable[[], Observation]) -> None:
        self._make = make

    @cached_property
    def observation(self) -> Observation:
        """Observation of the right eye; the first access creates it."""
        return self._make()


def error_of_depth(frame: Frame) -> float:
    """Return the typical relative standard error of a frame's depth; 0 without depth."""
    if frame.depth is None or frame.depth_origin is None:
        return 0.0
    return frame.depth_origin.relative_error if frame.depth_error is None else frame.depth_error


def learned_depth(frame: Frame, device: torch.device | str = "cpu") -> Tensor | None:
    """Return the depth [H, W] compared by the loss, 0 where not confident, or None for no
    comparison.

    Shading and network depth only initialise the scene. They are inaccurate, and their scale may
    differ between frames.
    """
    if frame.depth is None or frame.depth_origin is None or frame.depth_origin.initialises_only:
        return None
    return known_depth(believed_depth(frame), device)


def known_depth(depth_mm: NDArray[np.floating], device: torch.device | str = "cpu") -> Tensor:
    """Return a depth map [H, W] as float32 on `device`, with 0 where it is not positive and finite."""
    # Compared on the device, because the host would take longer than some GPU steps.
    depth = tensor_of(depth_mm.astype(np.float32, copy=False), device)
    return torch.where(torch.isfinite(depth) & (depth > 0), depth, 0.0)


NEWEST_SHARE = 0.7
"""Share of the scheduled steps spent on the newest frame. The other steps train on older frames of the window."""


class ObservationWindow:
    """Bounded window of the newest frames with seeded random selection."""

    def __init__(self, capacity: int, seed: int) -> None:
        self._frames: deque[Observation] = deque(maxlen=capacity)
        self._random = np.random.default_rng(seed)

    def add(self, observation: Observation) -> None:
        """Add an observation as the newest; a full window drops the oldest."""
        self._frames.append(observation)

    @property
    def newest(self) -> Observation:
        """Frame added last."""
        return self._frames[-1]

    @property
    def frames(self) -> list[Observation]:
        """Return the frames of the window in temporal order."""
        return list(self._frames)

    def find(self, seq: int, among: int) -> Observation | None:
        """Return the frame with number `seq` if it is one of the `among` newest ones."""
        newest = islice(reversed(self._frames), among)
        return next((each for each in newest if each.seq == seq), None)

    def replace(self, observation: Observation) -> None:
        """Replace the observation of the frame with the same number.

        Raises:
            InvalidInput: if the window has no frame with that number.
        """
        for index in reversed(range(len(self._frames))):
            if self._frames[index].seq == observation.seq:
                self._frames[index] = observation
                return
        raise InvalidInput(f"frame {observation.seq} is not in the window of {len(self._frames)} frames")

    def forget_before(self, time_s: float) -> None:
        """Drop frames before `time_s`, whose times the field no longer resolves, except the newest."""
        while len(self._frames) > 1 and self._frames[0].time_s < time_s:
            self._frames.popleft()

    def __len__(self) -> int:
        return len(self._frames)

    def draw(self, newest_share: float) -> Observation:
        """Return the newest frame with probability `newest_share`, else a random frame of the
        window.
        """
        newest = self._random.random() < newest_share
        return self._frames[-1 if newest else int(self._random.integers(0, len(self._frames)))]

    def schedule(self, steps: int) -> list[Observation]:
        """Return one observation for each of the next `steps` optimiser steps. The last one is the newest frame, which is displayed
        next.

        Raises:
            InvalidInput: if `steps` is negative.
        """
        if steps < 0:
            raise InvalidInput(f"steps is {steps}; it must be at least 0")
        if steps == 0:
            return []
        newest = self._frames[-1]
        older = len(self._frames) - 1
        if older == 0:
            return [newest] * steps
        to_newest = max(1, round(steps * NEWEST_SHARE))
        chosen = [self._frames[int(i)] for i in self._random.integers(0, older, steps - to_newest)]
        # Space the `to_newest` steps on the newest frame evenly. The last step is always one of them.
        order: list[Observation] = []
        for k in range(steps):
            newest_turn = (k + 1) * to_newest // steps > k * to_newest // steps
            order.append(newest if newest_turn else chosen.pop())
        return order


class PreparedPicture(NamedTuple):
    """Right picture in the left one's colours, on the host."""

    image: NDArray[np.uint8]
    """Right picture in the left picture's colours, RGB [H, W, 3]."""
    mask: NDArray[np.uint8]
    """Tissue mask of the right picture [H, W]; 1 = tissue."""


class BothEyes:
    """Converter of a stream's frames to training observations: one of the left eye and, if requested and
    calibrated, one of the right eye.
    """

    def __init__(self, eyes: Eyes, device: torch.device | str = "cpu") -> None:
        self._with_right, self._device = eyes == "both", device
        self._preparer: ThreadPoolExecutor | None = None
        """Single-thread pool that prepares right pictures in frame order; None unless both eyes are trained on a GPU."""
        if self._with_right and torch.device(device).type == "cuda":
            self._preparer = ThreadPoolExecutor(1, thread_name_prefix="right eye")
        self.trained: Eyes = "left"
        """`both` once an observation with a right eye was created, else `left`."""
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


COMPARED_PX = 80
"""Width in pixels of the reduced left and right pictures whose colours are compared."""
COMPARE_EVERY = 10
"""Number of frames between two comparisons of the eyes' colours."""
FOLLOWS = 0.2
"""Weight of a new comparison of the eyes' colours in the moving average."""
SHIFT_STAYS = 4
"""Largest change of the shift between the eyes' pictures that is searched first, in pixels of the reduced pictures."""
LEAST_OVERLAP = 0.4
"""Smallest overlap of the two eyes' views at which a shift is considered, as a share of the width."""
QUANTILES = (10, 50, 90)
"""Quantiles of the eyes' colours that are matched, in per cent. Highlights and shadows, which differ between the eyes, lie
outside of their range.
"""
FLAT_LEVELS = 8.0
"""Difference of the outer colour quantiles, in levels of 255, below which only an offset and no gain is estimated for a
channel.
"""
MOST_GAIN = 2.0
NOISE_LEVELS = 1.5
"""Largest change of a quantile in levels that counts as estimation noise; such a correction is not applied."""


class EyeColours:
    """Gain and offset per channel that convert a stream's right pictures to the colours of its left ones."""

    def __init__(self) -> None:
        self._gain, self._offset = np.ones(3), np.zeros(3)
        self._line: NDArray[np.float32] | None = None
        """Colour transform [3, 4] of the right picture: gains on the diagonal, offsets in the last column. None if no
        correction is needed.
        """
        self._frames = 0
        self.shift: float | None = None
        """Shift of the right picture to the left, as a share of its width, at the last comparison; None before the
        first one.
        """

    def corrected(self, frame: Frame) -> NDArray[np.uint8]:
        """Return the right picture of a stereo frame in the colours of the left one."""
        assert frame.right_image is not None
        if self._frames % COMPARE_EVERY == 0:
            self._compare(frame.image, frame.right_image, frame.mask)
        self._frames += 1
        if self._line is None:
            return frame.right_image
        return np.asarray(cv2.transform(frame.right_image, self._line), np.uint8)

    def _compare(self, left: NDArray[np.uint8], right: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
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
    size = min(COMPARED_PX, width), max(1, round(height * min(1.0, COMPARED_PX / width)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def best_shift(left: NDArray[np.float32], right: NDArray[np.float32], before: int | None = None) -> int:
    """Return the shift of the right picture [h, w] to the left in pixels that maximises the correlation.

    Given an earlier shift `before`, only shifts within `SHIFT_STAYS` of it are searched. If the best of them is at the end
    of that range, all shifts are searched.
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
    """Return the sum of all pixels in each of several column ranges, [ranges]. A range is given by its first column and width."""
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
"""Assumed largest and smallest disparity of a tool whose depth is unknown, as multiples of the typical disparity of the scene."""


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
    """Return the cells that a cell marked in `cells` [rows, columns] covers while it moves to the left from the smallest to
    the largest of the shifts.
    """
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


def pixels_of(means: Tensor, camera: Camera, margin_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Project points [N, 3]. Returns pixel coordinates [N, 2], and which are in the picture or
    within `margin_px` of it, bool [N].
    """
    viewmat, intrinsics = camera.matrices(means.device, means.dtype)
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    plane, z = points[:, :2], points[:, 2:]
    if camera.model == "fisheye":
        radius = plane.norm(dim=1, keepdim=True).clamp(min=1e-9)
        plane = plane * torch.atan2(radius, z) / radius
    elif camera.model == "pinhole":
        plane = plane / torch.where(z > 0, z, torch.inf)
    pixels = plane * intrinsics.diagonal()[:2] + intrinsics[:2, 2]
    size = pixels.new_tensor([camera.width_px, camera.height_px])
    return pixels, ((pixels >= -margin_px) & (pixels < size + margin_px)).all(1) & (z[:, 0] > 0)


def depth_of(means: Tensor, camera: Camera) -> Tensor:
    """Return the depth of points [N, 3] along the camera's axis, [N]."""
    # Not a matrix product: cuBLAS takes tens of milliseconds for its first use in a thread, which would
    # delay a stream's first picture.
    x, y, z, offset = camera.world_to_camera[2].tolist()
    return x * means[:, 0] + y * means[:, 1] + z * means[:, 2] + offset


def value_at(plane: Tensor, pixels: Tensor) -> Tensor:
    """Sample a plane [H, W] at pixel coordinates [N, 2], clamped to the edge."""
    column = pixels[:, 0].long().clamp(0, plane.shape[1] - 1)
    row = pixels[:, 1].long().clamp(0, plane.shape[0] - 1)
    return plane[row, column]


MAX_ANGLE_RAD = math.radians(85)
"""Largest angle to the axis at which a fisheye pixel is placed; larger ones are clamped."""


def unprojected(
    pixels: NDArray[np.float64], z: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unproject pixels [M, 2] at depths `z` [M]. Returns points in camera coordinates [M, 3] and
    the size of a pixel there [M].
    """
    plane = (pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    if camera.model == "ortho":
        return np.concatenate([plane, z[:, None]], 1), np.full_like(z, 1 / camera.K[0, 0])
    pixel = z / camera.K[0, 0]
    if camera.model == "fisheye":
        # For a fisheye camera, `plane` holds angles. A pixel is stretched by 1 / cos² radially and by tan / angle
        # tangentially; the geometric mean is used.
        angle = np.clip(np.linalg.norm(plane, axis=1), 1e-9, MAX_ANGLE_RAD)
        stretch = np.tan(angle) / np.maximum(np.linalg.norm(plane, axis=1), 1e-9)
        plane = plane * stretch[:, None]
        pixel = pixel * np.sqrt(stretch) / np.cos(angle)
    return np.concatenate([plane * z[:, None], z[:, None]], 1), pixel
