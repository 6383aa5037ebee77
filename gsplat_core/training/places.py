"""Scenes that a stream has left. They are kept to recognise a scene that returns, and to reuse the memory of the last
one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import interpolate

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import HostCopy

MOST_PLACES = 8
"""Largest number of stored left scenes. The one that the stream left first is dropped."""
RENDERED_PX = 160
"""Width in pixels at which a left scene is rendered for comparison."""
COMPARED_PX = 64
"""Width at which pictures are compared, in pixels; small enough to tolerate motion of a few pixels."""
FINE_PX, COARSE_PX = 1.0, 16.0
"""Standard deviations, in pixels of the compared pictures, of the band-pass filter that removes noise and illumination.
"""
SAME_PLACE = 0.75
"""Correlation from which a picture counts as showing a left scene. See benchmarks/results/constants.md."""
LEAST_SHARE = 0.3
"""Smallest share of the picture that must be both tissue and covered by the left scene."""


Look: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Small picture of a scene: colours [H, W, 3] in 0..1, and opacity or share of tissue [H, W]."""


@dataclass
class Place:
    """Scene left by a stream, in host memory."""

    gaussians: Gaussians
    """Last state of the Gaussians, without a deformation field."""
    camera: Camera
    """Camera that last observed this scene."""
    left_s: float
    """Time in seconds when the stream left this scene."""
    _looks: dict[Camera, Look] = field(default_factory=dict, repr=False)

    def look(self, camera: Camera) -> Look:
        """Return the left scene `COMPARED_PX` wide. It is rendered unless the last look was from the same camera."""
        if camera not in self._looks:
            with torch.no_grad():
                output = render(self.gaussians, camera.scaled(RENDERED_PX / camera.width_px), depth=False)
            size = compared_size(camera.width_px, camera.height_px)
            pictures = (output.image.numpy(), output.alpha.numpy())
            image, alpha = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures)
            self._looks = {camera: (np.asarray(image, np.float32), np.asarray(alpha, np.float32))}
        return self._looks[camera]


class Places:
    """Store of the scenes left most recently."""

    def __init__(self, most: int = MOST_PLACES) -> None:
        self._most = most
        self._left: list[Place] = []

    def __len__(self) -> int:
        return len(self._left)

    def leave(self, gaussians: Gaussians, camera: Camera, time_s: float, look: Look | None = None) -> None:
        """Keep a copy of a scene in host memory.

        Args:
            gaussians: last state of the scene.
            camera: camera that last observed the scene.
            time_s: time of the copy in seconds.
            look: small picture of the scene from that camera; None to render it when it is needed.
        """
        kept = gaussians.map(lambda tensor: tensor.detach().to("cpu", torch.float32, copy=True))
        place = Place(kept, camera, time_s, {} if look is None else {camera: look})
        self._left = [*self._left, place][-self._most :] if self._most else []

    def take(self, frame: Frame) -> Place | None:
        """Remove and return the left scene that a frame shows, or None if it shows none.

        Each left scene is seen from the frame's pose or, without a pose, from its last camera. The comparison ignores
        the frame's exposure and white balance.
        """
        likeness = [self._likeness(place, frame) for place in self._left]
        best = int(np.argmax(likeness)) if likeness else 0
        return self._left.pop(best) if likeness and likeness[best] >= SAME_PLACE else None

    def _likeness(self, place: Place, frame: Frame) -> float:
        camera = place.camera.resized(frame.width_px, frame.height_px)
        image, alpha = place.look(camera if frame.pose is None else camera.with_pose(frame.pose))
        size = compared_size(frame.width_px, frame.height_px)
        shown = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.float32) / np.float32(255)
        known = alpha > 0.5
        for mask in (frame.mask, frame.loss_mask):
            if mask is not None:
                known &= cv2.resize((mask > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
        return likeness_of(shown, image, known)


class LeftScenes:
    """Scenes that a stream has left: their last states, and the memory of the newest one.

    A scene of the same picture size reuses that memory, so that captured graphs stay valid.
    """

    def __init__(self) -> None:
        self.places = Places()
        self._recognised: tuple[int, Place] | None = None
        """Number of the frame that starts the next scene, and the left scene that this frame shows; None if it shows
        none.
        """
        self._kept: TrainingStep | None = None
        self._kept_size: tuple[int, int] | None = None
        """Picture size (height, width) of the newest scene."""

    def forget(self) -> None:
        """Discard all left scenes."""
        self.places, self._recognised = Places(), None

    def leave(self, step: TrainingStep, newest: Observation, time_s: float) -> None:
        """Keep the last state of a scene at `time_s` to recognise it later.

        The scene's newest observation stands for a rendering from its camera. Rendering would delay the first picture of
        the next scene by more than half a frame interval.
        """
        self.places.leave(step.at(time_s), newest.camera, time_s, look_of(newest))

    def recognise(self, frame: Frame) -> bool:
        """Return True if the frame, which starts the next scene, shows a scene that the stream left before."""
        place = self.places.take(frame)
        self._recognised = None if place is None else (frame.seq, place)
        return place is not None

    def recognised(self, seq: int) -> Gaussians | None:
        """Return the Gaussians of the left scene as which frame `seq` was recognised, or None."""
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


def look_of(observation: Observation) -> Look | None:
    """Return the small picture of an observation; None if it shows too little tissue to be compared."""
    camera = observation.camera
    planes = torch.cat([observation.image.permute(2, 0, 1) / 255, (observation.mask != 0).float()[None]])
    width, height = compared_size(camera.width_px, camera.height_px)
    small = HostCopy(interpolate(planes[None], size=(height, width), mode="area")[0].permute(1, 2, 0)).numpy()
    tissue = np.ascontiguousarray(small[..., 3])
    if np.count_nonzero(tissue > 0.5) < LEAST_SHARE * tissue.size:
        return None
    return np.ascontiguousarray(small[..., :3]), tissue


def compared_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Return width and height at which pictures of this aspect ratio are compared."""
    return COMPARED_PX, max(1, round(COMPARED_PX * height_px / width_px))


def likeness_of(first: NDArray[np.float32], second: NDArray[np.float32], known: NDArray[np.bool_]) -> float:
    """Return the correlation, -1 to 1, of the structure of two pictures [H, W, 3] where `known` [H,
    W]; 0 if too little is known.

    Channels are compared separately, so gain and offset per channel have no effect.
    """
    if np.count_nonzero(known) < LEAST_SHARE * known.size:
        return 0.0
    weight = known.astype(np.float32)
    near = _blurred(weight, FINE_PX) + 1e-6
    far = _blurred(weight, COARSE_PX) + 1e-6
    of_channels = []
    for channel in range(3):
        pair = []
        for picture in (first, second):
            values = picture[..., channel] * weight
            structure = (_blurred(values, FINE_PX) / near - _blurred(values, COARSE_PX) / far)[known]
            pair.append(structure - structure.mean())
        norm = float(np.linalg.norm(pair[0]) * np.linalg.norm(pair[1]))
        of_channels.append(float(pair[0] @ pair[1]) / norm if norm > 1e-6 else 0.0)
    return float(np.mean(of_channels))


def _blurred(plane: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma_px), np.float32)
