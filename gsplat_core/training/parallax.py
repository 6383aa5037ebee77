"""How far away the tissue of a recording's first frame is, from how later pictures moved where their cameras are known.

Without depth a scene starts on a plane. Where the camera moves, a plane at the wrong distance makes the camera's motion look like motion of
the tissue, which has to be learned anew for every time and says nothing about times between.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.depth_from_motion import (
    FLOW_ERROR_PX,
    LEAST_PARALLAX_PX,
    ROUNDS,
    parallax_terms,
    translation_between,
)
from gsplat_core.training.image_motion import CELL_PX, Flow, ImageMotion, typical_px
from gsplat_core.training.motion_prior import followed

FURTHEST = 0.125
"""Of the picture's width: flow that is typically longer is not looked for."""
LEAST_EXPLAINED = 0.75
"""Share of the motion left by the cameras' turning that the depth which is found has to explain: chance explains half of it with one pair."""
RELIEF = 0.5
"""Standard deviation of the tissue's inverse depth, relative to that of the plane that fits best."""
LARGEST_RELIEF = 4.0
"""Nothing is taken to be so many times nearer or farther than that plane."""


def depth_by_parallax(frames: Sequence[Frame], cameras: Sequence[Camera]) -> NDArray[np.float32] | None:
    """z [H, W] of the first frame's pixels in the unit of the cameras' positions; `cameras` are those of the frames.

    None where the first frame has depth of its own, where no camera moves, and where no distance explains most of how the picture moves.
    """
    first, before = frames[0], cameras[0]
    if first.depth is not None or before.model != "pinhole":
        return None
    tissue, pairs = _tissue_cells(first), []
    for number in _later_views(cameras):
        flow = _flow_between(first, frames[number])
        if flow is None or not tissue.any() or typical_px(flow[tissue][None]) > FURTHEST * before.width_px:
            break
        pixels = _cell_centres(flow, before)
        target = pixels + torch.from_numpy(flow).double().reshape(-1, 2)
        pairs.append(parallax_terms(pixels, target, before, cameras[number]))
    if not pairs:
        return None
    c, d = (torch.stack(terms) for terms in zip(*pairs, strict=True))
    focal, inside = float(before.K[0, 0]), torch.from_numpy(tissue).flatten()
    plane = _plane(c[:, inside], d[:, inside], focal)
    if plane is None:
        return None
    inverse = _relief(c, d, focal, plane)
    if _explained(c[:, inside], d[:, inside], focal, inverse[inside]) < LEAST_EXPLAINED:
        return None
    smooth = cv2.medianBlur(inverse.reshape(tissue.shape).numpy().astype(np.float32), 5)
    return np.asarray(
        1 / cv2.resize(smooth, (before.width_px, before.height_px), interpolation=cv2.INTER_LINEAR), np.float32
    )


def _tissue_cells(frame: Frame) -> NDArray[np.bool_]:
    """The cells of a flow that are mostly tissue which can be followed, [h, w]."""
    height, width = frame.image.shape[:2]
    mask = followed(frame)
    known = np.ones((height, width), np.float32) if mask is None else (mask != 0).astype(np.float32)
    size = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    return np.asarray(cv2.resize(known, size, interpolation=cv2.INTER_AREA) >= 0.5)


def _later_views(cameras: Sequence[Camera]) -> Iterator[int]:
    """The first frame whose camera has moved since frame 0, and frames 1, 3, 7, 15, … after it."""
    moved = (np.any(translation_between(cameras[0], camera)) for camera in cameras)
    start = next((number for number, has_moved in enumerate(moved) if has_moved), len(cameras))
    ahead = 0
    while start + ahead < len(cameras):
        yield start + ahead
        ahead = 2 * ahead + 1


def _flow_between(first: Frame, later: Frame) -> Flow | None:
    motion = ImageMotion()
    motion.follow(first.image, followed(first))
    return motion.follow(later.image, followed(later))


def _cell_centres(flow: Flow, camera: Camera) -> Tensor:
    """Pixels [h * w, 2] (x, y) at which `flow` [h, w, 2] is known; float64."""
    rows, columns = flow.shape[:2]
    y = (torch.arange(rows, dtype=torch.float64) + 0.5) * (camera.height_px / rows)
    x = (torch.arange(columns, dtype=torch.float64) + 0.5) * (camera.width_px / columns)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def _plane(c: Tensor, d: Tensor, focal: float) -> float | None:
    """The one inverse depth w that fits most of w c = d, both [pairs, points, 2]; None where there is too little parallax to tell."""
    weight = torch.ones_like(c[..., 0])
    inverse = c.new_zeros(())
    for _ in range(ROUNDS):
        inverse = (weight * (c * d).sum(-1)).sum() / (weight * (c * c).sum(-1)).sum().clamp(min=1e-20)
        weight = _agreement(c, d, focal, inverse)
    parallax_px = focal * float(inverse * c.norm(dim=-1).median(dim=1).values.max())
    return float(inverse) if float(inverse) > 0 and parallax_px >= LEAST_PARALLAX_PX else None


def _relief(c: Tensor, d: Tensor, focal: float, plane: float) -> Tensor:
    """Each point's inverse depth [points], from all pairs and, as far as these do not tell, from the plane."""
    prior = 1 / (RELIEF * plane) ** 2
    inverse = torch.full_like(c[0, :, 0], plane)
    for _ in range(ROUNDS):
        weight = _agreement(c, d, focal, inverse) * (focal / FLOW_ERROR_PX) ** 2
        told, information = (weight * (c * d).sum(-1)).sum(0), (weight * (c * c).sum(-1)).sum(0)
        inverse = (told + prior * plane) / (information + prior)
        inverse = inverse.clamp(plane / LARGEST_RELIEF, plane * LARGEST_RELIEF)
    return inverse


def _agreement(c: Tensor, d: Tensor, focal: float, inverse: Tensor) -> Tensor:
    """Weights [pairs, points] with which least squares become the smallest sum of distances: what moves otherwise decides nothing."""
    return FLOW_ERROR_PX / _off_px(c, d, focal, inverse).clamp(min=FLOW_ERROR_PX)


def _explained(c: Tensor, d: Tensor, focal: float, inverse: Tensor) -> float:
    """Which share of the motion left by the cameras' turning, as a typical square, still points at these inverse depths have."""
    off_px, moved_px = _off_px(c, d, focal, inverse), focal * d.norm(dim=-1)
    return 1 - float((off_px.median() / moved_px.median().clamp(min=1e-6)).square())


def _off_px(c: Tensor, d: Tensor, focal: float, inverse: Tensor) -> Tensor:
    return focal * (d - inverse[..., None] * c).norm(dim=-1)
