"""`rasterization` built from the reference operations: any floating-point dtype and device, slow."""

from __future__ import annotations

from gsplat_core.pipeline import Operations
from gsplat_core.reference.compositing import rasterize_to_pixels
from gsplat_core.reference.projection import fully_fused_projection
from gsplat_core.reference.spherical_harmonics import spherical_harmonics
from gsplat_core.reference.tiles import isect_offset_encode, isect_tiles

rasterization = Operations(
    fully_fused_projection=fully_fused_projection,
    spherical_harmonics=spherical_harmonics,
    isect_tiles=isect_tiles,
    isect_offset_encode=isect_offset_encode,
    rasterize_to_pixels=rasterize_to_pixels,
).rasterization
