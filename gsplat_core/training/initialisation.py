"""Creation of Gaussians from one frame: a jittered pixel grid at the tissue's depth, coloured by the picture.

`StartOnDevice` creates a scene's first Gaussians on the device like `gaussians_from_frame`, except that it fills tools
from a pyramid of means. This takes a few milliseconds on a GPU. It avoids cuBLAS and cuDNN: each takes tens of
milliseconds for its first use in a thread, which would delay a stream's
first picture.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

from gsplat_core.depth.maps import possible_depth
from gsplat_core.depth.plane_fits import filled_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.image_motion import beside
from gsplat_core.training.observations import Observation, unprojected
from gsplat_core.transfers import tensor_of

SIGMA_IN_SPACINGS = 0.7
"""Standard deviation of a new Gaussian in grid spacings; neighbours overlap without holes."""
THICKNESS = 0.3
"""Thickness of a new Gaussian relative to its width, since tissue is a surface."""

FIRST_OPACITY = 0.9
HIDDEN = -10.0
"""Logit of the opacity of Gaussians at excluded pixels, which is too small to be drawn."""
MARGIN_IN_SPACINGS = 2
"""Distance to the nearest pixel that is not excluded up to which Gaussians are visible, so that the rim has neighbours on
both sides."""
TOOL_MARGIN_PX = 2
"""Width in pixels of the margin around tools that is in-painted together with them, since masks end slightly early."""

NEAR_TOOL_CELLS = 5
"""Width in cells of four pixels of the neighbourhood whose tissue gives the colours at the edge of a tool."""


def gaussians_from_frame(
    frame: Frame, camera: Camera, count: int, *, sh_degree: int, default_depth_mm: float, seed: int = 0
) -> Gaussians:
    """Create Gaussians that cover the whole frame including tools.

    Pixels under tools get in-painted colours (Telea 2004) and extrapolated depth, so that tissue
    uncovered later has Gaussians. Gaussians that the frame's `loss_mask` excludes, such as outside of a round view, are
    transparent: nothing is known of that place.

    Args:
        frame: first frame of a scene.
        camera: camera of the frame, with its pose.
        count: approximate number of Gaussians.
        sh_degree: degree of the spherical harmonics.
        default_depth_mm: distance of the plane used for a frame without depth, in millimetres.
        seed: seed of the grid's jitter.
    """
    height, width = frame.image.shape[:2]
    pixels, spacing_px = jittered_grid(width, height, count, seed)
    row, column = pixel_indices(pixels, height, width)
    depth_mm = tissue_depth(frame, default_depth_mm)[row, column]
    created = gaussians_at_pixels(pixels, spacing_px, tissue_colours(frame), depth_mm, camera, sh_degree=sh_degree)
    hidden = excluded(frame, spacing_px)
    if hidden is not None:
        created.logit_opacities[torch.from_numpy(hidden[row, column])] = HIDDEN
    return created


def excluded(frame: Frame, spacing_px: float) -> NDArray[np.bool_] | None:
    """Return the pixels [H, W] that `loss_mask` excludes and that are no neighbours of others at this spacing; None if
    there are none.
    """
    if frame.loss_mask is None or frame.loss_mask.all() or not frame.loss_mask.any():
        return None
    margin_px = math.ceil(MARGIN_IN_SPACINGS * spacing_px)
    near = cv2.dilate(frame.loss_mask, np.ones((2 * margin_px + 1,) * 2, np.uint8))
    return np.asarray(near == 0)


def jittered_grid(width: int, height: int, count: int, seed: int) -> tuple[NDArray[np.float64], float]:
    """Return about `count` pixels [M, 2] (x, y) spread evenly over a picture, and their spacing in pixels."""
    spacing = math.sqrt(height * width / count)
    columns, rows = max(1, round(width / spacing)), max(1, round(height / spacing))
    jitter = np.random.default_rng(seed).uniform(-0.15, 0.15, (2, rows, columns))
    u = (np.arange(columns)[None, :] + 0.5 + jitter[0]) * (width / columns)
    v = (np.arange(rows)[:, None] + 0.5 + jitter[1]) * (height / rows)
    return np.stack([u.ravel(), v.ravel()], -1), spacing


def pixel_indices(pixels: NDArray[np.float64], height: int, width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the row and column of the pixel at or next to each position [M, 2] (x, y) in a picture of this size."""
    column, row = (np.clip(pixels[:, k].astype(np.int64), 0, most - 1) for k, most in enumerate((width, height)))
    return row, column


def blur_sigma_px(spacing_px: float) -> float:
    """Return the blur (standard deviation in pixels) of a picture from which Gaussians of this spacing take colours."""
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
    """Create one Gaussian per pixel.

    Args:
        pixels: positions [M, 2] as x, y; pixel centres at +0.5.
        spacing_px: distance of neighbouring Gaussians in pixels, to which their width is proportional.
        image: RGB uint8 [H, W, 3], source of colours.
        depth_mm: float32 [M], depth of each Gaussian.
        camera: camera of the picture, with its pose.
        sh_degree: degree of the spherical harmonics.
    """
    row, column = pixel_indices(pixels, *image.shape[:2])
    colour = _blurred_at(image, row, column, blur_sigma_px(spacing_px)).astype(np.float64) / 255
    z = depth_mm.astype(np.float64)
    camera_to_world = np.linalg.inv(camera.world_to_camera)
    points, pixel_mm = unprojected(pixels, z, camera)
    points = points @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]
    sigma = SIGMA_IN_SPACINGS * spacing_px * pixel_mm
    count = len(pixels)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colour - 0.5) / SH_C0
    quat = facing(np.asarray(camera_to_world[:3, :3], np.float64)).astype(np.float32)
    # Share memory with the arrays instead of copying, because a stream's first picture waits for this.
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quats=torch.from_numpy(np.tile(quat, (count, 1))),
        log_scales=torch.from_numpy(np.log(sigma[:, None] * np.array([1, 1, THICKNESS])).astype(np.float32)),
        logit_opacities=torch.from_numpy(np.full(count, math.log(FIRST_OPACITY / (1 - FIRST_OPACITY)), np.float32)),
        sh=torch.from_numpy(sh),
    )


def _blurred_at(
    image: NDArray[np.uint8], row: NDArray[np.int64], column: NDArray[np.int64], sigma_px: float
) -> NDArray[np.uint8]:
    """Return the colours [M, 3] of a picture at some pixels after a Gaussian blur. Only the part of the picture that contains
    them is blurred.
    """
    if len(row) == 0:
        return np.empty((0, 3), np.uint8)
    reach = math.ceil(4 * sigma_px) + 1  # beyond OpenCV's kernel, so that the result is that of the whole picture
    top, left = (max(0, int(each.min()) - reach) for each in (row, column))
    part = image[top : int(row.max()) + reach + 1, left : int(column.max()) + reach + 1]
    return np.asarray(cv2.GaussianBlur(part, (0, 0), sigma_px), np.uint8)[row - top, column - left]


def facing(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion wxyz of a rotation matrix [3, 3] (Shepperd 1978, numerically stable for any rotation)."""
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
    """Return the picture, RGB uint8 [H, W, 3], with tools in-painted from the surrounding tissue; unchanged without
    tissue.
    """
    if frame.mask is None or frame.mask.all() or not frame.mask.any():
        return frame.image
    bare_tool = (frame.mask == 0).view(np.uint8)
    tool = cv2.dilate(bare_tool, np.ones((2 * TOOL_MARGIN_PX + 1,) * 2, np.uint8))
    if tool.all():  # dilation would leave no tissue
        tool = bare_tool
    return inpaint_quarter_size(frame.image, np.asarray(tool, np.uint8))


def colours_beside_tools(frame: Frame) -> NDArray[np.uint8]:
    """Return the picture with the edges of tools replaced by colours of the tissue around, RGB uint8 [H, W, 3].

    It suffices for Gaussians on tissue and takes a tenth of the time of `tissue_colours`, which fills whole tools.
    """
    if frame.mask is None or frame.mask.all() or not frame.mask.any():
        return frame.image
    height, width = frame.mask.shape
    bare_tool = (frame.mask == 0).view(np.uint8)
    tool = cv2.dilate(bare_tool, np.ones((2 * TOOL_MARGIN_PX + 1,) * 2, np.uint8))
    small = (max(1, width // 4), max(1, height // 4))
    tissue = np.asarray(1 - tool, np.uint8)
    colours = cv2.resize(cv2.copyTo(frame.image, tissue), small, interpolation=cv2.INTER_AREA).astype(np.float32)
    weight = cv2.resize(tissue.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    total, share = (cv2.blur(each, (NEAR_TOOL_CELLS, NEAR_TOOL_CELLS)) for each in (colours, weight))
    filled = np.clip(np.rint(total / np.maximum(share, 1e-3)[..., None]), 0, 255).astype(np.uint8)
    large = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    near = cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) > 1e-3
    return np.asarray(cv2.copyTo(large, tool & near.astype(np.uint8), frame.image.copy()), np.uint8)


def inpaint_quarter_size(image: NDArray[np.uint8], hole: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """In-paint non-zero pixels of `hole`, at a quarter of the size, because large holes take seconds at full size. If the
    hole covers all of the small picture, it gets the mean colour of the rest.
    """
    height, width = hole.shape
    small = (max(1, width // 4), max(1, height // 4))
    small_hole = (cv2.resize((hole > 0).astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8)
    if small_hole.all():  # no pixel to in-paint from at this size
        outside = image[hole == 0] if not hole.all() else image.reshape(-1, 3)
        return np.where(hole[..., None] > 0, np.rint(outside.mean(0)), image).astype(np.uint8)
    filled = cv2.inpaint(cv2.resize(image, small, interpolation=cv2.INTER_AREA), small_hole, 3, cv2.INPAINT_TELEA)
    large = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(hole[..., None] > 0, large, image).astype(np.uint8)


def tissue_depth(frame: Frame, default_depth_mm: float) -> NDArray[np.float32]:
    """Return z in millimetres for every pixel [H, W]: measured on tissue, extrapolated elsewhere,
    or the default without any depth.
    """
    height, width = frame.image.shape[:2]
    if frame.depth is None:
        return np.full((height, width), default_depth_mm, np.float32)
    measured = possible_depth(frame)
    known = np.isfinite(measured) & (measured > 0)
    if not known.any():
        return np.full((height, width), default_depth_mm, np.float32)
    return measured if known.all() else np.where(known, measured, filled_depth(measured, known))


FILLED_PX = 160
"""Smallest width in pixels to which depth is reduced before `depth_at_pixels` extrapolates it."""


SAMPLED_SHARE = 0.5
"""Smallest density of depth among the samples of a reduced picture, relative to the whole picture, with which it is used."""


def depth_at_pixels(pixels: NDArray[np.float64], frame: Frame, default_depth_mm: float) -> NDArray[np.float32]:
    """Return z in millimetres at pixels [M, 2] as `tissue_depth`, but extrapolated at a reduced size, because a stream's picture
    waits for it.
    """
    measured = possible_depth(frame)
    known = np.isfinite(measured) & (measured > 0)
    row, column = pixel_indices(pixels, *measured.shape)
    if not known.any():
        return np.full(len(pixels), default_depth_mm, np.float32)
    there = known[row, column]
    found = np.where(there, measured[row, column], np.float32(0))
    if not there.all():
        step = max(1, measured.shape[1] // FILLED_PX)
        rows, columns = (min(step // 2, size - 1) for size in measured.shape)
        some = known[rows::step, columns::step]
        if some.mean() < SAMPLED_SHARE * known.mean():  # depth in lines between the samples
            return np.where(there, found, tissue_depth(frame, default_depth_mm)[row, column])
        coarse = filled_depth(measured[rows::step, columns::step], some)
        at = (np.minimum(each // step, size - 1) for each, size in zip((row, column), coarse.shape, strict=True))
        found = np.where(there, found, coarse[tuple(at)])
    return found


COARSE = 4
"""Factor by which pictures are reduced before tissue under tools is filled in, equal to that of the host's in-painting."""


def filled(picture: Tensor, known: Tensor, coarse: int = COARSE) -> Tensor:
    """Fill the holes of a picture and smooth all of it at a reduced resolution.

    A pyramid of means over known pixels is used ("push and pull": Gortler et al., "The Lumigraph",
    1996); each level fills the holes of the finer one.

    Args:
        picture: [C, H, W].
        known: [1, H, W], 0 in holes.
        coarse: factor of the reduction.
    """
    height, width = known.shape[1:]
    levels = [_shrunk((picture * known)[None], known[None], coarse)]
    while max(levels[-1][1].shape[2:]) > 1:
        levels.append(_shrunk(*levels[-1], 2))
    total, weight = levels.pop()
    whole = total / weight.clamp(min=1e-6)
    for total, weight in reversed(levels):
        coarser = interpolate(whole, size=weight.shape[2:], mode="bilinear", align_corners=False)
        sure = (coarse * weight).clamp(max=1)
        whole = sure * total / weight.clamp(min=1e-6) + (1 - sure) * coarser
    return interpolate(whole, size=(height, width), mode="bilinear", align_corners=False)[0]


def _shrunk(total: Tensor, weight: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Return weighted sums and their weights, both averaged over cells of `factor` x `factor` pixels."""
    height, width = weight.shape[2:]
    beyond = (0, -width % factor, 0, -height % factor)
    return avg_pool2d(pad(total, beyond), factor), avg_pool2d(pad(weight, beyond), factor)


class StartOnDevice:
    """Creator of a scene's first Gaussians on the device, with a pixel grid prepared before the first frame for one camera."""

    def __init__(self, camera: Camera, count: int, device: torch.device, seed: int = 0) -> None:
        """Prepare the grid as `gaussians_from_frame` does. Only the camera's pose may differ later."""
        self.camera, self._device = camera, device
        pixels, self._spacing_px = jittered_grid(camera.width_px, camera.height_px, count, seed)
        columns = np.clip(pixels[:, 0].astype(np.int64), 0, camera.width_px - 1)
        rows = np.clip(pixels[:, 1].astype(np.int64), 0, camera.height_px - 1)
        self._cells = torch.from_numpy(rows * camera.width_px + columns).to(device)
        # In every camera model the point of a pixel is linear in depth. Two depths therefore determine
        # the point at any depth.
        at_zero, at_one = (unprojected(pixels, np.full(len(pixels), z), camera) for z in (0.0, 1.0))
        self._points = self._float32(at_zero[0]), self._float32(at_one[0] - at_zero[0])
        self._pixel_mm = self._float32(at_zero[1]), self._float32(at_one[1] - at_zero[1])

    def fits(self, camera: Camera) -> bool:
        """Return True if the grid fits a camera, ignoring its pose."""
        mine = self.camera
        same_size = (mine.width_px, mine.height_px, mine.model) == (camera.width_px, camera.height_px, camera.model)
        return same_size and bool((mine.K == camera.K).all())

    def __call__(self, frame: Frame, observation: Observation, *, sh_degree: int, default_depth_mm: float) -> Gaussians:
        """Create the Gaussians of `frame`, which is `observation` on the device, without synchronisation."""
        image, camera = observation.image, observation.camera
        z = image.new_full((len(self._cells),), default_depth_mm, dtype=torch.float32)
        if frame.depth is not None:
            z = tensor_of(tissue_depth(frame, default_depth_mm), self._device).flatten()[self._cells]
        colours = _blurred(_without_tools(frame, image), blur_sigma_px(self._spacing_px))
        colour = colours.flatten(1)[:, self._cells].T
        camera_to_world = np.linalg.inv(camera.world_to_camera)
        pose = beside(z, camera_to_world[:3].ravel()).view(3, 4)
        local = self._points[0] + self._points[1] * z[:, None]
        sigma = SIGMA_IN_SPACINGS * self._spacing_px * (self._pixel_mm[0] + self._pixel_mm[1] * z)
        count = len(z)
        sh = z.new_zeros(count, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = (colour - 0.5) / SH_C0
        flattened = beside(z, np.log([1, 1, THICKNESS]))
        return Gaussians(
            means=(local[:, None, :] * pose[:, :3]).sum(dim=2) + pose[:, 3],
            quats=beside(z, facing(np.asarray(camera_to_world[:3, :3], np.float64))).repeat(count, 1),
            log_scales=sigma.log()[:, None] + flattened,
            logit_opacities=self._opacities(frame, z),
            sh=sh,
        )

    def _opacities(self, frame: Frame, like: Tensor) -> Tensor:
        visible = torch.full_like(like, math.log(FIRST_OPACITY / (1 - FIRST_OPACITY)))
        hidden = excluded(frame, self._spacing_px)
        if hidden is None:
            return visible
        return visible.masked_fill_(
            tensor_of(hidden.astype(np.uint8), self._device).flatten()[self._cells].bool(), HIDDEN
        )

    def _float32(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(self._device)


def _without_tools(frame: Frame, image: Tensor) -> Tensor:
    """Return the picture as float [3, H, W] in 0..1 with tools filled from the surrounding tissue."""
    picture = image.permute(2, 0, 1).float() / 255
    if frame.mask is None or frame.mask.all() or not frame.mask.any():
        return picture
    tissue = tensor_of(frame.mask, image.device)
    bare = (tissue == 0).float()[None, None]
    margin = 2 * TOOL_MARGIN_PX + 1
    tool = max_pool2d(bare, margin, stride=1, padding=TOOL_MARGIN_PX)
    tool = torch.where(tool.min() > 0, bare, tool)[0]  # without the margin if no tissue would be left
    return torch.where(tool > 0, filled(picture, 1 - tool), picture)


def _blurred(picture: Tensor, sigma_px: float) -> Tensor:
    """Blur `picture` [C, H, W] with a Gaussian and reflected borders; a picture too small for it is unchanged."""
    reach = max(1, math.ceil(3 * sigma_px))
    height, width = picture.shape[1:]
    if min(height, width) <= reach:
        return picture
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    weights = (taps / taps.sum()).tolist()
    wide = pad(picture[None], (reach, reach, reach, reach), mode="reflect")[0]
    across = sum((weight * wide[:, :, k : k + width] for k, weight in enumerate(weights)), start=torch.zeros(()))
    return sum((weight * across[:, k : k + height] for k, weight in enumerate(weights)), start=torch.zeros(()))
