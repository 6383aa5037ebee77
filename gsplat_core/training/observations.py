"""Frames available for training, and the selection of one for each step."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.depth.maps import believed_depth
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
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
        """Return the frame as training sees it. Synchronises with the device."""
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
            InvalidInput: if there is none.
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
        """Return observations for the next steps, ending with the newest frame, which is displayed next."""
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
