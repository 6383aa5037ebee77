"""What travels on the edges of the graph besides `Frame`: each step keeps the frame it belongs to and adds its own result."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.transfers import HostCopy


@dataclass(frozen=True)
class Reconstruction:
    """A frame and the model as it stands right after that frame's own training steps."""

    frame: Frame
    model: Model | Snapshot
    """Later steps publish later versions and do not change this one, a snapshot in a slot for as long as somebody holds it."""
    trained: bool
    """False for a held-out frame: it is shown and scored, and no step has seen it."""
    steps: int = 0
    """Optimiser steps that the frame was given."""
    arriving_loss: HostCopy | None = None
    """Loss of the last of these steps, which a GPU may not have finished; None when there was none."""
    content: Frame | None = None
    """Live: the newest frame that the model has seen, which is what its picture shows; None where the frame itself is meant."""
    taken_ns: int | None = None
    """Live: when training took the frame, by `time.monotonic_ns`."""
    published_ns: int | None = None
    """Live: when the model was published."""

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise InvalidInput(f"frame {self.frame.seq}: steps is {self.steps}; it must not be negative")
        if not self.trained and self.steps:
            raise InvalidInput(
                f"frame {self.frame.seq}: a held-out frame had {self.steps} training steps; it must have none"
            )

    @property
    def loss(self) -> float | None:
        """Loss of the last step; waits for it."""
        return None if self.arriving_loss is None else self.arriving_loss.item()


@dataclass(frozen=True)
class DeformedScene:
    """A model at a frame's time, and the camera that saw the frame.

    A renderer that deforms by itself, as the captured one on a GPU does, takes model and time; any other reader takes `gaussians`.
    """

    frame: Frame
    model: Model | Snapshot
    """Held for as long as this message is: a snapshot's slot is not overwritten meanwhile."""
    camera: Camera
    trained: bool
    reconstruction: Reconstruction | None = None
    """What the scene was made from, where that is known."""

    def __post_init__(self) -> None:
        if (self.camera.width_px, self.camera.height_px) != (self.frame.width_px, self.frame.height_px):
            raise InvalidInput(
                f"frame {self.frame.seq} is {self.frame.width_px}x{self.frame.height_px} px, its camera "
                f"{self.camera.width_px}x{self.camera.height_px}; scale the camera with Camera.scaled"
            )

    @property
    def time_s(self) -> float:
        """The time that the scene is deformed to."""
        return self.frame.time_s

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians at that time; computed when asked for, and by a `Model` only once."""
        return self.model.at(self.time_s)


@dataclass(frozen=True)
class RenderedFrame:
    """A frame beside its reconstruction, ready to be shown."""

    frame: Frame
    image: NDArray[np.uint8]
    """RGB uint8 [H, W, 3], as displayed."""
    depth: NDArray[np.float32]
    """z in millimetres (or the recording's unit) [H, W]; 0 = nothing there."""
    alpha: NDArray[np.float32]
    """Opacity 0..1 [H, W]."""
    model_version: int
    trained: bool
    steps: int = 0
    """Optimiser steps that the frame was given."""
    content: Frame | None = None
    """See `Reconstruction.content`."""
    taken_ns: int | None = None
    """See `Reconstruction.taken_ns`."""
    published_ns: int | None = None
    """See `Reconstruction.published_ns`."""

    def __post_init__(self) -> None:
        size = self.frame.image.shape
        if self.image.shape != size or self.image.dtype != np.uint8:
            raise InvalidInput(
                f"frame {self.frame.seq}: the reconstruction must be RGB uint8 {list(size)}, "
                f"got {self.image.dtype} {list(self.image.shape)}"
            )
        for name, plane in (("depth", self.depth), ("alpha", self.alpha)):
            if plane.shape != size[:2]:
                raise InvalidInput(f"frame {self.frame.seq}: {name} is {list(plane.shape)}, the image {list(size[:2])}")


@dataclass(frozen=True)
class Prediction:
    """A frame with the picture that the model gave of it before it was trained on it."""

    frame: Frame
    image: NDArray[np.uint8] | None
    """RGB uint8 [H, W, 3], rendered at the frame's time and pose; None where no prediction was made."""


class PictureState(Enum):
    """How a shown picture stands to the present."""

    LIVE = "live"
    """It shows a frame that came just now."""
    STALE = "stale"
    """What it shows is older than a live picture may be; newer ones are on their way."""
    FROZEN = "frozen"
    """No newer picture has come for long."""
    SOURCE_LOST = "source lost"
    """The source gives no frames."""


@dataclass(frozen=True)
class ShownPicture:
    """What is on the screen from a moment on."""

    rendered: RenderedFrame
    image: NDArray[np.uint8]
    """RGB uint8 [H, W, 3]: the rendered picture with its state and age drawn into it, and remembered tissue marked."""
    state: PictureState
    age_ns: int
    """Time since the arrival of the newest frame that the picture shows, when it came on the screen."""
    shown_ns: int
    """When it came on the screen, by `time.monotonic_ns`."""
    new: bool
    """False when the picture was there before, and only its state or its age has changed."""
    remembered: NDArray[np.uint8] | None = None
    """uint8 [H, W], 255 where the picture shows tissue that nobody saw when its content came; None: nowhere, or it was not looked for."""
