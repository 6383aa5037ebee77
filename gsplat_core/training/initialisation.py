"""Gaussians from the pixels of one frame: a jittered grid at the tissue's depth, coloured by the picture."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.geometry.depth_fill import filled_depth
from gsplat_core.geometry.depth_map import BELIEVED, POSSIBLE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.scene.gaussians import SH_C0, Gaussians

SIGMA_IN_SPACINGS = 0.7
"""Standard deviation of a fresh Gaussian in grid spacings: neighbours overlap and leave no holes."""
THICKNESS = 0.3
"""Depth of a fresh Gaussian relative to its width: tissue is a surface."""

FIRST_OPACITY = 0.9
TOOL_MARGIN_PX = 2
"""So much around a tool is painted over with it: masks end a little early."""
HOLE_MARGIN_PX = 2
"""Beside what two eyes could not match, depth is not learned from; half as far from it a scene does not start."""
BESIDE_TOOL_PX = 4
"""Beside a tool matched depth may be the tool's."""

MAX_ANGLE_RAD = math.radians(85)
"""Widest angle from the axis at which a fisheye pixel is placed; what lies farther out is placed there."""


def gaussians_from_frame(
    frame: Frame, camera: Camera, count: int, *, sh_degree: int, default_depth_mm: float, seed: int = 0
) -> Gaussians:
    """About `count` Gaussians that cover the whole frame, tools included.

    Pixels under a tool take colour and depth from the tissue around them (Telea 2004 in-painting), so that tissue which a tool uncovers
    has Gaussians to learn with. Depth comes from the frame where it is known, else from the plane z = `default_depth_mm`.
    """
    height, width = frame.image.shape[:2]
    pixels, spacing_px = jittered_grid(width, height, count, seed)
    return gaussians_at_pixels(
        pixels, spacing_px, tissue_colours(frame), tissue_depth(frame, default_depth_mm), camera, sh_degree=sh_degree
    )


def jittered_grid(width: int, height: int, count: int, seed: int) -> tuple[NDArray[np.float64], float]:
    """About `count` pixels [M, 2] (x, y) that cover a picture evenly, and how far they are apart."""
    spacing = math.sqrt(height * width / count)
    columns, rows = max(1, round(width / spacing)), max(1, round(height / spacing))
    jitter = np.random.default_rng(seed).uniform(-0.15, 0.15, (2, rows, columns))
    u = (np.arange(columns)[None, :] + 0.5 + jitter[0]) * (width / columns)
    v = (np.arange(rows)[:, None] + 0.5 + jitter[1]) * (height / rows)
    return np.stack([u.ravel(), v.ravel()], -1), spacing


def blur_sigma_px(spacing_px: float) -> float:
    """How much a picture is blurred before Gaussians so far apart take their colours from it."""
    return max(0.3, 0.3 * spacing_px)


def gaussians_at_pixels(
    pixels: NDArray[np.float64],
    spacing_px: float,
    image: NDArray[np.uint8],
    depth_mm: NDArray[np.float32],
    camera: Camera,
    *,
    sh_degree: int,
) -> Gaussians:
    """One Gaussian at each of `pixels` [M, 2] (x, y; pixel centres at +0.5), `spacing_px` wide, at `depth_mm` [H, W], coloured by `image`."""
    height, width = depth_mm.shape
    column = np.clip(pixels[:, 0].astype(np.int64), 0, width - 1)
    row = np.clip(pixels[:, 1].astype(np.int64), 0, height - 1)
    smooth = cv2.GaussianBlur(image, (0, 0), blur_sigma_px(spacing_px))
    colour = smooth[row, column].astype(np.float64) / 255
    z = depth_mm[row, column].astype(np.float64)
    camera_to_world = np.linalg.inv(camera.world_to_camera)
    points, pixel_mm = unprojected(pixels, z, camera)
    points = points @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]
    sigma = SIGMA_IN_SPACINGS * spacing_px * pixel_mm
    count = len(pixels)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colour - 0.5) / SH_C0
    quat = facing(np.asarray(camera_to_world[:3, :3], np.float64)).astype(np.float32)
    # Arrays become tensors without a copy: a stream's first picture waits for this.
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quats=torch.from_numpy(np.tile(quat, (count, 1))),
        log_scales=torch.from_numpy(np.log(sigma[:, None] * np.array([1, 1, THICKNESS])).astype(np.float32)),
        logit_opacities=torch.from_numpy(np.full(count, math.log(FIRST_OPACITY / (1 - FIRST_OPACITY)), np.float32)),
        sh=torch.from_numpy(sh),
    )


def unprojected(
    pixels: NDArray[np.float64], z: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The camera model inverted: points [M, 3] in camera space at depth `z` [M], and how long a pixel is there [M]."""
    plane = (pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    if camera.model == "ortho":
        return np.concatenate([plane, z[:, None]], 1), np.full_like(z, 1 / camera.K[0, 0])
    pixel = z / camera.K[0, 0]
    if camera.model == "fisheye":
        # So far the plane holds the angle. A pixel is 1 / cos² long outwards and tan / angle across: their geometric mean.
        angle = np.clip(np.linalg.norm(plane, axis=1), 1e-9, MAX_ANGLE_RAD)
        stretch = np.tan(angle) / np.maximum(np.linalg.norm(plane, axis=1), 1e-9)
        plane = plane * stretch[:, None]
        pixel = pixel * np.sqrt(stretch) / np.cos(angle)
    return np.concatenate([plane * z[:, None], z[:, None]], 1), pixel


def facing(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion wxyz of a rotation matrix [3, 3] (Shepperd 1978, the stable branch for any rotation)."""
    trace_terms = np.array([np.trace(rotation), *np.diag(rotation)])
    largest = int(np.argmax(trace_terms))
    if largest == 0:
        q = np.array(
            [
                1 + trace_terms[0],
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = rotation[k, j] - rotation[j, k]
        q[1 + i] = 1 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        q[1 + j] = rotation[j, i] + rotation[i, j]
        q[1 + k] = rotation[k, i] + rotation[i, k]
    return q / np.linalg.norm(q)


def tissue_colours(frame: Frame) -> NDArray[np.uint8]:
    """The image with tools painted over by the tissue around them; RGB uint8 [H, W, 3]."""
    if frame.mask is None or frame.mask.all() or not frame.mask.any():
        return frame.image
    bare_tool = (frame.mask == 0).astype(np.uint8)
    tool = cv2.dilate(bare_tool, np.ones((2 * TOOL_MARGIN_PX + 1,) * 2, np.uint8))
    if tool.all():  # no tissue would be left
        tool = bare_tool
    return inpaint_quarter_size(frame.image, np.asarray(tool, np.uint8))


def inpaint_quarter_size(image: NDArray[np.uint8], hole: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Fill `hole` (non-zero) of `image`. At a quarter of the size: what lies under a tool is a guess, and large holes take seconds at full size."""
    height, width = hole.shape
    small = (max(1, width // 4), max(1, height // 4))
    small_hole = (cv2.resize((hole > 0).astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8)
    if small_hole.all():  # nothing is left to grow from at this size
        outside = image[hole == 0] if not hole.all() else image.reshape(-1, 3)
        return np.where(hole[..., None] > 0, np.rint(outside.mean(0)), image).astype(np.uint8)
    filled = cv2.inpaint(cv2.resize(image, small, interpolation=cv2.INTER_AREA), small_hole, 3, cv2.INPAINT_TELEA)
    large = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(hole[..., None] > 0, large, image).astype(np.uint8)


def believed_depth(frame: Frame) -> NDArray[np.float32]:
    """The frame's depth [H, W] where it is to be believed, 0 elsewhere and where the frame has none.

    What two eyes were matched by is not sharp at edges: beside what could not be matched, or is not believed, it is left out.
    """
    return _depth_from(frame, BELIEVED, HOLE_MARGIN_PX)


def possible_depth(frame: Frame) -> NDArray[np.float32]:
    """The frame's depth [H, W] of tissue where it is better than a guess by what lies around it, 0 elsewhere: something to start from.

    Of two eyes that is more than what is believed, but not what lies close to a tool, which may have been given the tool's depth.
    """
    if frame.depth_origin is not DepthOrigin.STEREO:
        depth = believed_depth(frame)
        return depth if frame.mask is None else np.where(frame.mask > 0, depth, np.float32(0))
    depth = _depth_from(frame, POSSIBLE, HOLE_MARGIN_PX // 2)
    return depth if frame.mask is None else np.where(_inner(frame.mask > 0, BESIDE_TOOL_PX), depth, np.float32(0))


def _depth_from(frame: Frame, least: float, margin_px: int) -> NDArray[np.float32]:
    if frame.depth is None:
        return np.zeros(frame.image.shape[:2], np.float32)
    if frame.depth_confidence is None:
        return frame.depth
    kept = frame.depth_confidence >= least
    if frame.depth_origin is DepthOrigin.STEREO:
        kept = _inner(kept, margin_px)
    return np.where(kept, frame.depth, np.float32(0))


def _inner(where: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """The pixels [H, W] with nothing else so near."""
    side = 2 * margin_px + 1
    return np.asarray(cv2.erode(where.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def tissue_depth(frame: Frame, default_depth_mm: float) -> NDArray[np.float32]:
    """z in millimetres for every pixel [H, W]: measured where known and not a tool, the surface around it continued elsewhere, else the default."""
    height, width = frame.image.shape[:2]
    if frame.depth is None:
        return np.full((height, width), default_depth_mm, np.float32)
    measured = possible_depth(frame)
    known = np.isfinite(measured) & (measured > 0)
    if not known.any():
        return np.full((height, width), default_depth_mm, np.float32)
    return measured if known.all() else np.where(known, measured, filled_depth(measured, known))
