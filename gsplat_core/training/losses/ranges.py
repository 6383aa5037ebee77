"""Difference between the measured and the rendered histograms of a range sensor."""

from __future__ import annotations

from collections import OrderedDict
from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.range_histogram import Bins, range_histogram
from gsplat_core.ops.splat_rays import splat_rays
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.flow import projected
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.range_sensors import RangeScan, RangeSensor
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.observations import Observation
from gsplat_core.transfers import tensor_of

TILE_SIZE = 16


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
"""Number of scans whose tensors are kept on the device."""


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
