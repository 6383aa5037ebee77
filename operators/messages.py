"""Messages on the edges of the graph other than `Frame`. Each message carries its frame and adds the result of an
operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.models import Model, Snapshot
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.transfers import HostCopy


@dataclass(frozen=True)
class Reconstruction:
    """A frame and the model published right after training on that frame."""

    frame: Frame
    model: Model | Snapshot
    """Immutable: later training publishes new versions. A snapshot's slot is reused once it is no longer referenced."""
    trained: bool
    """False for a frame that is displayed and scored but was not trained on."""
    steps: int = 0
    """Number of optimiser steps on this frame."""
    arriving_loss: HostCopy | None = None
    """Loss of the last optimiser step on this frame, possibly still in flight from the GPU; None without steps."""
    content: Frame | None = None
    """Live runs: newest frame the model was trained on, which determines the picture's age. None means `frame` itself.
    """
    taken_ns: int | None = None
    """Time at which training dequeued the frame, by `time.monotonic_ns`; None except in live runs."""
    published_ns: int | None = None
    """Time at which the model was published, by `time.monotonic_ns`; None except in live runs."""

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise InvalidInput(f"frame {self.frame.seq}: steps is {self.steps}; it must not be negative")
        if not self.trained and self.steps:
            raise InvalidInput(
                f"frame {self.frame.seq}: a held-out frame had {self.steps} training steps; it must have none"
            )

    @property
    def loss(self) -> float | None:
        """Loss of the last optimiser step on this frame; blocks until the GPU has finished. None without steps."""
        return None if self.arriving_loss is None else self.arriving_loss.item()


@dataclass(frozen=True)
class DeformedScene:
    """A model with the timestamp to deform it to and the camera of the frame.

    A renderer that deforms by itself, such as the captured GPU renderer, uses model and time. Other
    consumers use `gaussians`.
    """

    frame: Frame
    model: Model | Snapshot
    """Referenced for the lifetime of this message, so that a snapshot's slot is not overwritten."""
    camera: Camera
    trained: bool
    reconstruction: Reconstruction | None = None
    """Message with the frame and model from which this scene was made; None if unknown."""

    def __post_init__(self) -> None:
        if (self.camera.width_px, self.camera.height_px) != (self.frame.width_px, self.frame.height_px):
            raise InvalidInput(
                f"frame {self.frame.seq} is {self.frame.width_px}x{self.frame.height_px} px, its camera "
                f"{self.camera.width_px}x{self.camera.height_px}; scale the camera with Camera.scaled"
            )

    @property
    def time_s(self) -> float:
        """Timestamp of the deformation, in seconds."""
        return self.frame.time_s

    @property
    def gaussians(self) -> Gaussians:
        """Gaussians deformed to `time_s`. Computed on access; a `Model` caches the result."""
        return self.model.at(self.time_s)


@dataclass(frozen=True)
class RenderedFrame:
    """A frame and its rendered reconstruction."""

    frame: Frame
    image: NDArray[np.uint8]
    """Reconstruction for display, uint8 RGB [H, W, 3]."""
    depth: NDArray[np.float32]
    """Depth along z, float32 [H, W], in millimetres or the recording's unit; 0 where nothing was rendered."""
    alpha: NDArray[np.float32]
    """Opacity, float32 [H, W], 0..1."""
    model_version: int
    trained: bool
    steps: int = 0
    """Number of optimiser steps on this frame."""
    content: Frame | None = None
    """Newest frame that the model was trained on, in live runs; see `Reconstruction.content`. None means `frame`
    itself.
    """
    taken_ns: int | None = None
    """Time at which training dequeued the frame, by `time.monotonic_ns`; None except in live runs."""
    published_ns: int | None = None
    """Time at which the model was published, by `time.monotonic_ns`; None except in live runs."""
    outputs: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """Further outputs of the renderer by name, float32 [H, W] or [H, W, C]."""

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
    """A frame and the picture that the model predicted before it was trained on the frame."""

    frame: Frame
    image: NDArray[np.uint8] | None
    """uint8 RGB [H, W, 3], rendered at the frame's time and pose; None if no prediction was made."""


class PictureState(Enum):
    """State of a displayed picture, by the age of its content and the state of the source."""

    LIVE = "live"
    """The picture shows a frame that has just arrived."""
    BEHIND = "behind"
    """The picture is recent, but the model does not follow: the previous frame shown again would be better."""
    STALE = "stale"
    """The content is older than the limit for a live picture; newer frames may be in flight."""
    FROZEN = "frozen"
    """No new content for longer than the frozen limit."""
    SOURCE_LOST = "source lost"
    """The source delivers no frames."""


@dataclass(frozen=True)
class ShownPicture:
    """A picture as it appears on the display."""

    rendered: RenderedFrame
    image: NDArray[np.uint8]
    """Rendered picture with state, age and remembered tissue drawn in, uint8 RGB [H, W, 3]."""
    state: PictureState
    age_ns: int
    """Age at display: time since the newest frame in the picture arrived, in nanoseconds."""
    shown_ns: int
    """Time of display, by `time.monotonic_ns`."""
    new: bool
    """False if the picture was displayed before and only its state or age changed."""
    remembered: NDArray[np.uint8] | None = None
    """Mask of remembered tissue that was not visible in the content's frame, uint8 [H, W], 255 =
    remembered. None if absent or not computed.
    """
