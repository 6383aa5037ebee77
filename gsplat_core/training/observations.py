"""The frames that a reconstructor may train on, and which of them a step takes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.training.initialisation import believed_depth
from gsplat_core.transfers import HostCopy, tensor_of


@dataclass(frozen=True)
class Observation:
    """One frame in the types of the training step, on the device that trains."""

    seq: int
    time_s: float
    camera: Camera
    image: Tensor
    """uint8 [H, W, 3]."""
    mask: Tensor
    """uint8 [H, W]; 1 = tissue."""
    depth: Tensor | None
    """float32 [H, W] in millimetres; 0 = unknown."""
    rehearsal_mask: Tensor | None = None
    """uint8 [H, W]; 0 = left out when the frame is trained on again later."""
    right_eye: RightEye | None = None
    """What the right eye saw at the same time, where it is trained on as well (`BothEyes`)."""
    of_right: bool = False
    """Whether it is such an observation of the right eye."""

    @property
    def right(self) -> Observation | None:
        """The right eye's observation; made when it is first asked for, which takes the host as long as some steps take a GPU."""
        return None if self.right_eye is None else self.right_eye.observation

    def to_rehearse(self) -> Observation:
        """The frame as it is trained on again later."""
        right = None if self.right_eye is None else self.right_eye.to_rehearse()
        if self.rehearsal_mask is None:
            return self if right is None else replace(self, right_eye=right)
        return replace(self, mask=self.mask & self.rehearsal_mask, rehearsal_mask=None, right_eye=right)

    def by_turns(self, turn: int) -> Observation:
        """The eye whose turn it is: the left one at even turns, the right one, if there is one, at odd ones."""
        return self if self.right_eye is None or turn % 2 == 0 else self.right_eye.observation

    def as_frame(self) -> Frame:
        """The frame as training sees it. Waits for the device."""
        image, mask = HostCopy(self.image).numpy(), HostCopy(self.mask).numpy()
        return Frame(self.seq, round(self.time_s * 1e9), image, mask=mask, pose=self.camera.world_to_camera)

    @staticmethod
    def of(frame: Frame, camera: Camera, device: torch.device | str = "cpu") -> Observation:
        """A frame seen by `camera`, which has the frame's size; the frame's own pose wins over the camera's, and its exposure is taken out.

        The copy to another `device` than the CPU is queued on its current stream.
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
            image=tensor_of(scene_colours(frame.image, frame.exposure), device),
            mask=tensor_of(mask.astype(np.uint8, copy=False), device),
            depth=learned_depth(frame, device),
            rehearsal_mask=None if frame.rehearsal_mask is None else tensor_of(frame.rehearsal_mask, device),
        )


class RightEye:
    """An observation of the right eye that is made when it is first asked for."""

    def __init__(self, make: Callable[[], Observation]) -> None:
        self._make = make

    @cached_property
    def observation(self) -> Observation:
        """It."""
        return self._make()

    def to_rehearse(self) -> RightEye:
        """As it is trained on again later."""
        return RightEye(lambda: self.observation.to_rehearse())


def scene_colours(image: NDArray[np.uint8], exposure: tuple[float, float, float]) -> NDArray[np.uint8]:
    """The picture without its exposure."""
    if exposure == (1.0, 1.0, 1.0):
        return image
    return np.rint(np.clip(image / np.array(exposure, np.float32), 0, 255)).astype(np.uint8)


def learned_depth(frame: Frame, device: torch.device | str = "cpu") -> Tensor | None:
    """The frame's depth [H, W] that the loss takes, 0 where it is not believed; None where it takes none. The scene starts from depth of a single picture,
    by light or learned, and is not held to it: it is rough, and right up to a factor that no two frames need to share."""
    if frame.depth is None or frame.depth_origin in (DepthOrigin.LIGHT, DepthOrigin.LEARNED):
        return None
    return known_depth(believed_depth(frame), device)


def known_depth(depth_mm: NDArray[np.floating], device: torch.device | str = "cpu") -> Tensor:
    """The depth map [H, W] as float32 on `device`, with 0 (unknown) where it holds no positive finite number."""
    # Looked at where it is used: on the host that takes longer than some steps on a GPU.
    depth = tensor_of(depth_mm.astype(np.float32, copy=False), device)
    return torch.where(torch.isfinite(depth) & (depth > 0), depth, 0.0)


class ObservationWindow:
    """The newest frames, bounded; draws the newest one or an older one by a seeded generator."""

    def __init__(self, capacity: int, newest_share: float, seed: int) -> None:
        self._frames: deque[Observation] = deque(maxlen=capacity)
        self._newest_share = newest_share
        self._random = np.random.default_rng(seed)

    def add(self, observation: Observation) -> None:
        """Make `observation` the newest; the oldest leaves a full window."""
        self._frames.append(observation.to_rehearse())

    @property
    def newest(self) -> Observation:
        """The frame that was added last."""
        return self._frames[-1]

    def find(self, seq: int, among: int) -> Observation | None:
        """The frame with this number, if it is there and one of so many newest ones."""
        newest = islice(reversed(self._frames), among)
        return next((each for each in newest if each.seq == seq), None)

    def replace(self, observation: Observation) -> None:
        """Put `observation` in the place of the frame with its number. Raises InvalidInput where there is none."""
        for index in reversed(range(len(self._frames))):
            if self._frames[index].seq == observation.seq:
                self._frames[index] = observation
                return
        raise InvalidInput(f"frame {observation.seq} is not in the window of {len(self._frames)} frames")

    def forget_before(self, time_s: float) -> None:
        """Drop frames that are older, all but the newest: the field no longer tells their times apart."""
        while len(self._frames) > 1 and self._frames[0].time_s < time_s:
            self._frames.popleft()

    def __len__(self) -> int:
        return len(self._frames)

    def draw(self, newest_share: float) -> Observation:
        """The newest frame with that probability, else any frame of the window."""
        newest = self._random.random() < newest_share
        return self._frames[-1 if newest else int(self._random.integers(0, len(self._frames)))]

    def schedule(self, steps: int) -> list[Observation]:
        """Observations for the next `steps` steps. The last one is the newest frame, which is about to be shown."""
        if steps < 0:
            raise InvalidInput(f"steps is {steps}; it must be at least 0")
        if steps == 0:
            return []
        newest = self._frames[-1]
        older = len(self._frames) - 1
        if older == 0:
            return [newest] * steps
        to_newest = max(1, round(steps * self._newest_share))
        chosen = [self._frames[int(i)] for i in self._random.integers(0, older, steps - to_newest)]
        # Spread the newest frame's steps evenly among the others, ending with it.
        order: list[Observation] = []
        for k in range(steps):
            newest_turn = (k + 1) * to_newest // steps > k * to_newest // steps
            order.append(newest if newest_turn else chosen.pop())
        return order
