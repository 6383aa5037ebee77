"""Rendering of what a range sensor measures."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.range_histogram import Bins, range_histogram
from gsplat_core.ops.splat_rays import splat_rays
from gsplat_core.ops.tiles.grid import TileGrid
from gsplat_core.ops.tiles.tiles import bin_splats
from gsplat_core.rendering.flow import projected
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.range_sensors import RangeSensor
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
