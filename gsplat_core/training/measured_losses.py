"""Loss terms of measurements other than a frame's colours and depth: optical flow between frames, points triangulated
from several frames (TriaGS), and scans of range sensors.

Matches of triangulated points come from the pictures alone. Projecting the rendered point into other views and
triangulating it there would return the same point for any surface.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.range_histogram import Bins, range_histogram
from gsplat_core.ops.splat_rays import splat_rays
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.flow import nearest_splats, projected, render_depth, render_flow, sampled
from gsplat_core.rendering.settings import TILE_SIZE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.range_sensors import RangeScan, RangeSensor
from gsplat_core.training.image_motion import SMALL_PIXELS, consistent_flow
from gsplat_core.training.losses import LossContext
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import HostCopy, tensor_of

NOISE_PX = 0.6
"""Flow error in pixels up to which nothing is penalised, because observed flow is not more accurate. Without it the loss
increases the error of followed points where training on pictures is already more accurate than that."""
KEPT_PAIRS = 256
"""Largest number of frame pairs whose observed flow is cached."""
SEARCH_EVERY = 200
"""Number of loss evaluations after which the nearest splats of each splat, needed to render flow, are searched again."""


class FlowLoss:
    """Mean distance in pixels between rendered and observed flow beyond `NOISE_PX`, over pixels with reliable flow.

    The observed flow is DIS flow from the preceding or following frame to the observation, by turns. Where forward and
    backward flow disagree, where a tool is, and where nothing is rendered, nothing is compared. The scene at the other
    frame's time is constant, so the loss moves the Gaussians at the observation's time. Pictures of more than
    `SMALL_PIXELS` pixels are compared at half size.
    """

    name: ClassVar[str] = "flow"
    default_weight: ClassVar[float] = 0.05

    def __init__(self) -> None:
        self._flows: OrderedDict[tuple[int, int], Tensor] = OrderedDict()
        """Cache of observed flow [h, w, 2] from one frame to another, by both frame numbers; NaN where unreliable."""
        self._neighbours = torch.empty(0, 0, dtype=torch.int64)
        self._calls = 0

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean flow error between the observation and the frame before or after it; None without a pair, and
        for a right eye.
        Raises InvalidSetting for a camera other than a pinhole.
        """
        if observation.camera.model != "pinhole":
            raise InvalidSetting(
                f"the loss 'flow' is for pinhole cameras, this one is {observation.camera.model}; remove it from the losses"
            )
        other = None if observation.of_right else self._other(observation, context)
        if other is None:
            return None
        turn, self._calls = self._calls, self._calls + 1
        target = self._flow(other, observation)
        before, after = (_compared_size(each.camera) for each in (other, observation))
        first = context.at(other.time_s)
        if len(self._neighbours) != scene.count or turn % SEARCH_EVERY == 0:
            self._neighbours = nearest_splats(first)
        rendered = render_flow(first, scene, before, after, neighbours=self._neighbours)
        known = target[..., 0].isfinite() & rendered.observed  # both components are NaN where flow is unreliable
        off = torch.where(known[..., None], rendered.flow - target, 0)
        lengths = off.square().sum(-1).clamp(min=NOISE_PX**2).sqrt() - NOISE_PX
        return lengths.sum() / known.sum().clamp(min=1)

    def _other(self, observation: Observation, context: LossContext) -> Observation | None:
        """Return the frame before or the frame after the observation, in alternating calls. The first and the last frame
        have only one of them. Return None if no such frame has the same size.
        """
        left = [one for one in context.frames if not one.of_right]
        index = next((k for k, one in enumerate(left) if one.seq == observation.seq), None)
        if index is None:
            return None
        nearest = [left[k] for k in (index - 1, index + 1) if 0 <= k < len(left)]
        nearest = [one for one in nearest if one.image.shape == observation.image.shape]
        return nearest[self._calls % len(nearest)] if nearest else None

    def _flow(self, first: Observation, second: Observation) -> Tensor:
        """Return the observed flow between two frames at the compared size."""
        key = first.seq, second.seq
        known = self._flows.get(key)
        if known is None:
            images, masks = (
                [HostCopy(each).numpy() for each in pair] for pair in zip(*map(_picture, (first, second)), strict=True)
            )
            flow = consistent_flow(*images, *masks)
            size = _compared_size(first.camera)
            if (size.height_px, size.width_px) != flow.shape[:2]:
                # Take the nearest value, because a mean that includes an unreliable one would be unreliable.
                rows, columns = (np.arange(n) * 2 for n in (size.height_px, size.width_px))
                flow = flow[np.ix_(rows, columns)] * np.float32(size.width_px / first.camera.width_px)
            known = self._flows[key] = tensor_of(np.ascontiguousarray(flow, np.float32), first.image.device)
            if len(self._flows) > KEPT_PAIRS:
                self._flows.popitem(last=False)
        return known


def _picture(observation: Observation) -> tuple[Tensor, Tensor]:
    return observation.image, observation.mask


def _compared_size(camera: Camera) -> Camera:
    """Return the camera at half its size, at which flow is compared; unchanged if its picture is small."""
    if camera.width_px * camera.height_px <= SMALL_PIXELS:
        return camera
    return camera.resized(camera.width_px // 2, camera.height_px // 2)


LEAST_ANGLE_DEG = 1.5
"""Smallest angle between the rays of two camera views to a point at which the point is triangulated."""
LARGEST_ANGLE_DEG = 15.0
"""Largest angle between the directions from which two matched frames see the tissue; beyond it flow finds few matches."""
MOST_VIEWS, LEAST_VIEWS = 8, 2
"""Largest and smallest number of other frames in which a frame's point is matched for triangulation."""
SIGMA = 0.01
"""Distance σ at which the robust loss of triangulated points saturates, relative to a point's depth."""
FAR = 0.25
"""Weight of the logarithmic loss term, whose gradient also moves a surface far from the triangulated points."""
MOST_REPROJECTION_PX = 1.0
"""Largest root mean square distance of a triangulated point from its matches."""
KEPT_FRAMES = 512
"""Largest number of frames whose triangulated points are cached."""
STRIDE_PX = 4
"""Distance in pixels between neighbouring pixels of a frame that are triangulated."""


class Triangulated(NamedTuple):
    """Points of one frame that were triangulated from other frames."""

    pixels: Tensor
    """Pixel coordinates [P, 2] in the frame."""
    points: Tensor
    """Positions of the triangulated points in the axes of the frame's camera, [P, 3]."""


class TriangulationLoss:
    """Robust mean distance of the rendered surface from points triangulated in 2 to 8 other frames.

    For a camera that moves around tissue at rest: the points of a frame come from pictures of other times. Optical flow
    between the frames gives the matches, checked forward and backward. The points do not depend on the scene, so they
    are computed once for each frame. The gradient moves the scene's depth.
    """

    name: ClassVar[str] = "triangulation"
    default_weight: ClassVar[float] = 1.0

    def __init__(self) -> None:
        self._points: OrderedDict[tuple[int, bool], Triangulated] = OrderedDict()
        """Triangulated points by frame number and eye (True for the right one)."""
        self._missed: dict[tuple[int, bool], int] = {}
        """Number of other frames that were available when the triangulation of a frame gave no points, by frame number and
        eye. The triangulation is tried again once more frames are available.
        """
        self._has_parallax = False

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean distance of the rendered surface from the observation's points; None without points. Raises
        InvalidSetting for a single camera at rest, and for other cameras than pinholes.
        """
        if observation.camera.model != "pinhole":
            raise InvalidSetting(
                f"the loss 'triangulation' is for pinhole cameras, this one is {observation.camera.model}; remove it from"
                " the losses"
            )
        target = self._target(scene, observation, context)
        if target is None:
            return None
        return consensus_loss(render_depth(scene, observation.camera), target, observation.camera)

    def _target(self, scene: Gaussians, observation: Observation, context: LossContext) -> Triangulated | None:
        """Return the points of a frame, triangulated on first use; None if there are too few views or points."""
        key = observation.seq, observation.of_right
        if key in self._points:
            return self._points[key]
        others = [one for one in context.frames if (one.seq, one.of_right) != key]
        if not self._has_parallax:
            check_parallax(observation, others)
            self._has_parallax = len(others) >= LEAST_VIEWS
        if len(others) < LEAST_VIEWS or self._missed.get(key) == len(others):
            return None
        depth = render_depth(scene.detach(), observation.camera).detach()
        seen = depth[depth > 0]
        found = triangulated(observation, chosen_views(observation, others, float(seen.median()) if len(seen) else 0.0))
        if found is None:
            self._missed[key] = len(others)
            return None
        self._points[key] = found
        if len(self._points) > KEPT_FRAMES:
            self._points.popitem(last=False)
        return found


def check_parallax(observation: Observation, others: Sequence[Observation]) -> None:
    """Raise InvalidSetting if there are at least two other frames and all have the observation's camera position."""
    position = observation.camera.position
    if len(others) >= LEAST_VIEWS and all(np.allclose(one.camera.position, position, atol=1e-9) for one in others):
        raise InvalidSetting(
            "the loss 'triangulation' needs pictures from several places, but the camera does not move; use the loss 'flow'"
            " or depth"
        )


def consensus_loss(depth: Tensor, target: Triangulated, camera: Camera) -> Tensor:
    """Return the mean of r + `FAR` log(1 + |X - X*|² / σ²) over the triangulated points X* with rendered depth.

    r = |X - X*|² / (|X - X*|² + σ²) with σ 1 % of a point's depth. The second term gives a surface far from all points a
    gradient, which r alone does not.
    """
    _, K = camera.matrices(depth.device, depth.dtype)
    z = sampled(depth[..., None], target.pixels[None])[0, :, 0]
    rays = torch.cat([(target.pixels - K[:2, 2]) / K[[0, 1], [0, 1]], torch.ones_like(z)[:, None]], 1)
    known = z > 0
    squared = (rays * z[:, None] - target.points).square().sum(1) / target.points[:, 2].square()
    scaled = squared / SIGMA**2
    robust = scaled / (scaled + 1) + FAR * torch.log1p(scaled)
    return torch.where(known, robust, 0).sum() / known.sum().clamp(min=1)


def chosen_views(observation: Observation, others: Sequence[Observation], distance: float) -> list[Observation]:
    """Return up to 8 frames that see tissue at `distance` from directions 1.5 to 15° away, evenly spaced in angle.

    Pictures of another size are left out.
    """
    angles = []
    for one in others:
        baseline = float(np.linalg.norm(one.camera.position - observation.camera.position))
        angle = math.degrees(2 * math.atan2(baseline / 2, distance)) if distance > 0 else 0.0
        if LEAST_ANGLE_DEG <= angle <= LARGEST_ANGLE_DEG and one.image.shape == observation.image.shape:
            angles.append((angle, one.seq, one.of_right, one))
    angles.sort(key=lambda each: each[:3])
    if len(angles) > MOST_VIEWS:
        angles = [angles[round(k)] for k in np.linspace(0, len(angles) - 1, MOST_VIEWS)]
    return [one for *_, one in angles]


def triangulated(observation: Observation, others: Sequence[Observation]) -> Triangulated | None:
    """Triangulate pixels of a frame from their matches in other frames; None without any point."""
    if len(others) < LEAST_VIEWS:
        return None
    image, mask = (HostCopy(each).numpy() for each in (observation.image, observation.mask))
    rows, columns = (np.arange(STRIDE_PX // 2, n, STRIDE_PX) for n in image.shape[:2])
    grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    pixels = grid + 0.5
    matches = [pixels]
    for one in others:
        flow = consistent_flow(image, HostCopy(one.image).numpy(), mask, HostCopy(one.mask).numpy())
        matches.append(pixels + flow[grid[:, 1], grid[:, 0]])
    seen = np.stack(matches, 1)
    cameras = [observation.camera, *(one.camera for one in others)]
    world, reliable = triangulate(seen.astype(np.float64), cameras)
    if not reliable.any():
        return None
    pose = observation.camera.world_to_camera
    local = world[reliable] @ pose[:3, :3].T + pose[:3, 3]
    device = observation.image.device
    return Triangulated(*(tensor_of(each.astype(np.float32), device) for each in (pixels[reliable], local)))


def triangulate(
    matches: NDArray[np.float64], cameras: Sequence[Camera]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Triangulate points linearly from their pixels (Hartley and Zisserman 2004, section 12.2).

    The projection matrices are divided by their Frobenius norms, so that no view dominates.

    Args:
        matches: pixels [P, V, 2], the first view's always known; NaN where a view has no match.
        cameras: pinhole cameras of the V views.

    Returns:
        World points [P, 3], and which of them are reliable, bool [P]: at least two other views at 1.5° or more, in
        front of all views, and within 1 px (root mean square) of the matches.

    Raises:
        InvalidInput: unless there is a camera for each view of the matches.
    """
    matches = np.asarray(matches, np.float64)
    if matches.ndim != 3 or matches.shape[1:] != (len(cameras), 2) or not cameras:
        raise InvalidInput(
            f"matches must be [P, V, 2] with a camera for each of V views, got {list(matches.shape)} and {len(cameras)} cameras"
        )
    P = np.stack([camera.K @ camera.world_to_camera[:3] for camera in cameras])
    scaled = P / np.linalg.norm(P, axis=(1, 2), keepdims=True)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(matches).all(-1))
    pixels = np.where(known[..., None], matches, 0)
    rows = pixels[..., None] * scaled[None, :, 2:3] - scaled[None, :, :2]
    rows = np.where(known[..., None, None], rows, 0).reshape(len(matches), 2 * len(cameras), 4)
    _, _, v = np.linalg.svd(rows, full_matrices=rows.shape[1] < 4)
    homogeneous = v[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        points = homogeneous[:, :3] / homogeneous[:, 3:]
        image = np.einsum("vij,pj->pvi", P, np.concatenate([points, np.ones((len(points), 1))], 1))
        squared = ((image[..., :2] / image[..., 2:] - pixels) ** 2).sum(-1)
        towards = points[:, None] - np.stack([camera.position for camera in cameras])
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        angles = np.degrees(np.arccos(np.clip((towards * towards[:, :1]).sum(-1), -1, 1)))
    wide = known & (angles >= LEAST_ANGLE_DEG)
    error = np.where(known, squared, 0).sum(1) / known.sum(1).clip(1)
    reliable = (wide[:, 1:].sum(1) >= LEAST_VIEWS) & (error <= MOST_REPROJECTION_PX**2)
    reliable &= np.isfinite(points).all(1) & np.where(known, image[..., 2] > 0, True).all(1)
    return points, reliable


def render_ranges(gaussians: Gaussians, camera: Camera, sensor: RangeSensor, factors: Tensor | None = None) -> Tensor:
    """Render the sensor's histograms; differentiable in the Gaussians' geometry and opacities.

    Args:
        gaussians: scene, float32.
        camera: camera at the sensor's place.
        sensor: sensor.
        factors: result of `sensor.factors(camera)` on the scene's device, to save its computation; None to compute it.

    Returns:
        Sum of blending weights in each bin, [columns, bins], or [1, bins] for the form `image`.
    """
    if factors is None:
        given = sensor.factors(camera)
        factors = None if given is None else tensor_of(given, gaussians.device)
    rows = projected(gaussians, camera)
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    rays = splat_rays(gaussians.means, gaussians.quats, gaussians.scales, viewmat, intrinsics, camera.model).rays
    opacities = gaussians.opacities
    grid = TileGrid(TILE_SIZE, -(-camera.width_px // TILE_SIZE), -(-camera.height_px // TILE_SIZE))
    with torch.no_grad():
        _, ids, starts = bin_splats(
            rows.means2d[None], rows.radii[None], rows.depths[None], grid, conics=rows.conics[None],
            opacities=opacities[None],
        )  # fmt: skip
    histograms = range_histogram(
        rows.means2d, rows.conics, opacities, rays, starts.reshape(grid.tile_height, grid.tile_width), ids,
        Bins(sensor.nearest, sensor.bin_width, sensor.bins), camera.width_px, camera.height_px, factors=factors,
    )  # fmt: skip
    return histograms.sum(0, keepdim=True) if sensor.form == "image" else histograms


DISTANCE_WEIGHT = 0.5
"""Weight of the Wasserstein distance in bins relative to the L1 difference."""
KEPT_SCANS = 256
"""Largest number of range scans whose tensors are cached on the device."""


def normalised(histograms: Tensor) -> Tensor:
    """Divide each row [rows, bins] by its largest value; rows without returns stay 0."""
    return histograms / histograms.amax(1, keepdim=True).clamp(min=1e-8)


def range_loss(rendered: Tensor, measured: Tensor) -> Tensor:
    """Compare histograms [rows, bins]; the mean over rows with returns.

    The loss of a row is the L1 difference of both histograms divided by their maxima, relative to the measured sum, plus
    `DISTANCE_WEIGHT` times their Wasserstein distance in bins. The latter is the L1 difference of the cumulated histograms. It
    has a gradient also where histograms do not overlap, and leads depth over many bins.
    """
    seen = (measured.amax(1) > 0).to(rendered.dtype)
    wanted = normalised(measured)
    off = (normalised(rendered) - wanted).abs().sum(1) / wanted.sum(1).clamp(min=1e-8)
    apart = (_cumulated(rendered) - _cumulated(measured)).abs().sum(1)
    return ((off + DISTANCE_WEIGHT * apart) * seen).sum() / seen.sum().clamp(min=1)


def _cumulated(histograms: Tensor) -> Tensor:
    return (histograms / histograms.sum(1, keepdim=True).clamp(min=1e-8)).cumsum(1)


class RangeLoss:
    """Difference of the histograms of a range sensor (Z-Splat, Qu et al. 2024), see `range_loss`.

    It corrects depth that no parallax shows. A frame without a scan has nothing to compare.
    """

    name: ClassVar[str] = "range"
    default_weight: ClassVar[float] = 0.3

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[int, bool], tuple[RangeScan, Tensor, Tensor | None]] = OrderedDict()

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the loss of the observation's scan; None without a scan. Raises InvalidInput for a scan with another
        number of columns than the picture.
        """
        scan = observation.ranges
        if scan is None:
            return None
        measured, factors = self._tensors(scan, observation, scene.device)
        return range_loss(render_ranges(scene, observation.camera, scan.sensor, factors), measured)

    def _tensors(self, scan: RangeScan, observation: Observation, device: torch.device) -> tuple[Tensor, Tensor | None]:
        key = observation.seq, observation.of_right
        kept = self._kept.get(key)
        if kept is None or kept[0] is not scan:
            _check_columns(scan.sensor, len(scan.counts), observation.camera.width_px)
            factors = scan.sensor.factors(observation.camera)
            kept = scan, tensor_of(scan.counts, device), None if factors is None else tensor_of(factors, device)
            self._kept[key] = kept
            if len(self._kept) > KEPT_SCANS:
                self._kept.popitem(last=False)
        return kept[1], kept[2]


def _check_columns(sensor: RangeSensor, rows: int, width_px: int) -> None:
    if sensor.form == "column" and rows != width_px:
        raise InvalidInput(f"the scan has {rows} columns, the picture {width_px}; resample the scan to the picture")
