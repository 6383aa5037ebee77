"""One frame of endoscopic video with what is known about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera


class FrameStatus(Enum):
    """Where a frame's picture comes from."""

    LIVE = "live"
    REPLAY = "replay"
    STALE = "stale"
    DAMAGED = "damaged"
    """Some of it may be the decoder's guess: it is shown, and neither trained on nor scored."""


class DepthOrigin(Enum):
    """Where a frame's depth comes from, and with that what it may be used for."""

    MEASURED = "measured"
    """By a sensor, or given with the recording."""
    STEREO = "stereo"
    """Matched between the two eyes: metric where the baseline is."""
    PARALLAX = "parallax"
    """Matched between times at which the scope was elsewhere: in the unit of its poses."""
    LIGHT = "light"
    """From how bright tissue is in the scope's own light: relative, never metric."""
    LEARNED = "learned"
    """By a network of the user's, from one picture: relative, never metric."""


@dataclass(frozen=True)
class Frame:
    """One frame; operators add fields on its way and never change the ones it has."""

    seq: int
    """Number in the stream, from 0; it increases from frame to frame, and numbers may be missing where frames were lost."""
    pts_ns: int
    """Presentation time in nanoseconds of the recording's clock."""
    image: NDArray[np.uint8]
    """RGB uint8 [H, W, 3]."""
    right_image: NDArray[np.uint8] | None = None
    """The right eye of a rectified stereo pair, RGB uint8 [H, W, 3]."""
    right_camera: Camera | None = None
    """The camera of `right_image`; its pose leads from the left camera's coordinates to its own. None: not known, or there is no right eye."""
    depth: NDArray[np.float32] | None = None
    """z in millimetres [H, W]; 0 = unknown."""
    depth_confidence: NDArray[np.float32] | None = None
    """[H, W], 0 to 1: how far each pixel's depth is to be believed. None: all of it that is known."""
    depth_origin: DepthOrigin | None = None
    """Where `depth` comes from; None where there is none."""
    mask: NDArray[np.uint8] | None = None
    """[H, W]; 1 = tissue (keep), 0 = tool."""
    pose: NDArray[np.float64] | None = None
    """World-to-camera [4, 4], OpenCV axes."""
    status: FrameStatus = FrameStatus.REPLAY
    damage: str | None = None
    """What is wrong with a damaged frame."""
    arrived_ns: int | None = None
    """When a live frame came in, in nanoseconds of `time.monotonic_ns`; None where time plays no part."""
    loss_mask: NDArray[np.uint8] | None = None
    """[H, W]; 0 = left out of the loss though it may be tissue: outside of the field of view, a recorder's strip. None: nothing is left out."""
    rehearsal_mask: NDArray[np.uint8] | None = None
    """[H, W]; 0 = left out of the loss of what lasts, and still shown: highlights, which move with the light and not with the tissue."""
    exposure: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """How bright red, green and blue of this picture are beside the scene's own colours, which are those of the stream's first frames."""
    withheld: str | None = None
    """Why the frame is kept from training, in a word or two ("blur", "out of body"); None: it may be trained on."""
    new_scene: str | None = None
    """Why the scene is another one from this frame on ("cut", "resized"); None: it goes on."""
    scene: int = 0
    """Number of the frame's scene in its stream, where that is counted: whoever misses the frame that began it sees it by this."""

    def __post_init__(self) -> None:
        image = self.image
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise InvalidInput(
                f"frame {self.seq}: image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}"
            )
        size = image.shape[:2]
        if self.right_image is not None and self.right_image.shape != image.shape:
            raise InvalidInput(
                f"frame {self.seq}: right image {list(self.right_image.shape)} differs from left {list(image.shape)}"
            )
        right = self.right_camera
        if right is not None and (right.height_px, right.width_px) != size:
            raise InvalidInput(
                f"frame {self.seq}: its right camera is {right.width_px}x{right.height_px}, the image {size[1]}x{size[0]}"
            )
        planes = {
            name: getattr(self, name) for name in ("depth", "depth_confidence", "mask", "loss_mask", "rehearsal_mask")
        }
        for name, plane in planes.items():
            if plane is not None and plane.shape != size:
                raise InvalidInput(f"frame {self.seq}: {name} is {list(plane.shape)}, the image is {list(size)}")
        if self.pose is not None and self.pose.shape != (4, 4):
            raise InvalidInput(f"frame {self.seq}: pose must be [4, 4] world-to-camera, got {list(self.pose.shape)}")
        if not all(math.isfinite(gain) and gain > 0 for gain in self.exposure):
            raise InvalidInput(f"frame {self.seq}: exposure must be three positive numbers, got {self.exposure}")

    @property
    def time_s(self) -> float:
        """Presentation time in seconds."""
        return self.pts_ns * 1e-9

    @property
    def depth_is_metric(self) -> bool:
        """Whether the unit of `depth` is known. What is matched between the eyes has the unit of the distance between them, if that is known; what
        follows from poses has theirs, whatever it is. Of a frame whose depth was dropped to save memory, `depth_origin` still says it."""
        if self.depth_origin is None:
            return self.depth is not None
        matched = self.depth_origin is DepthOrigin.STEREO and self.right_camera is not None
        return self.depth_origin is DepthOrigin.MEASURED or matched

    @property
    def height_px(self) -> int:
        """Height of the image."""
        return int(self.image.shape[0])

    @property
    def width_px(self) -> int:
        """Width of the image."""
        return int(self.image.shape[1])

    def with_fields(self, **fields: Any) -> Frame:
        """A copy with more fields known."""
        return replace(self, **fields)
