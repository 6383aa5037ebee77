"""Places that a stream has left: what was learned there is kept, and found again when the stream shows one of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians

MOST_PLACES = 8
"""Places that are kept; beyond them the one that was left first is forgotten."""
RENDERED_PX = 160
"""Width at which a place is rendered to be compared."""
COMPARED_PX = 64
"""Width at which pictures are compared: tissue that moved by a few pixels still lies in the same place then."""
FINE_PX, COARSE_PX = 1.0, 16.0
"""Standard deviations, in pixels of that size, between which structure is compared: not noise, and not where the light falls."""
SAME_PLACE = 0.75
"""Correlation from which on a picture shows a place. On four recordings it stays above that while the view is kept (0.9 after 3 s of cutting,
0.7 to 0.8 within seconds of a beating heart); pictures of different places, and mirrored ones of the same place, reach 0.6."""
LEAST_SHARE = 0.3
"""Share of the picture that must be both tissue and part of the place."""


@dataclass
class Place:
    """What a stream left behind, in host memory."""

    gaussians: Gaussians
    """As they were last: what does not move any more needs no field."""
    camera: Camera
    """That saw it last."""
    left_s: float
    """When the stream left it."""
    _looks: dict[Camera, tuple[NDArray[np.float32], NDArray[np.float32]]] = field(default_factory=dict, repr=False)

    def look(self, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The place seen by a camera: colours [H, W, 3] and opacity [H, W], `COMPARED_PX` wide. The last camera's are remembered."""
        if camera not in self._looks:
            with torch.no_grad():
                output = render(self.gaussians, camera.scaled(RENDERED_PX / camera.width_px), depth=False)
            size = compared_size(camera.width_px, camera.height_px)
            pictures = (output.image.numpy(), output.alpha.numpy())
            image, alpha = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures)
            self._looks = {camera: (np.asarray(image, np.float32), np.asarray(alpha, np.float32))}
        return self._looks[camera]


class Places:
    """The places that were left last."""

    def __init__(self, most: int = MOST_PLACES) -> None:
        self._most = most
        self._left: list[Place] = []

    def __len__(self) -> int:
        return len(self._left)

    def leave(self, gaussians: Gaussians, camera: Camera, time_s: float) -> None:
        """Keep a scene as it is now. They are copied to the host."""
        kept = gaussians.map(lambda tensor: tensor.detach().to("cpu", torch.float32, copy=True))
        self._left = [*self._left, Place(kept, camera, time_s)][-self._most :] if self._most else []

    def take(self, frame: Frame) -> Place | None:
        """The kept place that a frame shows, which is no longer kept then; None where it shows none of them.

        It is looked at from the frame's pose, or where the frame has none from where it was seen last. Exposure and white balance of the
        frame play no part.
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


def compared_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Width and height at which pictures of this shape are compared."""
    return COMPARED_PX, max(1, round(COMPARED_PX * height_px / width_px))


def likeness_of(first: NDArray[np.float32], second: NDArray[np.float32], known: NDArray[np.bool_]) -> float:
    """Correlation, -1 to 1, of the structure of two pictures [H, W, 3] where `known` [H, W]; 0 where too little is known of them.

    Each channel counts by itself, so a factor and an offset for each make no difference.
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
