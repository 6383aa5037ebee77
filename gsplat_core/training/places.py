"""Scenes that a stream has left. They are kept to recognise a scene that returns, and to reuse the memory of the last
one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep

MOST_PLACES = 8
"""Largest number of earlier scenes that are stored. The oldest is dropped."""
RENDERED_PX = 160
"""Width in pixels at which an earlier scene is rendered for comparison."""
COMPARED_PX = 64
"""Width at which pictures are compared, in pixels; small enough to tolerate motion of a few pixels."""
SAMPLES = 4
"""Number of rows and columns of a frame that are averaged for a row and a column of a compared picture."""
FINE_PX, COARSE_PX = 1.0, 16.0
"""Standard deviations, in pixels of the compared pictures, of the band-pass filter that removes noise and illumination.
"""
SAME_PLACE = 0.75
"""Correlation from which a picture counts as showing an earlier scene. See benchmarks/results/constants.md."""
LEAST_SHARE = 0.3
"""Smallest share of the picture that must be both tissue and covered by the earlier scene."""


@dataclass(frozen=True)
class Structure:
    """Band-pass filtered small picture, which is compared with others.

    Noise, illumination, gain and offset of its channels have no effect on comparisons.
    """

    values: NDArray[np.float32]
    """Filtered colours [H, W, 3]; only those of known pixels are meaningful."""
    known: NDArray[np.bool_]
    """[H, W]; True where the picture shows tissue."""

    @classmethod
    def of(cls, image: NDArray[np.float32], known: NDArray[np.bool_]) -> Structure:
        """Filter a picture.

        Args:
            image: colours [H, W, 3] in 0..1, `COMPARED_PX` wide.
            known: [H, W]; other pixels have no effect.
        """
        weight = known.astype(np.float32)
        image = np.asarray(image, np.float32) * weight[..., None]
        near = _blurred(image, FINE_PX) / (_blurred(weight, FINE_PX) + 1e-6)[..., None]
        far = _blurred(image, COARSE_PX) / (_blurred(weight, COARSE_PX) + 1e-6)[..., None]
        return cls(near - far, known)

    def likeness(self, other: Structure) -> float:
        """Return the correlation with another structure of the same size, -1 to 1, where both are known: the mean over
        the channels. 0 if too little is known.
        """
        known = self.known & other.known
        if np.count_nonzero(known) < LEAST_SHARE * known.size:
            return 0.0
        at = np.flatnonzero(known)
        of_channels = []
        for channel in range(3):
            first, second = (each.values[..., channel].reshape(-1)[at] for each in (self, other))
            first, second = first - first.mean(), second - second.mean()
            norm = float(np.linalg.norm(first) * np.linalg.norm(second))
            of_channels.append(float(first @ second) / norm if norm > 1e-6 else 0.0)
        return float(np.mean(of_channels))


@dataclass
class Place:
    """Earlier scene, which the stream has left."""

    gaussians: Gaussians
    """Last state of the Gaussians, without a deformation field, in host memory after `Places.to_host`."""
    camera: Camera
    """Camera that last observed this scene."""
    left_s: float
    """Time in seconds when the stream left this scene."""
    _seen: dict[Camera, Structure] = field(default_factory=dict, repr=False)

    def structure(self, camera: Camera) -> Structure:
        """Render the earlier scene from a camera and return the band-pass filtered picture.

        The result for the last camera is cached.
        """
        if camera not in self._seen:
            with torch.no_grad():
                output = render(self.gaussians.to("cpu"), camera.scaled(RENDERED_PX / camera.width_px), depth=False)
            size = compared_size(camera.width_px, camera.height_px)
            pictures = (output.image.numpy(), output.alpha.numpy())
            image, alpha = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures)
            self._seen = {camera: Structure.of(np.asarray(image, np.float32), alpha > 0.5)}
        return self._seen[camera]


class Places:
    """Store of the scenes that the stream left most recently."""

    def __init__(self, most: int = MOST_PLACES) -> None:
        self._most = most
        self._left: list[Place] = []

    def __len__(self) -> int:
        return len(self._left)

    def leave(self, gaussians: Gaussians, camera: Camera, time_s: float, seen: Structure | None = None) -> None:
        """Keep a copy of a scene. It stays on its device until the next call of `to_host` or this method.

        Args:
            gaussians: last state of the scene.
            camera: camera that last observed the scene.
            time_s: time of the copy in seconds.
            seen: structure of a picture of the scene from that camera; None to render it when it is needed.
        """
        self.to_host()
        kept = gaussians.map(lambda tensor: tensor.detach().to(torch.float32, copy=True))
        place = Place(kept, camera, time_s, {} if seen is None else {camera: seen})
        self._left = [*self._left, place][-self._most :] if self._most else []

    def to_host(self) -> None:
        """Move all scenes to host memory. The first picture of the next scene need not wait for that."""
        for place in self._left:
            place.gaussians = place.gaussians.to("cpu")

    def take(self, frame: Frame) -> Place | None:
        """Remove and return the earlier scene that a frame shows, or None if it shows none.

        Each earlier scene is seen from the frame's pose or, without a pose, from its last camera. The comparison
        ignores the frame's exposure and white balance.
        """
        if not self._left:
            return None
        shown = _shown(frame)
        likeness = [place.structure(_seen_by(place, frame)).likeness(shown) for place in self._left]
        best = int(np.argmax(likeness))
        return self._left.pop(best) if likeness[best] >= SAME_PLACE else None


def _seen_by(place: Place, frame: Frame) -> Camera:
    """Return the camera from which an earlier scene is rendered for the comparison with a frame."""
    camera = place.camera.resized(frame.width_px, frame.height_px)
    return camera if frame.pose is None else camera.with_pose(frame.pose)


def structure_of(frame: Frame) -> Structure | None:
    """Return the structure of the tissue in a frame; None if it shows too little tissue to be compared."""
    shown = _shown(frame)
    return shown if np.count_nonzero(shown.known) >= LEAST_SHARE * shown.known.size else None


def _shown(frame: Frame) -> Structure:
    size = compared_size(frame.width_px, frame.height_px)
    samples = SAMPLES * size[0], SAMPLES * size[1]
    known = np.ones((size[1], size[0]), bool)
    for mask in (frame.mask, frame.loss_mask):
        if mask is not None:
            some = cv2.resize(mask, samples, interpolation=cv2.INTER_NEAREST) > 0
            known &= averaged(some.view(np.uint8) * np.uint8(255), size, SAMPLES) >= 128  # half of the samples
    return Structure.of(averaged(frame.image, size, SAMPLES).astype(np.float32) / np.float32(255), known)


class LeftScenes:
    """Scenes that a stream has left: their last states, and the memory of the newest one.

    A scene of the same picture size reuses that memory, so that captured graphs stay valid.
    """

    def __init__(self) -> None:
        self.places = Places()
        self._recognised: tuple[int, Place] | None = None
        """Number of the frame that starts the next scene, and the earlier scene that this frame shows; None if it shows
        none.
        """
        self._kept: TrainingStep | None = None
        self._kept_size: tuple[int, int] | None = None
        """Picture size (height, width) of the newest scene."""

    def forget(self) -> None:
        """Discard all earlier scenes."""
        self.places, self._recognised = Places(), None

    def leave(self, step: TrainingStep, camera: Camera, time_s: float, frame: Frame | None) -> None:
        """Keep the last state of a scene to recognise it later.

        Args:
            step: training of the scene.
            camera: camera that last observed the scene.
            time_s: time of the last observation in seconds.
            frame: frame of that observation, which stands for a rendering of the scene from its camera; None to render the scene when a frame is
                compared with it, which delays that frame's picture by more than half a frame interval.
        """
        self.places.leave(step.at(time_s), camera, time_s, None if frame is None else structure_of(frame))

    def recognise(self, frame: Frame) -> bool:
        """Return True if the frame, which starts the next scene, shows a scene that the stream left before."""
        place = self.places.take(frame)
        self._recognised = None if place is None else (frame.seq, place)
        return place is not None

    def recognised(self, seq: int) -> Gaussians | None:
        """Return the Gaussians of the earlier scene that frame `seq` was found to show, or None."""
        return self._recognised[1].gaussians if self._recognised and self._recognised[0] == seq else None

    def keep_memory(self, step: TrainingStep | None) -> None:
        """Keep the tensors of a scene, to be reused by the next scene. With None, the tensors kept before stay."""
        self._kept = step or self._kept

    def restarted(self, gaussians: Gaussians, observation: Observation) -> TrainingStep | None:
        """Start a scene of these Gaussians from its first observation in the memory of the previous
        scene. Return None if there is no such memory or the scene does not fit into it.
        """
        kept, self._kept = self._kept, None
        size = observation.camera.width_px, observation.camera.height_px
        same_size, self._kept_size = size == self._kept_size, size
        if kept is None or not same_size:
            return None
        return kept if kept.restart(gaussians, observation.time_s, observation.camera) else None


def compared_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Return width and height at which pictures of this aspect ratio are compared."""
    return COMPARED_PX, max(1, round(COMPARED_PX * height_px / width_px))


def _blurred(plane: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma_px), np.float32)
